"""Rows of records: each is trained, written to a file, read back and measured, once.

    def make(task, path, source):       # trains and writes a file; returns further columns
        model = fit(task.scene, task.changes, task.seed, task.iterations)
        path.write_bytes(encode(model))
        return {"network_bytes": 9085}

    task = Task(scene, "p4dgs", 0, 3800, make, decode, "p4dgs", "python -m ...")
    rows([task], "curve", Path("report/curve"), jobs=2)

What a record in `records/` or `curve.csv` in the folder has already is not made again. All rows of
the tasks are written to `curve.csv` in the folder, behind those of other tasks, after each
training. To extend a record, copy this file over it. A row is known by its KEY; it has the first
digits of its file's sha256, its command and the arithmetic with which it was made.

One training may give several files: the `source` of such a task is the task of its training, and
`make` gets the model in its file, otherwise None. All tasks of a training are in the same process.
"""

import argparse
import hashlib
import re
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

from p4dgs_ref import output
from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.cli.parser import number_in_range
from p4dgs_ref.lab.processes import in_processes
from p4dgs_ref.lab.writer import read_csv
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.report.figures import write_csv
from p4dgs_ref.scenes import Scene, SceneError
from p4dgs_ref.signals import handled, interrupt
from p4dgs_ref.training.watch import NotFinite

from .. import RECORDS
from .validation import held_back

KEY = ("scene", "label", "seed", "iterations")
TEXTS = ("scene", "label", "sha256")  # columns that are texts, also where they look like numbers


class Task(NamedTuple):
    """A row, and how its file is made."""

    scene: Scene
    method: str
    seed: int
    iterations: int
    make: Callable  # make(task, path, source) writes the file and returns further columns
    load: Callable  # load(data) returns the model in the bytes of a file
    ending: str  # of the file's name
    command: str  # what makes the row
    changes: dict[str, Any] = {}  # of the method's preset
    name: str = ""  # of a row that is not named after its method and the changes
    source: "Task | None" = None  # the training, where the file is made of its model

    @property
    def label(self):
        """The name of the row in its table."""
        changes = [f" {field}={value}" for field, value in self.changes.items()]
        return self.name or self.method + "".join(changes)

    @property
    def key(self):
        """The entries of KEY."""
        return self.scene.name, self.label, self.seed, self.iterations

    @property
    def file(self):
        """The name of the file."""
        name = "{} {} seed{} {}".format(*self.key)
        return re.sub(r"[^\w.=,-]+", "_", name) + f".{self.ending}"

    @property
    def training(self):
        """The key of the training from which the file comes."""
        return (self.source or self).key


def rows(tasks, name, folder, jobs=1):
    """The rows of the tasks, in their order; those that are missing are made.

    Raises SceneError where a scene has no test views, and OutputError for a folder in which
    nothing can be written.
    """
    for task in tasks:
        if not task.scene.test:
            raise SceneError(f"scene {task.scene.name}", "split 'test': no views to measure on")
    path = folder / f"{name}.csv"
    recorded, made = (
        keyed(read_csv(file, TEXTS)) if file.exists() else {}
        for file in (RECORDS / path.name, path)
    )
    known, groups = recorded | made, {}
    for task in tasks:
        if task.key not in known:
            groups.setdefault(task.training, []).append((task, folder))
    keys = [task.key for task in tasks]
    others = [row for key, row in made.items() if key not in keys]

    def keep():
        with output.replaced(path) as place:
            write_csv(place, others + [known[key] for key in keys if key in known])

    with output.writable_folder(folder):
        keep()
        for done, found in enumerate(in_processes(make_rows, [*groups.values()], jobs), 1):
            known |= keyed(found)
            keep()
            print(f"{done} of {len(groups)} trainings: {found[-1]['label']}", file=sys.stderr)
    return [known[key] for key in keys]


def keyed(found):
    """Rows by the entries of KEY."""
    return {tuple(row[column] for column in KEY): row for row in found}


def make_rows(pairs):
    """The new rows of the tasks of one training; pairs are (task, folder)."""
    return [make_row(*pair) for pair in pairs]


def make_row(task, folder):
    """Train, write the file, read it back and measure it.

    `train_seconds` are processor time, which the function that makes the file may correct.
    """
    start = time.process_time()
    columns = write(task, folder)
    seconds, data = time.process_time() - start, (folder / task.file).read_bytes()
    model = task.load(data)
    metrics, _, _ = evaluate(model, task.scene)
    choice, _, _ = evaluate(model, replace(task.scene, test=held_back(task.scene)))
    del metrics["render_fps"], metrics["size"]
    return {
        "method": task.method,
        **dict(zip(KEY, task.key)),
        "bytes": len(data),
        **metrics,
        "held_back_db": choice["psnr_db"],
        "train_seconds": seconds,
        **columns,
        "file": task.file,
        "made": f"{date.today()}",
        "arithmetic": arithmetic(),
        "sha256": hashlib.sha256(data).hexdigest()[:16],
        "command": task.command,
    }


def write(task, folder):
    """Write the file of a task; returns further columns of its row."""
    source = task.source and model_of(task.source, folder)
    with output.replaced(folder / task.file) as path:
        return task.make(task, path, source)


def model_of(task, folder):
    """The model in the file of a task, which is made where it is missing."""
    if not (folder / task.file).exists():
        write(task, folder)
    return task.load((folder / task.file).read_bytes())


# --- the command line of an experiment ------------------------------------------------------------
count = number_in_range(int, 1, 1e9)


class Parser(argparse.ArgumentParser):
    """argparse with its errors in one line."""

    def error(self, message):
        """End with one line."""
        self.exit(2, f"{self.prog}: {message}\n")

    def of_rows(self, folder):
        """Add the options of what makes rows in a folder."""
        self.add_argument("-o", dest="folder", type=Path, default=Path(folder), metavar="FOLDER")
        self.add_argument("--jobs", type=count, default=1, help="processes")


def run(function, *arguments):
    """Call a function and return the exit code; a mistake of the user becomes one line."""
    try:
        with handled(interrupt):
            function(*arguments)
    except (SceneError, output.OutputError, NotFinite, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        return 130
    return 0
