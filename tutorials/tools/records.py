"""The records of long trainings: tutorials/records/*.csv, each row with the command that makes it.

python -m tutorials.tools.records beyond_networks    train what this record lacks, and write it
python -m tutorials.tools.records curve --jobs 2     the same, two trainings at once
python -m tutorials.tools.records curve --collect    only take the rows that are in report/records/

A row is there when it has a sha256, that of its file; delete rows that are no longer true. New rows
and files lie in report/records/ as well, so what was stopped goes on there. Several machines make
the curve together: each runs a part of `p4dgs-ref compare --curve --point I/N -o report/records`.
"""

import argparse
import sys

from p4dgs_ref.lab.tables.methods import CODED, OUR_PRESETS, OURS

from p4dgs_ref.lab import effect_ledger
from p4dgs_ref.lab.tables import ablate, curve, methods
from p4dgs_ref.lab.writer import read_csv
from p4dgs_ref.output import staged_folder
from p4dgs_ref.report.figures import write_csv
from p4dgs_ref.scenes import load_scene
from tutorials.tools.shared import FOLDER

SCENES = ("bouncing", "figure", "glossy")


def rates(*values):
    """Changes of a preset to other prices of a bit."""
    return [{"lambda_rate": value} for value in values]


PAIRS = {OURS: [{}], CODED: [{}, *rates(0.00025, 0.0012)]}  # of every scene, with three seeds
SWEEP = {  # of the first scene and seed
    OURS: rates(0.0001, 0.001, 0.003, 0.01, 0.03),
    CODED: rates(0.0001, 0.001, 0.002, 0.003, 0.01, 0.03),
}
PLANS = {  # {record: the Tasks of its rows, in their order, for scenes and a folder of files}
    "curve": curve.plan,
    "ablate": lambda scenes, folder: [
        task for scene in scenes[:2] for task in ablate.plan(scene, folder, iterations=6500)
    ],
    "beyond_networks": lambda scenes, folder: sorted(
        methods.plan(PAIRS, OUR_PRESETS, scenes, folder)
        + methods.plan(SWEEP, OUR_PRESETS, scenes[:1], folder, seeds=1),
        key=lambda task: (task.method, task.scene.name, task.seed),
    ),
    "effects": lambda scenes, folder: effect_ledger.plan(scenes[0], folder),
}
MADE = {"effects": effect_ledger.made}  # what reads their rows, if not `methods.made`


def tasks(name, folder="report/records"):
    """The Tasks of a record's rows; `methods.make` makes one of them again, in a folder."""
    return PLANS[name]([load_scene(scene) for scene in SCENES], folder)


def rows(name):
    """The rows of a record."""
    return read_csv(FOLDER / "records" / f"{name}.csv")


def name_of(row):
    """What distinguishes a row from the others of its record."""
    return row["file"], row["iterations"]


def name_of_task(task):
    """The `name_of` the row of a Task."""
    return task.path.name, methods.preset_of(task).iterations


def main(name, jobs, is_made=False):
    """Make the rows of a record that are missing, unless they are made, and write it."""
    every = tasks(name)
    kept = {name_of(row): row for row in rows(name) if "sha256" in row}
    missing = [task for task in every if name_of_task(task) not in kept]
    if not is_made:
        methods.make_missing(missing, lambda line: print(line, file=sys.stderr, flush=True), jobs)
    kept |= {name_of(row): row for row in MADE.get(name, methods.made)(missing)}
    with staged_folder(FOLDER / "records") as staging:
        write_csv(
            staging / f"{name}.csv",
            [kept[key] for key in map(name_of_task, every) if key in kept],
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the rows of a record that are missing.")
    parser.add_argument("name", choices=PLANS)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once")
    parser.add_argument("--collect", action="store_true", help="train nothing")
    arguments = parser.parse_args()
    try:
        main(arguments.name, arguments.jobs, arguments.collect)
    except KeyboardInterrupt:
        sys.exit("stopped; the trainings that are done are kept, the same command makes the others")
