"""The hard cases as data: inputs, cotangents and true values of `cases.json`.

The true values are correctly rounded from 50 digits, or closed forms. In a checkout,
`python -m tests.golden.hard_cases.publish` writes the file.
"""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

FILE = Path(__file__).with_name("cases.json")


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
    return {row["id"]: HardCase(**{name: _read(a) for name, a in row.items()}) for row in rows}


def _read(value):
    """The arrays of a JSON value; lists of anything else become tuples."""
    if isinstance(value, dict) and "shape" in value:
        return np.array(value["numbers"], value["type"]).reshape(value["shape"])
    if isinstance(value, dict):
        return {name: _read(a) for name, a in value.items()}
    if not isinstance(value, list):
        return value
    parts = [_read(a) for a in value]
    return parts if any(isinstance(a, np.ndarray) for a in parts) else tuple(parts)
