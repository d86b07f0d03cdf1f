"""The functions of numerics.py where their textbook forms lose digits."""

import math

import numpy as np
import pytest

from p4dgs_ref.equations import anchor_rate, numerics


def close(got, want, rel=1e-14):
    """Assert agreement entry by entry, relative to each entry."""
    np.testing.assert_allclose(got, want, rtol=rel, atol=0)


@pytest.mark.parametrize("x", [np.float32(3), np.array(3, np.float32), np.float64(3), 3.0])
def test_scalars_keep_their_precision(x):
    dtype = np.asarray(x).dtype
    tenth = numerics.in_precision_of(x, 0.1)
    for result in (tenth * x, x / tenth):
        assert np.asarray(result).dtype == dtype
    assert tenth == dtype.type(0.1)


def test_normalising_the_zero_quaternion():
    unit, norm = numerics.normalise(np.zeros((1, 4)))
    bar = np.array([[3.0, -5, 7, 11]])
    assert np.array_equal(unit, np.zeros((1, 4)))
    close(numerics.normalise_backward(unit, norm, bar), bar / numerics.EPSILON)


def test_a_quaternion_gets_no_gradient_along_itself():
    unit, norm = numerics.normalise(np.array([[1.0, 2, 2, 4]]))
    along = numerics.normalise_backward(unit, norm, unit)
    assert np.abs(along).max() <= 1e-16
    across = np.array([[2.0, -1, 0, 0]])
    close(numerics.normalise_backward(unit, norm, across), across / 5)


@pytest.mark.slow
@pytest.mark.parametrize("dtype, error", [("float64", 1e-11), ("float32", 1.2e-7)])
def test_a_hundred_million_bits_are_added_up(dtype, error):
    """H-R7: a sum in float32 that adds one number after the other is off by 1 %."""
    row = (2 + np.sin(np.arange(100.0))).astype(dtype)
    bits_f = np.broadcast_to(row, (10**6, 100))
    none, no_children = np.zeros((10**6, 3), dtype), np.zeros((10**6, 0, 3), dtype)
    R_anchor, _ = anchor_rate.forward(
        bits_f=bits_f, bits_s=none, bits_l=none, bits_O=no_children, mask=no_children[..., 0] > 0
    )
    assert float(R_anchor) == pytest.approx(10**6 * math.fsum(row.tolist()), rel=error)
