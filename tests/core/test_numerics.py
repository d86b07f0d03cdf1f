"""The functions of numerics.py where their textbook forms lose digits."""

import numpy as np
import pytest

from p4dgs_ref.equations import numerics


def close(got, want, rel=1e-14):
    """Assert agreement entry by entry, relative to each entry."""
    np.testing.assert_allclose(got, want, rtol=rel, atol=0)


def test_slope_of_the_sigmoid_where_it_saturates():
    y = np.array([40.0, -40.0, 0.0])
    close(numerics.sigmoid_slope(y), [np.exp(-40), np.exp(-40), 0.25])
    s = numerics.sigmoid(y)
    assert (s * (1 - s))[0] == 0  # the textbook form


def test_slope_of_the_tanh_where_it_saturates():
    y = np.array([20.0, -20.0, 0.0])
    close(numerics.tanh_slope(y), [4 * np.exp(-40), 4 * np.exp(-40), 1])
    assert (1 - np.tanh(y) ** 2)[0] == 0  # the textbook form


@pytest.mark.parametrize("x", [np.float32(3), np.array(3, np.float32), np.float64(3), 3.0])
def test_scalars_keep_their_precision(x):
    dtype = np.asarray(x).dtype
    tenth = numerics.in_precision_of(x, 0.1)
    for result in (tenth * x, x / tenth):
        assert np.asarray(result).dtype == dtype
    assert tenth == dtype.type(0.1)


@pytest.mark.parametrize("dtype, size", [(np.float64, 1e200), (np.float32, 1e25)])
def test_lengths_of_large_and_small_vectors(dtype, size):
    vector = np.array([[3, -4, 12]], dtype)
    quaternion = np.array([[[1, -2, 2, 4]]], dtype)
    for scale in (dtype(size), 1 / dtype(size)):
        close(numerics.length(scale * vector), [[13 * scale]], np.finfo(dtype).eps * 4)
        close(numerics.length(scale * quaternion), [[[5 * scale]]], np.finfo(dtype).eps * 4)
        assert numerics.length(scale * vector).dtype == dtype


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


def test_perpendicular_component_along_an_axis_that_is_nearly_followed():
    e = 2.0**-30
    unit = np.array([1, e, 0]) / np.sqrt(1 + e**2)
    v = np.array([1.0, 0, 0])
    want = np.array([e**2, -e, 0]) / (1 + e**2)
    close(numerics.perpendicular(unit, v), want)
    textbook = v - unit * (unit @ v)
    assert abs(textbook[0] - want[0]) > 0.5 * want[0]
