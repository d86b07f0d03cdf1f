"""How long to train: the PSNR of shorter trainings, from a record that comes with the package.

`training.csv` has a row for each training. `p4dgs-ref accuracy --train` makes the rows anew.
"""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...arithmetic import arithmetic
from ...codec.file import decode, encode
from ...report.evaluate import evaluate
from ...scenes import load_scene
from ...training.presets import TINY, choose
from ...training.trainer import Trainer
from ..clock import alternate, call_with_clocks, step_at
from ..processes import in_processes
from ..writer import group_rows, read_csv, twice_standard_error

RECORD = Path(__file__).with_name("training.csv")
SCENE, SEEDS = "bouncing", 3
LENGTHS = (3800, 1900, 950)  # iterations, those of `tiny` first
# The iterations of a preset that are shortened together with its stages.
DATES = ("decay_from", "grow_from", "grow_until", "collect_from", "mask_from")


def reduced(iterations, preset=TINY, **changes):
    """A preset with so many iterations: stages, dates and windows of growing shrink alike."""
    share = iterations / preset.iterations
    ends = tuple(max(round(share * end), i + 1) for i, end in enumerate(preset.stage_ends))
    dates = {name: round(share * getattr(preset, name)) for name in DATES}
    window = max(20, round(share * preset.grow_every))
    return choose(replace(preset, stage_ends=ends, **dates), {"grow_every": window, **changes})


def train(task):
    """The row of one training, of a task (label, scene, preset, seed)."""
    label, scene, preset, seed = task
    model, (seconds, _) = call_with_clocks(Trainer(scene, preset, seed).run)
    data = encode(model)
    return {
        "label": label,
        "scene": scene.name,
        "seed": seed,
        "iterations": preset.iterations,
        "psnr_db": evaluate(decode(data), scene)[0]["psnr_db"],
        "bytes": len(data),
        "seconds": seconds,  # of the processor
        "sha256": hashlib.sha256(data).hexdigest()[:16],
        "arithmetic": arithmetic(),
    }


def make(tasks, jobs, progress):
    """The rows of trainings, of which `jobs` run at once."""
    rows = []
    for row in in_processes(train, tasks, jobs):
        rows.append(row)
        progress(f"{len(rows)} of {len(tasks)} trainings")
    return rows


def seconds_of(tasks, jobs):
    """About how many seconds trainings take, judging by steps in which things move."""
    _, scene, preset, _ = tasks[0]
    iterations = sum(preset.iterations for _, _, preset, _ in tasks)
    return 1e-3 * alternate({"step": step_at(scene, preset, 3)}, 5)["step"].ms * iterations / jobs


def tasks_of_record():
    """The trainings of the packaged record."""
    scene = load_scene(SCENE)
    return [("", scene, reduced(n), seed) for n in LENGTHS for seed in range(SEEDS)]


def read():
    """The rows of the packaged record."""
    return read_csv(RECORD)


def points(rows):
    """What a panel shows of some rows: {length: the seconds, and the dB lost to the longest}."""
    of, found = group_rows(rows, "iterations"), {}
    for (n,), group in of.items():
        best = of[max(of)]
        lost = [longest["psnr_db"] - row["psnr_db"] for longest, row in zip(best, group)]
        low, median, high = 1e3 * np.percentile([row["seconds"] for row in group], (25, 50, 75))
        found[f"{n:,}"] = {
            "loss": float(np.mean(lost)),
            "within": float(twice_standard_error(lost)),
            "ms": float(median),
            "ms_low": float(low),
            "ms_high": float(high),
        }
    return found
