"""Writes what the package adds to the published hard cases.

`python -m tests.workshop.hard_cases.publish` computes the results of the literal formulas
and keeps the column "exact".
"""

import json

import numpy as np

from p4dgs_ref.lab.stability import FILE, json_number, pick
from p4dgs_ref.oracle.compare import cast

from .catalogue import ENTRIES
from .entry import DTYPES


def literal_of(entry, dtype):
    """The result of the literal formula in one precision."""
    given = cast({**entry.case.inputs, **entry.case.cotangents}, dtype)
    with np.errstate(all="ignore"):
        result = entry.literal(given)
    _, index = entry.shown
    return json_number(pick(result, index) if np.ndim(result) else result)


def row(entry):
    """What the file says of one entry, without "exact"."""
    name, index = entry.shown
    return {
        "id": entry.id,
        "equation": entry.equation,
        "says": entry.says,
        "shown": [name, list(index)],
        "literal": [literal_of(entry, dtype) for dtype in DTYPES],
        "bounds": [entry.bounds[dtype] for dtype in DTYPES],
        "each": entry.each,
    }


def text():
    """The content of the file, one line per case."""
    kept = {case["id"]: case for case in json.loads(FILE.read_text(encoding="utf-8"))}
    rows = [
        {**row(entry), **{n: a for n, a in kept.get(entry.id, {}).items() if n == "exact"}}
        for entry in ENTRIES.values()
    ]
    return "[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
