"""Runs the hard cases that are procedures, in the form of the package's table."""

from p4dgs_ref.lab.stability.table import judged

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
            **judged(measure[entry.id](dtype)),
        }
        for entry in ENTRIES.values()
        if entry.case is None
        for dtype in DTYPES
    ]
