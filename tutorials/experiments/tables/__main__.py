"""`python -m tutorials.experiments.tables ablate bouncing`, or training, or effects."""

import sys

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy

from p4dgs_ref.scenes import load_scene  # noqa: E402

from . import ablate, effects, likelihood, training  # noqa: E402
from .rows import Parser, count, rows, run  # noqa: E402

TABLES = {"ablate": ablate, "training": training, "effects": effects, "likelihood": likelihood}


def main(words):
    """Make the missing rows of a table and print it."""
    parser = Parser(prog="tables", description="Tables of trainings on a tiny scene.")
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("scene")
    parser.add_argument("--seeds", type=count, default=3)
    parser.add_argument("--iterations", type=count)
    parser.add_argument("--anchors", type=count, help="ablate: + spatial prediction with so many")
    parser.of_rows("report/tables")
    options = parser.parse_args(words)
    table, scene = TABLES[options.table], load_scene(options.scene)
    iterations = options.iterations or table.ITERATIONS
    more = [options.anchors] if options.anchors and table is ablate else []
    tasks = table.plan(scene, options.seeds, iterations, *more)
    found = rows(tasks, options.table, options.folder, options.jobs)
    table.show(scene, tasks, found)


if __name__ == "__main__":
    sys.exit(run(main, sys.argv[1:]))
