"""Computes the true values of the hard cases: `python -m tests.golden.hard_cases.make_constants`.

It writes constants.json, with 50 digits. `publish` rounds them and hands them to the package.
"""

import json
from pathlib import Path

import numpy as np

from tests.golden.sixty_digits import gradient, text, value

from .catalogue import ENTRIES

FILE = Path(__file__).with_name("constants.json")
PROVENANCE = (
    "Values of the printed formulas in 160-digit decimal arithmetic on the exact binary inputs of "
    "each case, gradients as difference quotients of them; both rounded to 50 digits. null: a "
    "kink, where there is no derivative. Made by python -m tests.golden.hard_cases.make_constants."
)


def digits(a):
    """Nested lists of numbers as texts of 50 digits, null for NaN."""
    a = a.item() if isinstance(a, np.ndarray) and a.ndim == 0 else a
    if isinstance(a, (list, np.ndarray)):
        return [digits(b) for b in a]
    return None if a.is_nan() else text(a, 50)


def make():
    """{"equation/case": {array: numbers}} of every entry that is a case of an equation."""
    found = {}
    for entry in ENTRIES.values():
        if entry.case is None:
            continue
        inputs, cotangents = entry.case.inputs, entry.case.cotangents
        arrays = value(entry.equation, inputs)
        if cotangents:
            gradients = gradient(entry.equation, inputs, cotangents)
            arrays |= {name + "_bar": a for name, a in gradients.items()}
        found[f"{entry.equation}/{entry.id}"] = {name: digits(a) for name, a in arrays.items()}
    return found


def stored():
    """The same from constants.json."""
    return json.loads(FILE.read_text(encoding="utf-8"))["cases"]


def main():
    rows = ",\n".join(
        f"{json.dumps(name)}: {json.dumps(arrays, separators=(',', ':'))}"
        for name, arrays in make().items()
    )
    head = json.dumps({"provenance": PROVENANCE, "digits": 50})[:-1]
    FILE.write_text(f'{head}, "cases": {{\n{rows}\n}}}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
