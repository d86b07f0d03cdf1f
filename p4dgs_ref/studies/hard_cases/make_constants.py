"""Makes constants.json: `python -m p4dgs_ref.studies.hard_cases.make_constants` computes the catalogue's true values to 50 digits."""

import json

import numpy as np

from ...scenes.output import write_atomically
from tests.golden.sixty_digits import gradient, text, value
from .catalogue import ENTRIES
from .entry import CONSTANTS

PROVENANCE = (
    "Values of the printed formulas in 80-digit decimal arithmetic on the exact binary inputs of each "
    "case, gradients as "
    "difference quotients of them, by p4dgs_ref.sixty_digits; both rounded to 50 digits.  null: a kink, "
    "where there is no "
    "derivative.  Made by python -m p4dgs_ref.studies.hard_cases.make_constants."
)


def digits(a):
    """Nested lists of texts of 50 digits, null for NaN."""
    a = a.item() if isinstance(a, np.ndarray) and a.ndim == 0 else a
    if isinstance(a, (list, np.ndarray)):
        return [digits(b) for b in a]
    return None if a.is_nan() else text(a, 50)


def make():
    """{case id: {array: numbers}} of every entry that is a case."""
    cases = {}
    for entry in ENTRIES.values():
        if entry.case is None:
            continue
        case, key = entry.case, entry.equation
        arrays = {name: digits(a) for name, a in value(key, case.inputs).items()}
        if case.cotangents:
            arrays.update(
                {
                    name + "_bar": digits(a)
                    for name, a in gradient(key, case.inputs, case.cotangents).items()
                }
            )
        cases[f"{key}/{case.name}"] = arrays
    return {"provenance": PROVENANCE, "digits": 50, "cases": cases}


if __name__ == "__main__":
    made = make()
    rows = ",\n".join(
        f"{json.dumps(name)}: {json.dumps(arrays, separators=(',', ':'))}"
        for name, arrays in made.pop("cases").items()
    )
    data = (json.dumps(made)[:-1] + f', "cases": {{\n{rows}\n}}}}\n').encode()
    write_atomically(CONSTANTS, lambda file: file.write(data))
