"""The functions of numerics.py where their textbook forms lose digits."""

import numpy as np
import pytest

from p4dgs_ref.equations import numerics


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
