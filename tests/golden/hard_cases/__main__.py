"""`python -m tests.golden.hard_cases`: all hard cases, procedures too; exit 1 if one fails."""

import sys

from p4dgs_ref.lab import stability

from .catalogue import ENTRIES
from .coding import CODING
from .entry import DTYPES
from .procedures import PROCEDURES


def procedure_rows():
    """Rows with the fields of `p4dgs-ref stability`, in both precisions."""
    measure = {**CODING, **PROCEDURES}
    return [
        {
            "id": entry.id,
            "equation": entry.equation,
            "says": entry.says,
            "dtype": dtype,
            **measure[entry.id](dtype),
        }
        for entry in ENTRIES.values()
        if entry.case is None
        for dtype in DTYPES
    ]


def main():
    """Print the table of `p4dgs-ref stability` and, below it, that of the procedures."""
    rows = [*stability.rows(), *procedure_rows()]
    print(stability.to_text(rows))
    return int(any(row["verdict"] == "fails" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
