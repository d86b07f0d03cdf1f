"""Writes the hard cases as the package's data: `python -m tests.golden.hard_cases.publish`.

Inputs, cotangents and true values are float64; the true values come from closed forms where a case
has them, otherwise from constants.json. Run it after `make_constants`. The results of the literal
formulas are stored for both precisions.
"""

import json

import numpy as np

from p4dgs_ref.lab.stability import FILE, number, pick
from p4dgs_ref.oracle.compare import cast

from .catalogue import ENTRIES
from .entry import DTYPES
from .make_constants import stored


def as_json(value):
    """Arrays as {type, shape, numbers}, lists of arrays as lists, everything else as it is."""
    if isinstance(value, list):
        return [as_json(a) for a in value]
    if not isinstance(value, (np.ndarray, np.generic)):
        return value
    a = np.asarray(value)
    numbers = [None if x != x else x for x in a.ravel().tolist()]
    return {"type": a.dtype.name, "shape": a.shape, "numbers": numbers}


def nearest(numbers):
    """Nested lists of 50-digit numbers as the nearest floats, NaN where there is none."""
    if not isinstance(numbers, list):
        return np.nan if numbers is None else float(numbers)
    return [nearest(n) for n in numbers]


def true_values(entry, constants):
    """{array: true values}, lists of arrays for lists of arrays."""
    found = {}
    for name, numbers in constants.items():
        inputs = entry.case.inputs.get(name.removesuffix("_bar"))
        if isinstance(inputs, list) and name.endswith("_bar"):
            shapes = [a.shape for a in inputs]
            found[name] = [np.array(nearest(n)).reshape(s) for n, s in zip(numbers, shapes)]
        else:
            found[name] = np.array(nearest(numbers), float)
    for name, a in entry.case.expected.items():
        found[name] = a if isinstance(a, list) else np.asarray(a)
    return found


def literal_of(entry, dtype):
    """The result of the literal formula in one precision."""
    given = cast({**entry.case.inputs, **entry.case.cotangents}, dtype)
    with np.errstate(all="ignore"):
        result = entry.literal(given)
    _, index = entry.shown
    return number(pick(result, index) if np.ndim(result) else result)


def published(entry, constants):
    """What the package needs of one entry."""
    row = {"id": entry.id, "equation": entry.equation, "says": entry.says}
    true = true_values(entry, constants[f"{entry.equation}/{entry.id}"])
    arrays = {"inputs": entry.case.inputs, "cotangents": entry.case.cotangents, "true": true}
    row |= {kind: {n: as_json(a) for n, a in of.items()} for kind, of in arrays.items()}
    row |= {"shown": entry.shown, "literal": {name: literal_of(entry, name) for name in DTYPES}}
    return row | {"bounds": entry.bounds, "each": entry.each}


def text():
    """The content of the package's file, one line per case."""
    constants = stored()
    rows = (
        json.dumps(published(entry, constants), separators=(",", ":"), allow_nan=False)
        for entry in ENTRIES.values()
        if entry.case is not None
    )
    return "[\n" + ",\n".join(rows) + "\n]\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
