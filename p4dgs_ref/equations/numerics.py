"""The functions of the paper whose textbook form loses digits, written so that they do not.

The equations call them by name, so that the file of an equation can show the paper's formula.
"""

import numpy as np
from scipy.special import expit as sigmoid

EPSILON = 1e-12  # keeps the value and the gradient of a normalised zero quaternion finite


def sigmoid_slope(y):
    """Return sigmoid'(y).

    The textbook s * (1 - s) is 0 as soon as s rounds to 1; 1 - s is sigmoid(-y).
    """
    return sigmoid(y) * sigmoid(-y)


def tanh_slope(y):
    """Return tanh'(y).

    The textbook 1 - tanh(y)**2 cancels where tanh is close to 1 in magnitude.
    """
    e = np.exp(-2 * np.abs(y))
    return 4 * e / (1 + e) ** 2


def in_precision_of(x, number):
    """Convert `number` so that a scalar x keeps its precision in a product or quotient with it.

    NumPy 1 returns float64 for a float32 scalar times a Python number, NumPy 2 float32.
    """
    return np.float32(number) if np.asarray(x).dtype == np.float32 else number


def length(v):
    """Return |v| [..., 1] of vectors [..., 3] or quaternions [..., 4].

    The textbook square root of a sum of squares overflows for components of 1e200 and is 0 for
    1e-200 (in float32: 1e20 and 1e-25); hypot does neither.
    """
    x, y, *rest = np.moveaxis(v, -1, 0)
    z = np.hypot(*rest) if len(rest) == 2 else rest[0]
    return np.hypot(np.hypot(x, y), z)[..., None]


def normalise(r):
    """Return the unit quaternions [..., 4] along r and the norms [..., 1] by which r was divided.

    The norm is sqrt(|r|**2 + EPSILON**2), so that r = 0 gives 0 with a finite slope (Q4).
    """
    norm = np.hypot(length(r), EPSILON)
    return r / norm, norm


def normalise_backward(unit, norm, unit_bar):
    """Return the gradient of r from what `normalise` returned and the cotangent of `unit`.

    The derivative is (I - unit unit^T) / norm, where |unit|**2 is 1 - (EPSILON / norm)**2.
    """
    return (perpendicular(unit, unit_bar) + (EPSILON / norm) ** 2 * unit_bar) / norm


def perpendicular(unit, v):
    """Return the component of v [..., n] perpendicular to the unit vector `unit` [..., n].

    In the textbook v - unit (unit . v), the entry of an axis that `unit` nearly follows is a
    difference of nearly equal numbers. As a sum of 2 x 2 minors, v |unit|**2 - unit (unit . v), it
    keeps its digits.
    """
    products = np.einsum("...i,...j->...ij", v, unit)
    return np.einsum("...ij,...j->...i", products - products.swapaxes(-1, -2), unit)
