"""What all methods share: gradients of pipeline and loss, training, files."""

from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.cli import parser as cli
from p4dgs_ref.lab import baselines
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.splatting.settings import EXACT

from .small import MODULES, SMALL, random_parameters

EVERY = pytest.mark.parametrize("method", MODULES)
WAITING = ("psi", "planes")  # arrays that take part once the Gaussians move


def slope(values, h):
    """The difference quotient of values at +h and -h."""
    return (values[0] - values[1]) / (2 * h)


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


# iteration -> {array: rate}; "extent" marks multiples of the extent of the cameras.
PAPER = {
    "d3dgs": {
        0: {"x": 8e-4, "psi_d": 0, "psi_t": 0},
        15_000: {"x": 8e-5, "sh_dc": 0.0025},
        20_000: {"psi_d": (8e-4 * 1.6e-6) ** 0.5, "psi_t": (8e-4 * 1.6e-6) ** 0.5},
        39_999: {"x": 8e-6},
    },
    "hexplane": {  # rates start anew with the fine stage
        0: {"x extent": 1.6e-4, "planes": 0, "psi": 0},
        3000: {"x extent": 1.6e-4},
        13_000: {"x extent": 1.6e-5, "planes extent": 1.6e-4, "psi extent": 1.6e-5, "box": 0},
        22_999: {"x extent": 1.6e-6, "sh_dc": 0.0025},
    },
    "gaussian4d": {
        0: {"x extent": 1.6e-4, "mu_t extent": 1.6e-4, "log_s_t": 0.005, "log_s": 0.005},
        15_000: {"x extent": 1.6e-5, "mu_t extent": 1.6e-4, "raw_l": 0.001, "raw_r": 0.001},
        30_000: {"x extent": 1.6e-6, "mu_t extent": 1.6e-4},
    },
}
FEW = {"gaussians": 10, "deformation": (4, 4, 4), "time_net": (4, 3), "nodes": 3, "time_nodes": 3}


@EVERY
def test_rates_are_those_of_the_authors(scene, method):
    preset = MODULES[method].PAPER_SYNTHETIC
    changes = {name: value for name, value in FEW.items() if hasattr(preset, name)}
    trainer = MODULES[method].Trainer(scene, replace(preset, **changes))
    assert 4 < trainer.extent < 5
    for trainer.iteration, rates in PAPER[method].items():
        for words, rate in rates.items():
            name, *extent = words.split()
            wanted = rate * trainer.extent if extent else rate
            assert trainer.rate_of(name) == pytest.approx(wanted, rel=1e-3), words


@pytest.mark.parametrize("method", ["d3dgs", "hexplane"])
def test_stages_of_training(scene, method):
    """Networks and planes wait for their stage, harmonics for their degree."""
    trainer = MODULES[method].Trainer(scene, replace(SMALL[method], grow_from=10**9))
    starts = []
    for iteration in range(30):
        starts.append({name: a.copy() for name, a in trainer.parameters.arrays.items()})
        if iteration == 11 and method == "hexplane":
            assert trainer.adam.steps["x"] == 1  # the fine stage starts with new moments
        trainer.step()
    for name in starts[0]:
        for first, last in ((0, 10), (10, 29)):
            same = np.array_equal(starts[first][name], starts[last][name])
            waits = name.startswith((*WAITING, "sh_rest"))
            assert same == (name == "box" or waits and last == 10), (name, first)
    rest = trainer.parameters["sh_rest"]
    assert np.any(rest[:, :, 3:8]) and not np.any(rest[:, :, 8:])


def test_presets_by_method():
    always = baselines.choose("gaussian4d")
    assert always == MODULES["gaussian4d"].TINY and always.stage(0) == always.stage(99) == 1
    tiny, small = (baselines.choose(method) for method in ("d3dgs", "d3dgs_small"))
    assert tiny.deformation == (256,) * 8 and small.deformation == (64, 64)
    changed = baselines.choose("d3dgs_small", "paper_real", {"lr_x": "0.1,0.01", "skip": "false"})
    assert changed.time_noise == 0.1 and changed.lr_x == (0.1, 0.01) and not changed.skip


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
    # Common viewers take every property of a header for one of the vertices.
    properties = path.read_bytes()[: sizes["other"]].count(b"\nproperty float ")
    assert sizes["gaussians"] == 4 * properties * model.primitives
    arrays = model.parameters.arrays
    floats = sum(a.size for n, a in arrays.items() if n.startswith(("psi", "planes", "box")))
    assert sizes["network"] == 4 * floats and bool(floats) == (method != "gaussian4d")
    again = baselines.load(path)
    assert isinstance(again, MODULES[method].Trainer.kind)
    assert set(again.parameters.arrays) == set(arrays)
    for name, a in arrays.items():
        assert np.array_equal(again.parameters[name], a), name
    image, other = (m.render(scene.test[0].camera, scene.test[0].time) for m in (model, again))
    assert np.array_equal(image, other) and np.array_equal(again.background, scene.background)
    assert cli.run(f"render {path} -o {tmp_path / 'views'} --scene bouncing".split(), 0.0) == 0
    whole = load_scene("bouncing").test[0]  # the command draws views in their full size
    drawn, want = (
        iio.imread(tmp_path / "views" / "test_r_000.png") / 255,
        again.render(whole.camera, whole.time),
    )
    np.testing.assert_allclose(drawn, np.clip(want, 0, 1), atol=0.501 / 255)
    assert cli.run(f"render {path} -o {tmp_path / 'held'} --frames 2 --size 8".split(), 0.0) == 0
