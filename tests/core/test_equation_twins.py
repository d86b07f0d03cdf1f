"""Spatial and temporal equations against slow twins, written element by element from the printed formulas."""

import math

import numpy as np
import pytest

from p4dgs_ref.equations import deformation, deformed, masking, positional_encoding, view


def ordinary(module):
    return next(case.inputs for case in module.cases() if case.name == "ordinary")


def encode(p, L):
    return [*p, *(wave(2.0**j * v) for j in range(L) for wave in (math.sin, math.cos) for v in p)]


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-15), (np.float32, 2e-7)])
def test_positional_encoding_against_a_loop(dtype, tolerance):
    p = np.random.default_rng(5).uniform(-1.3, 1.3, size=(11, 3)).astype(dtype)
    E = positional_encoding.forward(p, 10)[0].E
    assert np.abs(E - [encode(row.tolist(), 10) for row in p]).max() <= tolerance


def test_view_against_math_dist():
    inputs = ordinary(view)
    x_c = inputs["x_c"]
    for x, delta, d in zip(inputs["x_a"], *view.forward(**inputs)[0]):
        assert delta == pytest.approx(math.dist(x, x_c), rel=1e-15)
        assert x_c + delta * d == pytest.approx(x, rel=1e-14) and math.hypot(*d) == pytest.approx(
            1, rel=1e-15
        )


def test_masking_against_a_loop():
    inputs = ordinary(masking)
    kept = [
        (a, j)
        for a, row in enumerate(inputs["alpha"])
        for j, alpha in enumerate(row)
        if inputs["mask"][a, j] and not alpha < inputs["tau_alpha"]
    ]
    out, _ = masking.forward(**inputs)
    assert 0 < len(kept) < inputs["alpha"].size and out.index.dtype == np.int64
    for n, (a, j) in enumerate(kept):
        assert out.index[n] == a * inputs["alpha"].shape[1] + j
        for name in ("alpha", "x", "color", "s", "r"):
            assert np.array_equal(getattr(out, name)[n], inputs[name][a, j])


def test_deformation_against_a_loop():
    inputs = ordinary(deformation)
    weights, biases = inputs["weights"], inputs["biases"]
    out, res = deformation.forward(**inputs)
    for n, x in enumerate(inputs["x"]):
        hidden = encode(x, inputs["L_x"]) + encode([inputs["t"]], inputs["L_t"])
        for W, b in zip(weights[:-3], biases[:-3]):
            hidden = [
                max(0.0, math.fsum([*(h * w for h, w in zip(hidden, column)), c]))
                for column, c in zip(W.T, b)
            ]
        for delta, W, b in zip(out, weights[-3:], biases[-3:]):
            assert delta[n] == pytest.approx(np.array(hidden) @ W + b, rel=1e-12, abs=1e-14)


def test_deformation_without_the_gradient_of_x():
    out, res = deformation.forward(**ordinary(deformation))
    rng = np.random.default_rng(6)
    cotangents = {name + "_bar": rng.normal(size=a.shape) for name, a in out._asdict().items()}
    full, lean = (
        deformation.backward(res, **cotangents),
        deformation.backward(res, **cotangents, needs_x=False),
    )
    assert set(full) - set(lean) == {"x"}
    assert all(
        np.array_equal(a, b) for name in lean for a, b in zip(lean[name], full[name], strict=True)
    )


def test_deformed_passes_what_is_off_through_untouched():
    x, s, r = np.ones((5, 3)), np.ones((5, 3)), np.full((5, 4), 2.0)
    out, _ = deformed.forward(x, s, r, np.ones((5, 3)), np.zeros((5, 0)), np.zeros((5, 0)))
    assert out.s_t is s and out.r_t is r and np.array_equal(out.x_t, np.full((5, 3), 2.0))
