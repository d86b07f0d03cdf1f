"""How far an equation is from the true values of a hard case."""

from typing import NamedTuple

import numpy as np

from ...oracle.compare import cast
from ...table import EQUATIONS

SMALLEST = 1e-44  # differences below are no errors: float32 cannot hold them


class Measured(NamedTuple):
    """One case in one precision. Errors are relative; None where there is nothing to compare."""

    literal: object  # the result of the printed formula, or of the usual shortcut
    ours: object
    true: object
    error: float
    grad_error: float | None
    bound: float
    grad_bound: float | None


def measure(case, dtype):
    """Run an equation forward and backward on a case in one precision."""
    inputs, cotangents = cast(case.inputs, dtype), cast(case.cotangents, dtype)
    equation = EQUATIONS[case.equation]
    outputs, pullback = equation.vjp(**inputs)
    gradients = pullback(**cotangents) if equation.gradients else {}
    bars = {name + "_bar": a for name, a in gradients.items()}
    error = _worst(outputs, case.true, case.each)
    grad_error = _worst(bars, case.true, False)
    bound, grad_bound = case.bounds[dtype]
    name, index = case.shown
    return Measured(
        case.literal[dtype],
        number(pick({**outputs, **bars}[name], index)),
        number(pick(case.true[name], index)),
        np.nan if error is None else error,
        grad_error,
        bound,
        None if grad_error is None else grad_bound,
    )


def _worst(found, true, each):
    """The largest error of all arrays with true values; None without any."""
    errors = [relative(a, true[name], each) for name, a in found.items() if name in true]
    return max(errors, default=None)


def pick(values, index):
    """One number of an array, or of a list of arrays, whose first index says which array."""
    if isinstance(values, list):
        values, index = values[index[0]], index[1:]
    return np.asarray(values)[index]


def number(value):
    """A number that JSON can hold: infinities and NaN become text."""
    value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value


def relative(got, want, each):
    """The largest error, relative to each number or to the largest of its array.

    Where the true value is 0 the error is absolute; where it is NaN there is nothing to compare.
    """
    if isinstance(got, list):
        return max((relative(g, w, each) for g, w in zip(got, want, strict=True)), default=0.0)
    got, want = np.asarray(got, float), np.asarray(want, float)
    if got.shape != want.shape and (got.size or want.size):
        return float("inf")
    compared = ~np.isnan(want)
    if not compared.any():
        return 0.0
    got, want = got[compared], want[compared]
    gap = np.where(got == want, 0, np.abs(got - want))
    gap[gap < SMALLEST] = 0
    scale = np.abs(want) if each else np.abs(want).max()
    errors = gap / np.where(scale > 0, scale, 1)
    return float(np.nan_to_num(errors, nan=np.inf, posinf=np.inf).max())
