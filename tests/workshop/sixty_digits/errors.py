"""How far the NumPy equations are from the decimal ones, in eps times the size of their terms."""

from decimal import Decimal

import numpy as np

from p4dgs_ref import EQUATIONS
from p4dgs_ref.oracle.compare import cast
from p4dgs_ref.oracle.published import flatten
from p4dgs_ref.oracle.tolerance import cotangents_of

from .floats import to_float, wrapped
from .functions import working
from .gradients import gradient, value


def error(key, case, dtype=np.float64, scale=None, samples=None):
    """The worst error of every array of one case: {"out.x": ..., "in_bar.weights.0": ..., ...}.

    Errors are in units of eps S, with the eps of `dtype`. `scale` gives S as arrays or numbers,
    {"out.x": S}; otherwise S is the largest magnitude in the array. An error is infinite where an
    integer, a mask, an infinity or a shape is wrong. `samples` limits the elements of each gradient
    array. Raises OverflowError where inputs leave the range of `dtype`.
    """
    eq, eps = EQUATIONS[key], float(np.finfo(dtype).eps)
    inputs = held(case.inputs, dtype)
    outputs, pullback = eq.vjp(**inputs)
    got, want = flatten(outputs, "out."), flatten(value(key, inputs), "out.")
    if eq.gradients:
        bars = cotangents_of(eq, outputs, f"{key}/{case.name}") | case.cotangents
        bars = held(bars, dtype)
        got |= flatten(pullback(**bars), "in_bar.")
        want |= flatten(gradient(key, inputs, bars, samples=samples), "in_bar.")
    if missing := sorted(set(want) - set(got)):
        raise ValueError(f"{key}, case {case.name}: the NumPy equation lacks {missing}")
    return {name: _worst(got[name], want[name], (scale or {}).get(name), eps) for name in want}


def held(values, dtype):
    """Values in another precision; raises OverflowError where they leave its range."""
    with np.errstate(over="ignore", under="ignore"):
        result = cast(values, dtype)
    wide, narrow = flatten(values), flatten(result)
    if any((np.isfinite(a) & ~np.isfinite(narrow[n])).any() for n, a in wide.items()):
        raise OverflowError(f"inputs beyond the largest {np.dtype(dtype).name}")
    return result


def _worst(got, want, S, eps):
    """The largest |got - want| / (eps S); 0 for the nearest floats."""
    got = np.asarray(got)
    if got.shape != want.shape:
        return float("inf")
    if got.dtype.kind != "f":
        return 0.0 if np.array_equal(wrapped(got), want) else float("inf")
    if S is None:
        S = np.abs(got[np.isfinite(got)]).max(initial=0)
    sizes = np.broadcast_to(S, got.shape).ravel()
    elements = zip(got.ravel(), want.ravel(), sizes)
    return max((_off(g, w, s, eps) for g, w, s in elements if not w.is_nan()), default=0.0)


def _off(got, want, S, eps):
    """The error of one number."""
    if got == to_float(want, got.dtype):
        return 0.0
    if not (np.isfinite(got) and want.is_finite() and S > 0):
        return float("inf")
    with working():
        return float(abs(Decimal(float(got)) - want) / (Decimal(float(S)) * Decimal(eps)))
