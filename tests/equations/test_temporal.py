"""Eqs. (5) and (6): what no vector shows: no gradient of x, effects that are off, as printed."""

import numpy as np

from p4dgs_ref.equations import deformed
from tests.golden.cases import case_of


def test_deformed_passes_what_is_off_through_untouched():
    x, s, r = np.ones((5, 3)), np.ones((5, 3)), np.full((5, 4), 2.0)
    off = np.zeros((5, 0))
    (x_t, s_t, r_t), _ = deformed.forward(x, s, r, np.ones((5, 3)), off, off)
    assert s_t is s and r_t is r
    assert np.array_equal(x_t, np.full((5, 3), 2.0))


def test_eq_6_as_printed_leaves_the_length_of_the_quaternion():
    inputs = case_of("deformed").inputs
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
