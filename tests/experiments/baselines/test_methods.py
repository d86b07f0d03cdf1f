"""The methods: their pipelines against loops, gradients of the loss, density control, files."""

from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training.watch import NotFinite
from tutorials.experiments import baselines
from tutorials.experiments.baselines import explicit, plane_features

from .small import MODULES, SMALL, model_of, random_parameters

EVERY = pytest.mark.parametrize("method", MODULES)
X_C, T = np.array([2.0, 1.0, -1.0]), 0.7


def test_d3dgs_against_a_loop():
    p = random_parameters("d3dgs", 3)
    g = model_of("d3dgs", p).predict(T, X_C)[0]
    time = [T, np.sin(T), np.cos(T), np.sin(2 * T), np.cos(2 * T)]
    (W, b), (V, c) = p.network("psi_t"), p.network("psi_d")
    for n, x in enumerate(p["x"]):
        seen = np.maximum(time @ W[0] + b[0], 0) @ W[1] + b[1]
        inputs = np.concatenate([x, np.sin(x), np.cos(x), seen])
        hidden = np.maximum(np.maximum(inputs @ V[0] + c[0], 0) @ V[1] + c[1], 0)
        hidden = np.maximum(np.concatenate([inputs, hidden]) @ V[2] + c[2], 0)
        delta_x, delta_s, delta_r = (hidden @ V[i] + c[i] for i in (3, 4, 5))
        r = p["raw_r"][n] / np.linalg.norm(p["raw_r"][n]) + delta_r
        assert g.x[n] == pytest.approx(x + delta_x, rel=1e-12)
        assert g.s[n] == pytest.approx(np.exp(p["log_s"][n]) + delta_s, rel=1e-12)
        assert g.r[n] == pytest.approx(r / np.linalg.norm(r), rel=1e-12)


def test_hexplane_against_a_loop():
    p = random_parameters("hexplane", 3)
    g = model_of("hexplane", p).predict(T, X_C)[0]
    features, _ = plane_features.forward(p["x"], T, *p["box"], p.arrays_of("planes"))
    W, b = p.network("psi")
    for n, x in enumerate(p["x"]):
        h = np.maximum(np.maximum(features[n] @ W[0] + b[0], 0) @ W[1] + b[1], 0)
        delta_x, delta_log_s, delta_raw_r = (
            np.maximum(h @ W[i] + b[i], 0) @ W[i + 1] + b[i + 1] for i in (2, 4, 6)
        )
        r = p["raw_r"][n] + delta_raw_r
        assert g.x[n] == pytest.approx(x + delta_x, rel=1e-12)
        assert g.s[n] == pytest.approx(np.exp(p["log_s"][n] + delta_log_s), rel=1e-12)
        assert g.r[n] == pytest.approx(r / np.linalg.norm(r), rel=1e-12)


def test_gaussians_that_have_faded_are_not_rendered():
    p = random_parameters("gaussian4d", 3, N=80)
    p["log_s_t"][...] -= 1
    model = model_of("gaussian4d", p)
    seen = model.predict(T, X_C)[0].index
    assert 0 < len(seen) < 80 and 79 not in seen
    p["mu_t"][...] = T
    assert len(model.predict(T, X_C)[0].index) == 80


@pytest.mark.parametrize(
    "method, iteration", [("d3dgs", 20), ("hexplane", 5), ("hexplane", 20), ("gaussian4d", 59)]
)
def test_gradients_of_the_loss(scene, method, iteration):
    """One view from parameters to the loss, in float64 and with the exact renderer."""
    strong = {"lambda_planes": (0.3, 0.2, 0.1)} if method == "hexplane" else {}
    trainer = MODULES[method].Trainer(scene, replace(SMALL[method], **strong), settings=EXACT)
    trainer.parameters = random_parameters(method, 4)
    trainer.iteration, p, view = iteration, trainer.parameters, scene.train[3]
    p["log_s"][...] = -1.5
    losses, _, gradients, _ = trainer.gradients_of(view)
    assert (losses.L_total > losses.L_render) == (method == "hexplane" and iteration >= 10)
    rng = np.random.default_rng(6)
    skipped = ("psi_d.W0", "psi_d.W2", "box")  # psi_d reads E(x) there, see `random_parameters`
    for name in set(p.arrays) - set(skipped):
        d, h, start, values = rng.normal(size=p[name].shape), 1e-6, p[name].copy(), []
        for step in (h, -h):
            p[name][...] = start + step * d
            values.append(trainer.gradients_of(view)[0].L_total)
        p[name][...] = start
        wanted = (values[0] - values[1]) / (2 * h)
        assert (gradients[name] * d).sum() == pytest.approx(wanted, rel=2e-5, abs=1e-9), name


@EVERY
def test_training_is_repeatable_and_learns(scene, trained, method):
    again, start = (MODULES[method].Trainer(scene, SMALL[method], seed=1) for _ in range(2))
    first = {name: a.copy() for name, a in again.parameters.arrays.items()}
    assert np.array_equal(again.run().parameters.vector, trained[method].parameters.vector)
    ends = [evaluate(model, scene)[0]["psnr_db"] for model in (start.model(), trained[method])]
    assert ends[1] > ends[0] + 1
    still = [n for n, a in first.items() if np.array_equal(a, again.parameters.arrays[n][: len(a)])]
    assert still == ["box"] * (method == "hexplane")


@pytest.mark.parametrize("method", ["d3dgs", "hexplane"])
def test_what_moves_waits_for_its_stage(scene, method):
    trainer = MODULES[method].Trainer(scene, SMALL[method])
    waiting = [name for name in trainer.parameters.arrays if name.startswith(("psi", "planes"))]
    first = {name: trainer.parameters[name].copy() for name in waiting}
    for _ in range(SMALL[method].warm_up):
        trainer.step()
    assert all(np.array_equal(trainer.parameters[name], first[name]) for name in waiting)
    trainer.step()
    assert trainer.stage == 2 and trainer.adam.steps["x"] == (1 if method == "hexplane" else 11)
    assert not any(np.array_equal(trainer.parameters[name], first[name]) for name in waiting)


def test_nan_is_named(scene):
    trainer = MODULES["d3dgs"].Trainer(scene, SMALL["d3dgs"])
    trainer.parameters["sh_dc"][3] = np.nan
    with np.errstate(all="ignore"), pytest.raises(NotFinite, match="iteration 0: .*is nan"):
        trainer.step()


# --- density control ---
def test_densify_against_a_loop():
    preset = replace(SMALL["d3dgs"], gradient_threshold=0.5, percent_dense=0.1, most=75)
    p, rng = random_parameters("d3dgs", N=60), np.random.default_rng(0)
    rows = ["x", "sh_dc", "logit_alpha", "log_s"]
    p["log_s"][...] = np.log(0.3) + 0.7 * rng.normal(size=(60, 3))
    p["logit_alpha"][...] = 4 * rng.normal(size=60) - 3
    gradient = rng.random(60)

    def shift(children):
        children["x"] += 1
        children["log_s"] -= np.log(2)

    keep, added = explicit.densify(p, rows, gradient, 3.0, preset, shift)
    kept, clones, children = [], [], []
    for n in range(60):
        row = {name: p[name][n] for name in rows}
        large = np.exp(row["log_s"]).max() > 0.3
        faint = 1 / (1 + np.exp(-row["logit_alpha"])) < 0.005
        wanted = gradient[n] >= 0.5 and (gradient > gradient[n]).sum() < 15
        kept.append(not (wanted and large) and not faint)
        if wanted and not faint:
            half = {**row, "x": row["x"] + 1, "log_s": row["log_s"] - np.log(2)}
            (children if large else clones).extend([half, half] if large else [row])
    assert keep.tolist() == kept and clones and children
    for name in rows:
        assert np.array_equal(added[name], [row[name] for row in clones + children]), name


@EVERY
def test_children_are_drawn_from_their_parent(scene, method):
    """Their mean is the parent's, and they are smaller by 1.6."""
    trainer, p = MODULES[method].Trainer(scene, SMALL[method]), random_parameters(method, 8)
    rows = [name for name in trainer.kind.PROPERTIES if name in p.arrays]
    children = {name: np.repeat(p[name][:1], 50_000, axis=0) for name in rows}
    trainer.scatter(children)
    spread = np.exp(p["log_s"][0]).max()
    assert children["x"].mean(axis=0) == pytest.approx(p["x"][0], abs=0.03 * spread)
    assert 0.5 * spread < children["x"].std(axis=0).max() < 1.5 * spread
    assert children["log_s"][-1] == pytest.approx(p["log_s"][0] - np.log(1.6))


def test_new_gaussians_have_zero_moments(scene):
    preset = replace(SMALL["d3dgs"], gradient_threshold=1e-6, most=99, percent_dense=9.0)
    trainer, counts = MODULES["d3dgs"].Trainer(scene, preset), []
    for _ in range(30):
        before = trainer.count
        trainer.step()
        if trainer.count > before:
            counts.append(trainer.iteration)
            assert trainer.adam.first["x"].any() and not trainer.adam.first["x"][-1].any()
            assert len(trainer.statistics.seen) == trainer.count
    assert counts and set(counts) <= {10, 20}


# --- files, and the page ---
@EVERY
def test_the_file_is_read_back(scene, trained, tmp_path, method):
    """62 floats of 3DGS a Gaussian, or 161 of 4DGS, which has no normals and no network."""
    model, path = trained[method], tmp_path / "a.ply"
    sizes = model.save(path)
    assert sum(sizes.values()) == path.stat().st_size and sizes["other"] < 6000
    assert sizes["gaussians"] == 4 * (161 if method == "gaussian4d" else 62) * model.count
    again = baselines.load(path)
    assert all(np.array_equal(again.parameters[n], a) for n, a in model.parameters.arrays.items())
    image, other = (m.render(scene.test[0].camera, scene.test[0].time) for m in (model, again))
    assert np.array_equal(image, other) and np.array_equal(again.background, scene.background)
    path.write_bytes(b"ply\n")
    with pytest.raises(ValueError, match="a.ply: "):
        baselines.load(path)
