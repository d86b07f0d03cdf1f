"""Spatial and temporal equations against slow twins written from the printed formulas."""

import math

import numpy as np
import pytest

from p4dgs_ref.equations import deformation, deformed, masking, positional_encoding, view
from tests.golden.cases import cases_of


def ordinary(key):
    """The inputs of an equation's ordinary case."""
    return next(case.inputs for case in cases_of(key) if case.name == "ordinary")


def encode(p, L):
    """The positional encoding of one vector, in the math module."""
    waves = [wave(2.0**j * v) for j in range(L) for wave in (math.sin, math.cos) for v in p]
    return [*p, *waves]


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-15), (np.float32, 2e-7)])
def test_positional_encoding_against_a_loop(dtype, tolerance):
    p = np.random.default_rng(5).uniform(-1.3, 1.3, size=(11, 3)).astype(dtype)
    E, _ = positional_encoding.forward(p, 10)
    assert np.abs(E - [encode(row.tolist(), 10) for row in p]).max() <= tolerance


def test_view_against_math_dist():
    inputs = ordinary("view")
    x_c = inputs["x_c"]
    (distances, directions), _ = view.forward(**inputs)
    for x, delta, d in zip(inputs["x_a"], distances, directions):
        assert delta == pytest.approx(math.dist(x, x_c), rel=1e-15)
        assert x_c + delta * d == pytest.approx(x, rel=1e-14)
        assert math.hypot(*d) == pytest.approx(1, rel=1e-15)


def test_masking_against_a_loop():
    inputs = ordinary("masking")
    kept = [
        (a, j)
        for a, row in enumerate(inputs["alpha"])
        for j, alpha in enumerate(row)
        if inputs["mask"][a, j] and not alpha < inputs["tau_alpha"]
    ]
    (*attributes, index), _ = masking.forward(**inputs)
    assert 0 < len(kept) < inputs["alpha"].size
    assert index.dtype == np.int64 and len(index) == len(kept)
    for n, (a, j) in enumerate(kept):
        assert index[n] == a * inputs["alpha"].shape[1] + j
        for name, values in zip(("alpha", "x", "color", "s", "r"), attributes, strict=True):
            assert np.array_equal(values[n], inputs[name][a, j])


def test_deformation_against_a_loop():
    inputs = ordinary("deformation")
    weights, biases = inputs["weights"], inputs["biases"]
    deltas, _ = deformation.forward(**inputs)
    for n, x in enumerate(inputs["x"]):
        hidden = encode(x, inputs["L_x"]) + encode([inputs["t"]], inputs["L_t"])
        for W, b in zip(weights[:-3], biases[:-3]):
            hidden = [
                max(0.0, math.fsum([*(h * w for h, w in zip(hidden, column)), c]))
                for column, c in zip(W.T, b)
            ]
        for delta, W, b in zip(deltas, weights[-3:], biases[-3:], strict=True):
            assert delta[n] == pytest.approx(np.array(hidden) @ W + b, rel=1e-12, abs=1e-14)


def test_deformation_without_the_gradient_of_x():
    deltas, saved = deformation.forward(**ordinary("deformation"))
    rng = np.random.default_rng(6)
    cotangents = [rng.normal(size=delta.shape) for delta in deltas]
    full = deformation.backward(saved, *cotangents)
    lean = deformation.backward(saved, *cotangents, needs_x=False)
    assert set(full) - set(lean) == {"x"}
    for name in lean:
        for a, b in zip(lean[name], full[name], strict=True):
            assert np.array_equal(a, b)


def test_deformed_passes_what_is_off_through_untouched():
    x, s, r = np.ones((5, 3)), np.ones((5, 3)), np.full((5, 4), 2.0)
    off = np.zeros((5, 0))
    (x_t, s_t, r_t), _ = deformed.forward(x, s, r, np.ones((5, 3)), off, off)
    assert s_t is s and r_t is r
    assert np.array_equal(x_t, np.full((5, 3), 2.0))


def test_eq_6_as_printed_leaves_the_length_of_the_quaternion():
    inputs = ordinary("deformed")
    unit, _ = deformed.forward(**inputs)
    printed, saved = deformed.as_printed(**inputs)
    assert np.array_equal(printed[2], inputs["r"] + inputs["delta_r"])
    length = np.linalg.norm(printed[2], axis=1, keepdims=True)
    assert np.abs(length - 1).max() > 0.1
    assert np.allclose(printed[2] / length, unit[2], rtol=1e-14, atol=0)
    bars = [np.random.default_rng(7).normal(size=a.shape) for a in printed]
    gradients = deformed.backward(saved, *bars)
    for name, bar in zip(("x", "s", "r"), bars):  # each output is a sum of its two inputs
        assert np.array_equal(gradients[name], bar)
        assert np.array_equal(gradients[f"delta_{name}"], bar)
