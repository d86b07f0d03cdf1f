"""The hard cases: inputs, cotangents and true values of `cases.json`, and how far we are from them.

The true values are correctly rounded from 50 digits, or closed forms. In a checkout,
`python -m tests.golden.hard_cases.publish` writes the file. The table shows the literal formula,
ours, the true value, errors and a verdict.
"""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...oracle.compare import cast
from ...table import EQUATIONS
from ..writer import table

FILE = Path(__file__).with_name("cases.json")
SMALLEST = 1e-44  # differences below are no errors: float32 cannot hold them
DTYPES = ("float64", "float32")
NUMBERS, ERRORS = ("literal", "ours", "true"), ("error", "grad_error")
COLUMNS = {
    "case": "{id}",
    "equation": "{equation}",
    "dtype": "{dtype}",
    "literal": "{literal}",
    "ours": "{ours}",
    "true": "{true}",
    "error": "{error}",
    "gradient": "{grad_error}",
    "verdict": "{verdict}",
}


# --- the cases ------------------------------------------------------------------------------------
class HardCase(NamedTuple):
    """One hard case: a call of an equation."""

    id: str  # "H-R1.6sigma": the group H-R1, then which of its inputs
    equation: str
    says: str  # what is hard, and what the column "literal" shows
    inputs: dict
    cotangents: dict
    true: dict  # outputs {"x": array} and gradients {"x_bar": array}; NaN where there is none
    shown: tuple  # (array, index) of the number that the table shows
    literal: dict  # {dtype: the result of the printed formula, or of the usual shortcut}
    bounds: dict  # {dtype: [largest error of outputs, of gradients or None]}, relative
    each: bool  # outputs relative to each number, otherwise to the largest of the array


@cache
def hard_cases():
    """{id: HardCase}, in the order of the table."""
    rows = json.loads(FILE.read_text(encoding="utf-8"))
    return {row["id"]: HardCase(**{name: read(a) for name, a in row.items()}) for row in rows}


def read(value):
    """The arrays of a JSON value; lists of anything else become tuples."""
    if isinstance(value, dict) and "shape" in value:
        return np.array(value["numbers"], value["type"]).reshape(value["shape"])
    if isinstance(value, dict):
        return {name: read(a) for name, a in value.items()}
    if not isinstance(value, list):
        return value
    parts = [read(a) for a in value]
    return parts if any(isinstance(a, np.ndarray) for a in parts) else tuple(parts)


# --- errors ---------------------------------------------------------------------------------------
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
    error = worst(outputs, case.true, case.each)
    grad_error = worst(bars, case.true, False)
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


def worst(found, true, each):
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


# --- the table ------------------------------------------------------------------------------------
def rows(only=None, report=lambda row: None):
    """Run all cases in both precisions, or only the case or the group of cases `only`.

    Return a list of dictionaries for JSON with id, equation, says, dtype, literal, ours, true,
    error, grad_error, bound, grad_bound and verdict. Infinities and NaN are text; the error of a
    gradient is None where there is no gradient.
    """
    found = []
    for case in hard_cases().values():
        if only is not None and only != case.id and not case.id.startswith(only + "."):
            continue
        about = {"id": case.id, "equation": case.equation, "says": case.says}
        for dtype in DTYPES:
            found.append({**about, "dtype": dtype, **judged(measure(case, dtype))})
            report(found[-1])
    return found


def judged(measured):
    """The fields of a Measured and its verdict. An error that is NaN fails."""
    good = measured.error <= measured.bound
    if measured.grad_error is not None:
        good = good and measured.grad_error <= measured.grad_bound
    errors = {name: number(getattr(measured, name)) for name in ("error", "grad_error")}
    return {**measured._asdict(), **errors, "verdict": "ok" if good else "fails"}


def describe(rows):
    """The table as text, and at the end the rows that fail."""
    shown = [{name: as_text(name, value) for name, value in row.items()} for row in rows]
    failed = [f"  {row['id']} {row['dtype']}" for row in rows if row["verdict"] == "fails"]
    end = f"{len(rows)} rows, {len(failed)} beyond their bounds"
    return "\n".join([*table(COLUMNS, shown), "", end, *failed])


def as_text(name, value):
    """A value of a row; numbers have at most 16 characters, and errors two digits."""
    digits = ".1e" if name in ERRORS else ".8g"
    text = f"{value:{digits}}" if isinstance(value, float) else "" if value is None else str(value)
    return text[:15] + "~" if name in NUMBERS and len(text) > 16 else text
