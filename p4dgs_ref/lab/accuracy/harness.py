"""Trainings, and the harnesses, which measure the values of a knob and return rows.

A row has the columns line and value, then errors and ms (formulas, kernels), psnr_db, bytes and
seed (files), or psnr_db, bytes, seed and seconds (training). Times are processor times, taken in
turn, of this process or, for kernels, of one process each; trainings may run in others.
"""

import hashlib
import json
import os
import zlib
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ... import output
from ...arithmetic import CHOSEN, OWN, arithmetic, kernels
from ...codec.file import ATTRIBUTE_SECTIONS, decode, encode
from ...report.evaluate import evaluate
from ...report.inspect import components
from ...scenes import load_scene
from ...scenes.files import read_json
from ...training.fit import fingerprint
from ...training.presets import TINY, choose
from ...training.trainer import Trainer
from ..clock import alternate, clocked
from ..processes import in_processes, processes

SCENE, SEEDS = "bouncing", 3
STEPS = 10  # of a training with other kernels, timed together
IN_A_ROW = 5  # steps of one training, so that its data are in the cache, as while it trains
# The iterations of a preset that are shortened together with its stages.
DATES = ("decay_from", "grow_from", "grow_until", "collect_from", "mask_from")


# --- trainings -----------------------------------------------------------------------------------
def shortened(preset, share):
    """The preset with a share of its iterations: all stages and dates are shortened alike."""
    ends = tuple(max(round(share * end), i + 1) for i, end in enumerate(preset.stage_ends))
    dates = {name: round(share * getattr(preset, name)) for name in DATES}
    return replace(preset, stage_ends=ends, **dates)


def reduced(iterations, preset=TINY, **changes):
    """A preset for that many iterations, with other changes; the windows of growing shrink, too."""
    share = iterations / preset.iterations
    window = max(20, round(share * preset.grow_every))
    return choose(shortened(preset, share), {"grow_every": window, **changes})


def step_at(scene, preset, stage, **options):
    """A function that does the second step of a stage again and again and returns all parameters.

    The first step, which is done here, may have work that a stage does only once. `options` are
    those of the Trainer.
    """
    # The anchors stay as they are.
    trainer = Trainer(scene, replace(preset, grow_every=10**9), **options)
    trainer.iteration, end = (0, *preset.stage_ends)[stage - 1 : stage + 1]
    second = min(trainer.iteration + 1, end - 1)
    with np.errstate(all="ignore"):  # the trainer itself looks for overflows
        trainer.step()

    def step():
        trainer.iteration = second
        trainer.step()
        return trainer.parameters.vector

    return step


@cache
def scene_of(downscale=1):
    """The scene of all trainings, with views of some size."""
    return load_scene(SCENE, downscale=downscale)


def prepared(changes, iterations=None):
    """The scene, the preset and the Trainer's options of a training with some changes.

    It has the iterations of its preset, or that many.
    """
    changes = dict(changes)
    scene = scene_of(changes.pop("downscale", 1))
    options = {name: changes.pop(name) for name in ("settings",) if name in changes}
    preset = choose(changes.pop("preset", TINY))
    share = changes.pop("share", 1)
    return scene, reduced(share * (iterations or preset.iterations), preset, **changes), options


def trained(changes, iterations=None, seed=0):
    """The model of a training with some changes."""
    scene, preset, options = prepared(changes, iterations)
    with np.errstate(all="ignore"):  # the trainer itself looks for overflows
        return Trainer(scene, preset, seed, **options).run()


# --- the harnesses -------------------------------------------------------------------------------
def measure_forms(forms, repeats):
    """Rows of the forms of a function: error and time."""
    with np.errstate(all="ignore"):
        times = alternate({key: run for key, (run, _) in forms.items()}, repeats)
        return [
            {"line": line, "value": value, **judge(run()), **times[line, value].columns()}
            for (line, value), (run, judge) in forms.items()
        ]


@cache
def step_of_stage_4():
    """A function that does a step of stage 4."""
    return step_at(scene_of(), TINY, 4)


def clocked_steps():
    """The parameters after STEPS more steps of stage 4, and their seconds on both clocks.

    Views differ in time more than kernels do, so one step is too few.
    """
    return clocked(lambda: [step_of_stage_4()() for _ in range(STEPS)][-1])


def measure_kernels(turns):
    """Rows of a training step with the kernels in force, and with those of the processor's choice.

    Kernels are chosen when NumPy loads, so each has a process of its own, and these take turns. The
    error is the share of parameters that differ after the same steps.
    """
    with processes(1) as first, processes(1) as second:
        names = [first(kernels)()]
        with natively():
            names.append(second(kernels)())
        starts = dict(enumerate((first, second)))
        times = alternate(starts, turns, lambda start: start(clocked_steps)())
        ends = [start(clocked_steps)()[0] for start in starts.values()]
    differ = [float(np.mean(end != ends[0])) for end in ends]
    return [
        {"line": "", "value": name, "error": differ[i], **times[i].columns("ms", 1 / STEPS)}
        for i, name in enumerate(names)
    ]


@contextmanager
def natively():
    """Processes that start within this context use the kernels that the processor chooses."""
    before = dict(os.environ)
    for name in CHOSEN if kernels() != OWN else ():
        os.environ.pop(name, None)
    os.environ["P4DGS_KERNELS"] = "native"
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def measured(model, scene):
    """Columns of a model: PSNR of its decoded file, bytes, and the file's sha256."""
    data = encode(model)
    metrics, sizes = evaluate(decode(data), scene)[0], components(data)
    return {
        "psnr_db": metrics["psnr_db"],
        "bytes": len(data),
        "attribute_bytes": sum(sizes[name] for name in ATTRIBUTE_SECTIONS),
        "anchors": metrics["anchors"],
        "sha256": hashlib.sha256(data).hexdigest()[:16],
    }


def measure_file(knob, model, scene):
    """Rows of a knob of files."""
    return [
        {"line": line, "value": value, **measured(changed, scene)}
        for (line, value), changed in knob.values(model).items()
    ]


class Training(NamedTuple):
    """A training with some changes, and the knobs of files for which its model is written."""

    folder: str | Path  # where its result is kept
    changes: dict
    iterations: int | None
    seed: int
    files: tuple = ()

    @property
    def path(self):
        """The file of the result. Its name has a checksum of all that determines the training."""
        scene, preset, options = prepared(self.changes, self.iterations)
        names = [knob.name for knob in self.files]
        text = f"{preset} {options} {names} {scene.effects} {arithmetic()}"
        crc = zlib.crc32(text.encode(), fingerprint(scene.train + scene_of().test))
        return Path(self.folder) / f"{SCENE}_seed{self.seed}_{crc:08x}.json"


def train_one(training):
    """Train, and write the rows {knob: rows} of the model, whose knob is "", and of its files."""
    _, changes, iterations, seed, files = training
    model, scene = trained(changes, iterations, seed), scene_of()
    length = prepared(changes, iterations)[1].iterations
    columns = {"seed": seed, "iterations": length, "arithmetic": arithmetic()}
    rows = {knob.name: measure_file(knob, model, scene) for knob in files}
    rows[""] = [measured(model, scene)]
    result = {name: [{**row, **columns} for row in of_knob] for name, of_knob in rows.items()}
    text = json.dumps(result, indent=1) + "\n"
    output.write_atomically(training.path, lambda file: file.write(text.encode()))


def seconds(runs, iterations):
    """Columns of the processor seconds of trainings, {name: columns} for {name: changes}.

    Some steps of stage 3 and of stage 4 of all runs are timed in turn, near their first parameters.
    Half of the iterations count as the ones, half as the others; stages 1 and 2 are short.
    """
    pairs, ms_to_seconds = {}, {}
    for name, changes in runs.items():
        scene, preset, options = prepared(changes, iterations)
        steps = [step_at(scene, preset, stage, **options) for stage in (3, 4)]
        pairs[name] = lambda steps=steps: [step() for step in steps for _ in range(IN_A_ROW)]
        ms_to_seconds[name] = 1e-3 * preset.iterations / len(steps) / IN_A_ROW
    with np.errstate(all="ignore"):
        times = alternate(pairs, 5)
    return {name: times[name].columns("seconds", ms_to_seconds[name]) for name in runs}


def measure_trainings(knobs, files, folder, iterations, seeds, progress, jobs):
    """Rows of all knobs of training and of files, {name: rows}.

    Trainings that several knobs share are done once. Their results are kept in `folder`, and what
    is there is not made again.
    """
    runs = {repr(changes): changes for knob in knobs for changes in knob.values.values()}
    progress(f"training: times of steps of {len(runs)} trainings")
    times = seconds(runs, iterations) if runs else {}
    every = {
        (key, seed): Training(folder, changes, iterations, seed, () if changes else tuple(files))
        for seed in range(seeds)
        for key, changes in (runs | ({repr({}): {}} if files else {})).items()
    }
    missing = [training for training in every.values() if not training.path.exists()]
    minutes = sum(times[key]["seconds"] for key in runs) * seeds / jobs / 60
    progress(f"training: {len(missing)} of {len(every)}; all of them take {minutes:.0f} minutes")
    with output.made(folder):
        for done, _ in enumerate(in_processes(train_one, missing, jobs), 1):
            progress(f"training: {done} of {len(missing)} trainings")
    kept = {key: read_json(training.path, "a training's rows") for key, training in every.items()}
    rows = {
        knob.name: [
            {"line": "", "value": value, **kept[repr(changes), seed][""][0], **times[repr(changes)]}
            for value, changes in knob.values.items()
            for seed in range(seeds)
        ]
        for knob in knobs
    }
    of_files = {
        knob.name: [row for seed in range(seeds) for row in kept[repr({}), seed][knob.name]]
        for knob in files
    }
    return rows | of_files
