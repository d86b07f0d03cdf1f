"""`python -m tests.golden.hard_cases`: all hard cases, procedures too; exit 1 if one fails."""

import sys

from p4dgs_ref.lab.stability import table

from .measured import procedure_rows


def main():
    """Print the table of `p4dgs-ref stability` and, below it, that of the procedures."""
    rows = [*table.rows(), *procedure_rows()]
    print(table.describe(rows))
    return int(any(row["verdict"] == "fails" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
