"""4DHexPlane: its equations against twins, its pipeline, presets and first network."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from p4dgs_ref.lab.baselines import hexplane, plane_features
from p4dgs_ref.training.parameters import Parameters

from . import small

SMALL = small.SMALL["hexplane"]
random_parameters = partial(small.random_parameters, "hexplane")
model_of = partial(small.model_of, "hexplane")


# --- equations ---


# --- pipeline ---
def test_nothing_depends_on_the_time_at_the_start():
    """Planes in time are 1, so that the features are those of the planes in space."""
    p = Parameters(hexplane.HexPlane.initial(SMALL, np.random.default_rng(0)), np.float64)
    x_c = np.array([0.3, -3.0, 1.0])
    first, last = (model_of(p).predict(t, x_c)[0] for t in (0.0, 0.9))
    for a, b in zip(first, last):
        assert a == pytest.approx(b, rel=1e-12)


def test_the_pipeline_against_a_loop():
    """Gaussian by Gaussian, from the formulas at the head of the module."""
    p, x_c, t = random_parameters(3), np.array([2.0, 1.0, -1.0]), 0.7
    g = model_of(p).predict(t, x_c)[0]
    features, _ = plane_features.forward(p["x"], t, *p["box"], p.listed("planes"))
    W, b = p.network("psi")
    assert [w.shape for w in W[:2]] == [(4, 5), (5, 6)] and len(W) == 8
    for n, x in enumerate(p["x"]):
        h = np.maximum(np.maximum(features[n] @ W[0] + b[0], 0) @ W[1] + b[1], 0)
        delta_x, delta_log_s, delta_raw_r = (
            np.maximum(h @ W[i] + b[i], 0) @ W[i + 1] + b[i + 1] for i in (2, 4, 6)
        )
        r = p["raw_r"][n] + delta_raw_r
        assert g.x[n] == pytest.approx(x + delta_x, rel=1e-12)
        assert g.s[n] == pytest.approx(np.exp(p["log_s"][n] + delta_log_s), rel=1e-12)
        assert g.r[n] == pytest.approx(r / np.linalg.norm(r), rel=1e-12)
        assert g.alpha[n] == pytest.approx(1 / (1 + np.exp(-p["logit_alpha"][n])), rel=1e-12)


# --- presets ---
def test_the_planes_have_the_size_of_the_authors():
    preset = replace(hexplane.PAPER_SYNTHETIC, gaussians=5)
    p = Parameters(hexplane.HexPlane.initial(preset, np.random.default_rng(0)))
    sizes = [p[f"planes.{i}"].shape for i in range(12)]
    assert (
        sizes
        == [(64, 64, 32)] * 3 + [(64, 100, 32)] * 3 + [(128, 128, 32)] * 3 + [(128, 100, 32)] * 3
    )
    assert [W.shape for W in p.network("psi")[0]] == [
        (64, 64),
        *((64, 64), (64, 3)) * 2,
        *((64, 64), (64, 4)),
    ]
    space, time = p["planes.1"], p["planes.3"]
    assert space.min() >= 0.1 and space.max() <= 0.5 and np.std(space) > 0.1
    assert np.all(time == 1)
    bound = np.sqrt(6 / 67)
    assert 0.95 * bound < np.abs(p["psi.W2"]).max() <= bound
