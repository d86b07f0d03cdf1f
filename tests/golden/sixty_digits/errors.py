"""How far the NumPy equations are from the decimal ones, in units of eps times the size of what they add up."""

import zlib
from decimal import Decimal

import numpy as np

from p4dgs_ref import splatting  # noqa: F401  declares covariance, projection and compositing
from p4dgs_ref.equations import EQUATIONS
from .floats import to_float, wrapped
from .functions import working
from .gradients import gradient, value


def error(key, case, dtype=np.float64, scale=None, samples=None):
    """The worst error of every array of one case: {"out.x": eps S, "in_bar.weights.0": eps S, ...}.

    Shapes     scale {"out.x": S}, arrays or numbers; by default S is the largest magnitude in the array
    Units      eps of `dtype` times S; infinite where a whole number, a mask, an infinity or a shape is wrong
    Domain     gradients where there is one: not on kinks; `samples` elements of each array if given
    Raises     OverflowError where inputs leave the range of `dtype`
    """
    eq = EQUATIONS[key]
    inputs, eps = cast(case.inputs, dtype), float(np.finfo(dtype).eps)
    out, res = eq.forward(**inputs)
    bars = cast(cotangents(eq, case, out._asdict()), dtype)
    got, want = flat(out._asdict(), "out."), flat(value(key, inputs), "out.")
    if eq.differentiable:
        got |= flat(eq.backward(res, **bars), "in_bar.")
        want |= flat(gradient(key, inputs, bars, samples=samples), "in_bar.")
    if set(want) - set(got):
        raise ValueError(
            f"{key}, case {case.name}: the reference lacks {sorted(set(want) - set(got))}"
        )
    return {name: _worst(got[name], want[name], (scale or {}).get(name), eps) for name in want}


def _worst(got, want, S, eps):
    """The largest of |got - want| / (eps S); 0 for what is the nearest float."""
    got = np.asarray(got)
    if got.shape != want.shape:
        return float("inf")
    if got.dtype.kind != "f":
        return 0.0 if np.array_equal(wrapped(got), want) else float("inf")
    if S is None:
        S = np.abs(got[np.isfinite(got)]).max(initial=0)
    off = [
        _off(g, w, s, eps)
        for g, w, s in zip(got.ravel(), want.ravel(), np.broadcast_to(S, got.shape).ravel())
        if not w.is_nan()
    ]
    return max(off, default=0.0)


def _off(got, want, S, eps):
    if got == to_float(want, got.dtype):
        return 0.0
    if not (np.isfinite(got) and want.is_finite() and S > 0):
        return float("inf")
    with working():
        return float(abs(Decimal(float(got)) - want) / (Decimal(float(S)) * Decimal(eps)))


def flat(values, prefix):
    """{"weights": [W]} -> {"in_bar.weights.0": W}."""
    arrays = {}
    for name, a in values.items():
        arrays.update(
            {f"{prefix}{name}.{i}": b for i, b in enumerate(a)}
            if isinstance(a, list)
            else {prefix + name: a}
        )
    return arrays


def cast(values, dtype):
    """Float arrays in another precision; everything else stays."""

    def change(a):
        if isinstance(a, list):
            return [change(b) for b in a]
        if not isinstance(a, (np.ndarray, np.generic)) or a.dtype.kind != "f":
            return a
        with np.errstate(over="ignore", under="ignore"):
            b = a.astype(dtype)
        if (np.isfinite(a) & ~np.isfinite(b)).any():
            raise OverflowError(f"inputs beyond the largest {np.dtype(dtype).name}")
        return b

    return {name: change(a) for name, a in values.items()}


def cotangents(eq, case, out):
    """The case's own, else normal numbers drawn by its name; of every float output."""
    rng = np.random.default_rng(zlib.crc32(f"{eq.key}/{case.name}".encode()))
    return {
        name + "_bar": case.cotangents.get(
            name + "_bar", np.asarray(rng.standard_normal(np.shape(a)))
        )
        for name, a in out.items()
        if np.asarray(a).dtype.kind == "f" and eq.differentiable
    }
