"""Every method on equal terms.

python -m tutorials.experiments.equal_terms curve            makes what the record lacks
python -m tutorials.experiments.equal_terms curve --show     prints and draws the record
"""

import sys

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy

from tutorials.tools.shared import in_few_bytes  # noqa: E402

from .. import PICTURES  # noqa: E402
from ..tables.rows import Parser, rows, run  # noqa: E402
from . import curve, numbers, picture, steps  # noqa: E402


def main(words):
    """Make what is missing; with --show, print and draw the record as it is."""
    parser = Parser(prog="equal_terms", description="Every method on equal terms.")
    parser.of_rows("report/equal_terms")
    parser.add_argument("study", choices=("curve",))
    parser.add_argument("--show", action="store_true", help="print and draw the record as it is")
    options = parser.parse_args(words)
    if not options.show:
        rows(curve.plan(), options.study, options.folder, options.jobs)
        print(f"to extend the record, copy {options.folder}/{options.study}.csv over it")
    else:
        curve.tell(curve.read())
        steps.tell(curve.read())
        numbers.tell(curve.read())
        drawn = PICTURES / "equal_terms.png"
        picture.draw(curve.read(), drawn)
        drawn.write_bytes(in_few_bytes(drawn))


if __name__ == "__main__":
    sys.exit(run(main, sys.argv[1:]))
