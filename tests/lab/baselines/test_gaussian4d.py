"""4DGS: its pipeline and gradients, training, density control in 4D, and its file."""

from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.lab import baselines
from p4dgs_ref.lab.baselines import gaussian4d, rotation_4d, sh_color
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training.parameters import Parameters

SMALL = replace(
    gaussian4d.TINY,
    gaussians=40,
    most=50,
    iterations=60,
    sh_every=10,
    grow_from=5,
    grow_every=10,
    grow_until=45,
)
X_C = np.array([0.3, -3.0, 1.0])


@pytest.fixture(scope="module")
def scene():
    return load_scene("bouncing", downscale=4)


@pytest.fixture(scope="module")
def trained(scene):
    return gaussian4d.Trainer(scene, SMALL, seed=1).run()


def random_parameters(seed=0, N=9):
    """Parameters in float64 in which every array matters; the last Gaussian is long gone."""
    rng = np.random.default_rng(seed)
    p = Parameters(gaussian4d.Gaussian4D.initial(replace(SMALL, gaussians=N), rng), np.float64)
    p["sh_dc"][...] = rng.normal(size=(N, 3, 1))
    p["sh_rest"][...] = 0.3 * rng.normal(size=(N, 3, 47))
    p["raw_l"][...] = [1, 0, 0, 0] + 0.4 * rng.normal(size=(N, 4))
    p["raw_r"][...] = [1, 0, 0, 0] + 0.4 * rng.normal(size=(N, 4))
    p["log_s"][...] = -1.5 + 0.3 * rng.normal(size=(N, 3))
    p["log_s_t"][...] = -1 + 0.3 * rng.normal(size=(N, 1))
    p["logit_alpha"][...] = rng.normal(size=N)
    p["mu_t"][-1] = 9
    return p


def model_of(p):
    return gaussian4d.Gaussian4D(p, SMALL, np.ones(3))


# --- pipeline ---
@pytest.mark.parametrize(
    "iteration, degree, waves", [(0, 0, 0), (25, 2, 0), (30, 3, 0), (40, 3, 1), (None, 3, 2)]
)
def test_gradients_of_the_pipeline(iteration, degree, waves):
    """With harmonics in space and then waves in time becoming active: against differences."""
    rng, p = np.random.default_rng(5), random_parameters()
    g, saved = model_of(p).predict(0.4, X_C, iteration)
    assert 0 < len(g.index) < 9
    bars = [rng.normal(size=a.shape) for a in g[:4]]
    gradients, networks = model_of(p).predict_backward(saved, *bars)
    assert set(gradients) == set(p.arrays) and not networks
    for name in p.arrays:
        d, h = rng.normal(size=p[name].shape), 1e-5

        def value(step):
            moved = Parameters(p.arrays, np.float64)
            moved[name][...] += step * d
            out, _ = model_of(moved).predict(0.4, X_C, iteration)
            return sum(float((bar * a).sum()) for bar, a in zip(bars, out[:4]))

        ours = float((gradients[name] * d).sum())
        theirs = (value(h) - value(-h)) / (2 * h)
        assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-8), name
        assert not np.any(gradients[name][-1]), name
    active = np.zeros((3, 16), bool)
    active[: waves + 1, : (degree + 1) ** 2] = True
    received = np.concatenate([gradients["sh_dc"], gradients["sh_rest"]], axis=2)
    assert np.array_equal(received.any(axis=(0, 1)), active.ravel())


def test_the_pipeline_against_a_loop():
    """Gaussian by Gaussian, from the inverse of the 4D covariance; culled below 0.05."""
    p, t, N = random_parameters(3, N=80), 0.7, 80
    p["log_s_t"][...] -= 1
    model, rows, weights = model_of(p), [], []
    g = model.predict(t, X_C)[0]
    waves = [np.cos(2 * np.pi * k * (t - p["mu_t"]))[:, None, None] for k in range(3)]
    stored = np.split(np.concatenate([p["sh_dc"], p["sh_rest"]], axis=2), 3, axis=2)
    sh_t = sum(wave * sh for wave, sh in zip(waves, stored))
    for n in range(N):
        l, r = (p[name][[n]] for name in ("raw_l", "raw_r"))
        R = rotation_4d.forward(l, r)[0][0]
        s = np.exp(np.append(p["log_s"][n], p["log_s_t"][n]))
        precision = R @ np.diag(s**-2.0) @ R.T
        Sigma = np.linalg.inv(precision[:3, :3])
        since, var_t = t - p["mu_t"][n], np.linalg.inv(precision)[3, 3]
        weight = np.exp(-(since**2) / (2 * var_t))
        weights.append(weight)
        if weight > 0.05:
            x = p["x"][n] - Sigma @ precision[:3, 3] * since
            i = len(rows)
            rows.append(n)
            assert g.x[i] == pytest.approx(x, rel=1e-10)
            assert g.Sigma[i] == pytest.approx(Sigma, rel=1e-9, abs=1e-12)
            alpha = weight / (1 + np.exp(-p["logit_alpha"][n]))
            assert g.alpha[i] == pytest.approx(alpha, rel=1e-12)
            d = (x - X_C) / np.linalg.norm(x - X_C)
            assert g.color[i] == pytest.approx(sh_color.forward(d[None], sh_t[[n]])[0][0])
    assert g.index.tolist() == rows
    near = [weight for weight in weights if 0.03 < weight < 0.08]
    assert min(near) < 0.05 < max(near), "the threshold lies between two Gaussians"


def test_a_gaussian_at_rest_is_one_of_3dgs():
    """With equal quaternions and at its own time: the picture of `render.forward`."""
    p, camera = random_parameters(2), look_at(X_C, (0, 0, 0), 30, 30, 24, 20)
    p["raw_l"][...] = p["raw_r"]
    p["mu_t"][...] = 0.3
    g = model_of(p).gaussians(0.3, camera)
    r = p["raw_r"] / np.linalg.norm(p["raw_r"], axis=1, keepdims=True)
    alpha = 1 / (1 + np.exp(-p["logit_alpha"]))
    looks = (camera, np.ones(3), EXACT)
    (image, *_), _ = render.forward(p["x"], np.exp(p["log_s"]), r, alpha, g.color, *looks)
    assert model_of(p).render(camera, 0.3, EXACT) == pytest.approx(image, abs=1e-12)
    assert np.ptp(image) > 0.1


def test_gradients_of_the_loss(scene):
    """One view from parameters to the loss, in float64 and with the exact renderer."""
    trainer = gaussian4d.Trainer(scene, SMALL, settings=EXACT)
    trainer.start(random_parameters(4))
    trainer.iteration, p, view = 59, trainer.parameters, scene.train[7]
    losses, seen, gradients, _ = trainer.gradients_of(view)
    assert losses.L_total == losses.L_render > 0 and len(seen.index) < 9 == len(seen.alpha)
    rng = np.random.default_rng(6)
    for name in p.arrays:
        d, h, start = rng.normal(size=p[name].shape), 1e-6, p[name].copy()
        values = []
        for step in (h, -h):
            p[name][...] = start + step * d
            values.append(trainer.gradients_of(view)[0].L_total)
        p[name][...] = start
        ours = float((gradients[name] * d).sum())
        assert ours == pytest.approx((values[0] - values[1]) / (2 * h), rel=2e-5, abs=1e-9), name


# --- training ---
def test_training_is_repeatable_and_learns(scene, trained):
    again = gaussian4d.Trainer(scene, SMALL, seed=1).run()
    assert np.array_equal(again.parameters.vector, trained.parameters.vector)
    assert trained.primitives != SMALL.gaussians
    start = gaussian4d.Trainer(scene, SMALL, seed=1).model()
    ends = [evaluate(model, scene)[0]["psnr_db"] for model in (start, trained)]
    assert ends[1] > ends[0] + 1


def test_rates_of_positions_follow_the_extent(scene):
    trainer = gaussian4d.Trainer(scene, replace(gaussian4d.PAPER_SYNTHETIC, gaussians=10))
    for iteration, rate_x in ((0, 1.6e-4), (15_000, 1.6e-5), (30_000, 1.6e-6)):
        trainer.iteration = iteration
        assert trainer.rate_of("x") == pytest.approx(rate_x * trainer.extent)
        assert trainer.rate_of("mu_t") == pytest.approx(1.6e-4 * trainer.extent)
        assert trainer.rate_of("log_s_t") == trainer.rate_of("log_s") == 0.005
        assert trainer.rate_of("raw_l") == trainer.rate_of("raw_r") == 0.001


def test_the_first_gaussians_are_those_of_the_authors():
    p = gaussian4d.Gaussian4D.initial(
        replace(gaussian4d.PAPER_SYNTHETIC, gaussians=4000), np.random.default_rng(0)
    )
    assert sum(a.size for a in p.values()) == 4000 * 161
    assert p["mu_t"].min() >= -0.1 and p["mu_t"].max() <= 1.1
    assert p["mu_t"].mean() == pytest.approx(0.5, abs=0.02) and np.ptp(p["mu_t"]) > 1.19
    assert np.exp(2 * p["log_s_t"]) == pytest.approx(np.full((4000, 1), 0.2))


def test_children_are_drawn_from_their_parent_in_space_and_time(scene):
    """Mean and covariance of many children are those of the 4D Gaussian; they shrink by 1.6."""
    trainer, N = gaussian4d.Trainer(scene, SMALL), 200_000
    p = random_parameters(8)
    rows = model_of(p).rows
    children = {name: np.repeat(p[name][:1], N, axis=0) for name in rows}
    trainer.scatter(children)
    R, _ = rotation_4d.forward(p["raw_l"][:1], p["raw_r"][:1])
    log_s = np.append(p["log_s"][0], p["log_s_t"][0])
    places = np.concatenate([children["x"], children["mu_t"][:, None]], axis=1)
    middle = np.append(p["x"][0], p["mu_t"][0])
    assert places.mean(axis=0) == pytest.approx(middle, abs=0.005)
    Sigma = R[0] @ np.diag(np.exp(2 * log_s)) @ R[0].T
    assert np.cov(places.T) == pytest.approx(Sigma, abs=0.02 * Sigma.max())
    assert children["log_s"][0] == pytest.approx(log_s[:3] - np.log(1.6))
    assert children["log_s_t"][0] == pytest.approx(log_s[3:] - np.log(1.6))
    for name in set(rows) - {"x", "mu_t", "log_s", "log_s_t"}:
        assert np.array_equal(children[name][-1], p[name][0]), name


# --- file ---
def test_the_file_is_read_back(scene, trained, tmp_path):
    """161 numbers a Gaussian, no normals and no network."""
    sizes = trained.save(tmp_path / "a.ply")
    assert sum(sizes.values()) == (tmp_path / "a.ply").stat().st_size
    assert sizes["gaussians"] == 4 * 161 * trained.primitives and sizes["network"] == 0
    assert sizes["other"] < 6000
    model = baselines.load(tmp_path / "a.ply")
    assert set(model.parameters.arrays) == set(trained.parameters.arrays)
    for name, a in trained.parameters.arrays.items():
        assert np.array_equal(model.parameters[name], a), name
    view = scene.test[0]
    images = [m.render(view.camera, view.time) for m in (trained, model)]
    assert np.array_equal(*images)


def test_presets_by_method():
    assert baselines.choose("gaussian4d") == gaussian4d.TINY
    changed = baselines.choose("gaussian4d", "paper_synthetic", {"start_s_t": "0.1"})
    assert changed.start_s_t == 0.1 and changed.gaussians == 300_000
