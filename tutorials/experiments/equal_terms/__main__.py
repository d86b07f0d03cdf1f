"""Every method on equal terms.

`python -m tutorials.experiments.equal_terms curve` makes the rows that the record lacks, prints how
the methods compare, and draws them.
"""

import sys

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy

from tutorials.tools.shared import in_few_bytes  # noqa: E402

from ..tables.rows import Parser, rows, run  # noqa: E402
from . import curve, numbers, picture, steps  # noqa: E402


def main(words):
    """Make the rows that are missing, print the tables and draw the curves."""
    parser = Parser(prog="equal_terms", description="Every method on equal terms.")
    parser.of_rows("report/equal_terms")
    parser.add_argument("study", choices=("curve",))
    options = parser.parse_args(words)
    found = curve.shown(rows(curve.plan(), options.study, options.folder, options.jobs))
    for table in (curve, steps, numbers):
        table.tell(found)
    drawn = options.folder / "equal_terms.png"
    picture.draw(found, drawn)
    drawn.write_bytes(in_few_bytes(drawn))


if __name__ == "__main__":
    sys.exit(run(main, sys.argv[1:]))
