"""Measures every case of every equation: `python -m tests.workshop.sixty_digits.record [KEY ...]`.

The results go to tests/workshop/data/reference_errors.json. `tests/equations` compares with
them: an equation whose error becomes twice as large fails. All equations take three minutes.
"""

import json
import sys
from pathlib import Path

import numpy as np

from p4dgs_ref import EQUATIONS
from tests.workshop.cases import cases_of

from .errors import error

FILE = Path(__file__).parents[1] / "data" / "reference_errors.json"
# Elements of a gradient array that the quick test, and every measurement in float32, look at.
SAMPLES = 12
HOW = (
    "Largest error of the NumPy equations against 60-digit decimals: per case, of the outputs and "
    "of the gradients, in units of eps times the largest magnitude in the array. float64: all "
    "elements; float32: at most 12 of each gradient array. Cases whose inputs leave the range of "
    "float32 are absent there; null: infinitely wrong, because the rounding of floats decides what "
    "is computed. Made by `python -m tests.workshop.sixty_digits.record`."
)


def measure(key, case, dtype, samples=None):
    """{"out": worst, "in_bar": worst} of one case; None if `dtype` cannot hold its inputs."""
    try:
        with np.errstate(all="ignore"):
            errors = error(key, case, dtype, samples=samples)
    except OverflowError:
        return None
    return {
        side: max((e for name, e in errors.items() if name.startswith(side + ".")), default=0.0)
        for side in ("out", "in_bar")
    }


def record(keys):
    """{key: {dtype: {case: {"out": ..., "in_bar": ...}}}}, three digits each, rounded up."""
    errors = {}
    for key in keys:
        print(key, flush=True)
        errors[key] = {}
        for dtype, samples in (("float64", None), ("float32", SAMPLES)):
            rows = {}
            for case in cases_of(key):
                row = measure(key, case, np.dtype(dtype).type, samples)
                if row:
                    rows[case.name] = {side: _up(e) for side, e in row.items()}
            errors[key][dtype] = rows
    return errors


def _up(e):
    return float(f"{e * 1.005:.3g}") if np.isfinite(e) else None


def text(errors):
    """The file's content, one line per case."""

    def block(name, rows, indent):
        return f"{indent}{json.dumps(name)}: {{\n" + ",\n".join(rows) + "\n" + indent + "}"

    keys = []
    for key, by_dtype in errors.items():
        dtypes = []
        for dtype, cases in by_dtype.items():
            rows = [f"   {json.dumps(case)}: {json.dumps(row)}" for case, row in cases.items()]
            dtypes.append(block(dtype, rows, "  "))
        keys.append(block(key, dtypes, " "))
    return f'{{"how": {json.dumps(HOW)},\n' + block("errors", keys, "") + "}\n"


def main(keys):
    unknown = [key for key in keys if key not in EQUATIONS]
    if unknown:
        sys.exit(f"equation {unknown[0]!r}: expected one of {', '.join(EQUATIONS)}")
    kept = json.loads(FILE.read_text(encoding="utf-8"))["errors"] if keys else {}
    errors = {**kept, **record(keys or EQUATIONS)}
    FILE.write_text(
        text({key: errors[key] for key in EQUATIONS if key in errors}), encoding="utf-8"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
