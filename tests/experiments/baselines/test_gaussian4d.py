"""4DGS: its pipeline and gradients, training and density control in 4D."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from p4dgs_ref.lab.baselines import gaussian4d, rotation_4d, sh_color

from . import small

X_C = np.array([0.3, -3.0, 1.0])
SMALL = small.SMALL["gaussian4d"]
random_parameters = partial(small.random_parameters, "gaussian4d")
model_of = partial(small.model_of, "gaussian4d")


# --- pipeline ---


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


# --- training ---


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
    rows = set(gaussian4d.Gaussian4D.PROPERTIES)
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
    for name in rows - {"x", "mu_t", "log_s", "log_s_t"}:
        assert np.array_equal(children[name][-1], p[name][0]), name
