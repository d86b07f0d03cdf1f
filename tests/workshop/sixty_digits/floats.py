"""From floats to decimals, exactly, and back, correctly rounded."""

from decimal import Decimal

import numpy as np

from .functions import DIGITS, working

# The place of the next number after the largest float32. Rounding to it gives infinity.
BEYOND_FLOAT32 = Decimal(2**128)


def exact(a):
    """Every float as its exact decimal: arrays of objects for arrays, lists for lists.

    Masks and settings stay as they are.
    """
    if isinstance(a, list):
        return [exact(b) for b in a]
    is_array = isinstance(a, (np.ndarray, np.generic)) and np.asarray(a).dtype.kind in "fiu"
    if isinstance(a, float) or is_array:
        return each(Decimal, np.asarray(a).astype(object))
    return a


def each(function, *arrays):
    """Apply a function of decimals element by element; single numbers give a single number."""
    return np.frompyfunc(function, len(arrays), 1)(*arrays)


def wrapped(a):
    """An output as an array of decimals, also where it holds integers or masks (0, 1)."""
    a = np.asarray(a, object)
    decimals = [v if isinstance(v, Decimal) else Decimal(int(v)) for v in a.ravel()]
    return np.array(decimals, object).reshape(a.shape)


def to_float(a, dtype=np.float64):
    """The nearest floats, ties to even, of an array of decimals.

    Python rounds a decimal to a double correctly. A float32 taken from that double would be rounded
    twice, which goes wrong where the double is a tie between two float32 and the decimal is not.
    Therefore the candidate and its two neighbours are compared with the decimal itself.
    """
    nearest = {"d": float, "f": _nearest_float32}[np.dtype(dtype).char]
    a = np.asarray(a, object)
    with working():  # otherwise distances would be rounded to the 28 digits of Python's context
        return np.array([nearest(v) for v in a.ravel()], dtype).reshape(a.shape)


def _nearest_float32(x):
    with np.errstate(over="ignore", under="ignore"):
        first = np.float32(float(x))
        near = [first, *(np.nextafter(first, np.float32(side)) for side in (-np.inf, np.inf))]
    # Where x is a tie, `min` keeps the first of equals, which is rounded to even.
    return min(near, key=lambda c: abs(_value(c) - x)) if x.is_finite() else first


def _value(c):
    return Decimal(float(c)) if np.isfinite(c) else BEYOND_FLOAT32.copy_sign(Decimal(float(c)))


def text(x, digits=50):
    """A decimal with that many significant digits, correctly rounded, for tables of constants."""
    if not 0 < digits <= DIGITS:
        raise ValueError(f"digits = {digits}: expected 1 to {DIGITS}")
    return f"{x:.{digits - 1}e}"
