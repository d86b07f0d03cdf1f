"""What all methods share: gradients of pipeline and loss, training, files."""

from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.lab import baselines
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training.parameters import Parameters

from .small import MODULES, SMALL, model_of, random_parameters

EVERY = pytest.mark.parametrize("method", MODULES)
WAITING = ("psi", "planes")  # arrays that take part once the Gaussians move
# Iterations, with the active degree of the harmonics and the waves in time; None is the end.
ITERATIONS = [
    *((method, *row) for method in ("d3dgs", "hexplane") for row in ((None, 3, 0), (0, 0, 0))),
    *((method, 10, 1, 0) for method in ("d3dgs", "hexplane")),
    *(("gaussian4d", *row) for row in ((0, 0, 0), (25, 2, 0), (30, 3, 0), (40, 3, 1))),
    ("gaussian4d", None, 3, 2),
]


def slope(values, h):
    """The difference quotient of values at +h and -h."""
    return (values[0] - values[1]) / (2 * h)


@pytest.mark.parametrize("method, iteration, degree, waves", ITERATIONS)
def test_gradients_of_the_pipeline(method, iteration, degree, waves):
    """Against differences: static, moving and finished, with more and more harmonics."""
    rng, p, x_c = np.random.default_rng(5), random_parameters(method), np.array([0.3, -3.0, 1.0])
    g, back = model_of(method, p).predict(0.4, x_c, iteration)
    bars = [rng.normal(size=a.shape) for a in g[:-1]]
    arrays, networks = back(*bars)
    gradients = p.zeros()
    for name, gradient in arrays.items():
        gradients[name][...] = gradient
    for name, gradient in networks.items():
        gradients.fill(name, gradient)
    for name in p.arrays:
        d, h = rng.normal(size=p[name].shape), 3e-6

        def value(step):
            moved = Parameters(p.arrays, np.float64)
            moved[name][...] += step * d
            out, _ = model_of(method, moved).predict(0.4, x_c, iteration)
            return sum(float((bar * a).sum()) for bar, a in zip(bars, out[:-1]))

        if name == "box":
            assert not np.any(gradients[name])
            continue
        ours = float((gradients[name] * d).sum())
        theirs = slope([value(h), value(-h)], h)
        assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-7), name
        if name != "sh_rest":
            waits = iteration == 0 and name.startswith(WAITING)
            assert np.any(gradients[name]) != waits, name
        if method == "gaussian4d":
            assert 0 < len(g.index) < 9 and not np.any(gradients[name][-1]), name
    active = np.zeros((3 if method == "gaussian4d" else 1, 16), bool)
    active[: waves + 1, : (degree + 1) ** 2] = True
    received = np.concatenate([gradients["sh_dc"], gradients["sh_rest"]], axis=2)
    assert np.array_equal(received.any(axis=(0, 1)), active.ravel())


@pytest.mark.parametrize(
    "method, iteration", [("d3dgs", 20), ("hexplane", 5), ("hexplane", 20), ("gaussian4d", 59)]
)
def test_gradients_of_the_loss(scene, method, iteration):
    """One view from parameters to the loss, in float64 and with the exact renderer."""
    strong = {"lambda_planes": (0.3, 0.2, 0.1)} if method == "hexplane" else {}
    trainer = MODULES[method].Trainer(scene, replace(SMALL[method], **strong), settings=EXACT)
    trainer.start(random_parameters(method, 4))
    trainer.iteration, p, view = iteration, trainer.parameters, scene.train[3]
    p["log_s"][...] = -1.5
    losses, seen, gradients, _ = trainer.gradients_of(view)
    further = trainer.around(p).regularise(p.zeros(), iteration)
    assert losses.L_total == pytest.approx(losses.L_render + further) and losses.L_render > 0
    assert (further > 0) == (method == "hexplane" and iteration >= 10)
    assert len(seen.alpha) == 9 and (len(seen.index) < 9) == (method == "gaussian4d")
    rng = np.random.default_rng(6)
    skipped = ("psi_d.W0", "psi_d.W2", "box")  # psi_d reads E(x) there, see `random_parameters`
    for name in set(p.arrays) - set(skipped):
        d, h, start, values = rng.normal(size=p[name].shape), 1e-6, p[name].copy(), []
        for step in (h, -h):
            p[name][...] = start + step * d
            values.append(trainer.gradients_of(view)[0].L_total)
        p[name][...] = start
        ours = float((gradients[name] * d).sum())
        assert ours == pytest.approx(slope(values, h), rel=2e-5, abs=1e-9), name


@EVERY
def test_training_is_repeatable_and_learns(scene, trained, method):
    again, start = (MODULES[method].Trainer(scene, SMALL[method], seed=1) for _ in range(2))
    assert np.array_equal(again.run().parameters.vector, trained[method].parameters.vector)
    ends = [evaluate(model, scene)[0]["psnr_db"] for model in (start.model(), trained[method])]
    assert ends[1] > ends[0] + 1
    assert trained[method].primitives != SMALL[method].gaussians or method != "gaussian4d"


@EVERY
def test_the_file_is_read_back(scene, trained, tmp_path, method):
    """62 floats of 3DGS a Gaussian, or 161 of 4DGS, which has no normals and no network."""
    model, path = trained[method], tmp_path / "a.ply"
    sizes = model.save(path)
    assert sum(sizes.values()) == path.stat().st_size and sizes["other"] < 6000
    assert sizes["gaussians"] == 4 * (161 if method == "gaussian4d" else 62) * model.primitives
    arrays = model.parameters.arrays
    floats = sum(a.size for n, a in arrays.items() if n.startswith(("psi", "planes", "box")))
    assert sizes["network"] == 4 * floats and bool(floats) == (method != "gaussian4d")
    again = baselines.load(path)
    assert isinstance(again, MODULES[method].Trainer.kind)
    assert set(again.parameters.arrays) == set(arrays)
    for name, a in arrays.items():
        assert np.array_equal(again.parameters[name], a), name
    view = scene.test[0]
    assert np.array_equal(*(m.render(view.camera, view.time) for m in (model, again)))
    assert np.array_equal(again.background, scene.background)
