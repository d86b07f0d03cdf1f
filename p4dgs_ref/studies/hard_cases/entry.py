"""One entry of the catalogue of hard cases, and how an equation's is judged against its true values."""

import json
import zlib
from functools import cache
from pathlib import Path
from typing import Callable, NamedTuple

import numpy as np

from ... import splatting  # noqa: F401  declares covariance, projection, compositing
from ...equations import EQUATIONS
from ...equations.equation import Case

CONSTANTS = Path(__file__).with_name("constants.json")
DTYPES = {"float64": np.float64, "float32": np.float32}
LEAST = 1e-44  # what float32 cannot hold counts as 0
FEW = (
    64  # eps: the bound of most entries, a few roundings of terms a few times larger than their sum
)


class Measured(NamedTuple):
    """What an entry gives in one precision; errors relative, None where there is nothing to differentiate."""

    literal: object  # what the printed formula, or the usual shortcut, gives
    ours: object
    true: object
    error: float
    grad_error: float | None
    bound: float
    grad_bound: float | None


class Entry(NamedTuple):
    """A row of the catalogue in one of its inputs."""

    id: str  # "H-R1.6sigma": the row, then which of its inputs
    equation: str  # key of the equation, or part of the codec, the loss, the optimiser
    says: str  # what is hard, and what literal means here
    measure: Callable  # (dtype) -> Measured
    case: Case | None = None


@cache
def constants():
    """{case id: {array: nested lists of floats, None where there is no derivative}}, rounded from 50 digits."""

    def read(value):
        return (
            [read(v) for v in value]
            if isinstance(value, list)
            else np.nan
            if value is None
            else float(value)
        )

    cases = json.loads(CONSTANTS.read_text(encoding="utf-8"))["cases"] if CONSTANTS.exists() else {}
    return {
        name: {array: read(values) for array, values in arrays.items()}
        for name, arrays in cases.items()
    }


def single(value):
    """The float32 nearest to each number, as float64: an input that both precisions hold, so that they share a truth."""
    return np.asarray(value, np.float32).astype(np.float64)


def hard(
    id,
    key,
    says,
    inputs,
    headline,
    literal,
    flags,
    expected=None,
    smooth=True,
    value=None,
    grad=None,
    each=True,
):
    """An entry that is a case of an equation.

    Takes      inputs in float64 (made to hold in float32); headline (array, index): the number shown; literal(inputs
               and cotangents) -> what the printed formula makes of it; expected: closed forms, else 50-digit constants;
               value, grad: bounds (float64, float32), relative, default FEW eps; each: values relative to themselves, not
               to their array's largest
    """
    inputs = {
        name: [single(b) for b in a]
        if isinstance(a, list)
        else single(a)
        if isinstance(a, np.ndarray) and a.dtype.kind == "f"
        else a
        for name, a in inputs.items()
    }
    eq, case = EQUATIONS[key], Case(id, inputs, flags, smooth, {}, expected or {})
    case = case._replace(cotangents=_cotangents(eq, case))
    names = ("float64", "float32")
    few = [FEW * float(np.finfo(DTYPES[name]).eps) for name in names]

    def measure(dtype):
        i = names.index(dtype)
        return _measure(
            eq,
            case,
            dtype,
            headline,
            literal,
            dict(zip(names, value or few))[dtype],
            dict(zip(names, grad or few))[dtype] if eq.differentiable else None,
            each,
        )

    return Entry(id, key, says, measure, case)


def _cotangents(eq, case):
    """Normal numbers that float32 holds, the same at every call, for every float output."""
    rng = np.random.default_rng(zlib.crc32(case.name.encode()))
    with np.errstate(all="ignore"):
        out = eq.forward(**case.inputs)[0]._asdict()
    return {
        name + "_bar": single(rng.normal(size=np.shape(a)))
        for name, a in out.items()
        if eq.differentiable and a is not None and np.asarray(a).dtype.kind == "f"
    }


def cast(values, dtype):
    """Float arrays in another precision; everything else as it is."""

    def change(a):
        if isinstance(a, list):
            return [change(b) for b in a]
        return (
            np.asarray(a, dtype)
            if isinstance(a, (np.ndarray, np.generic)) and a.dtype.kind == "f"
            else a
        )

    return {name: change(a) for name, a in values.items()}


def _measure(eq, case, dtype, headline, literal, bound, grad_bound, each):
    inputs, bars = (cast(a, DTYPES[dtype]) for a in (case.inputs, case.cotangents))
    out, res = eq.forward(**inputs)
    got, gradients = out._asdict(), eq.backward(res, **bars) if eq.differentiable else {}
    bars_of = {name + "_bar": a for name, a in gradients.items()}
    true = {**constants().get(f"{eq.key}/{case.name}", {}), **case.expected}
    error = max(
        [relative(got[name], true[name], each) for name in got if name in true], default=np.nan
    )
    grad_error = max(
        [relative(a, true[name], False) for name, a in bars_of.items() if name in true],
        default=None,
    )
    name, index = headline
    with np.errstate(all="ignore"):
        shown = number(literal({**inputs, **bars}))
    ours = {**got, **bars_of}[name]
    return Measured(
        shown,
        _pick(ours, index, ours),
        _pick(true[name], index, ours),
        error,
        grad_error,
        bound,
        grad_bound if grad_error is not None else None,
    )


def _pick(values, index, like):
    """One number of an array, or of a list of arrays, whose first index then says which."""
    if isinstance(like, list):
        values, index = values[index[0]], index[1:]
    return number(np.asarray(values)[index])


def number(value):
    """A number that JSON can hold: infinities and NaN as text."""
    value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
    return value if not isinstance(value, float) or np.isfinite(value) else str(value)


def relative(got, want, each):
    """The largest error: relative to each number, or to the largest of its array; absolute where all are 0."""
    worst = 0.0
    pairs = zip(got, want, strict=True) if isinstance(got, list) else [(got, want)]
    for g, w in pairs:
        g, w = np.asarray(g, float), np.asarray(w, float)
        if g.size == w.size == 0:
            continue
        if g.shape != w.shape:
            return float("inf")
        there = ~np.isnan(w)  # NaN among constants: no derivative there
        if not there.any():
            continue
        g, w = g[there], w[there]
        off = np.where(g == w, 0, np.abs(g - w))
        off[off < LEAST] = 0
        scale = np.abs(w) if each else np.abs(w).max()
        worst = max(
            worst,
            float(
                np.nan_to_num(off / np.where(scale > 0, scale, 1), nan=np.inf, posinf=np.inf).max()
            ),
        )
    return worst
