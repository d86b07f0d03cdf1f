"""Short trainings, and the harnesses, which measure the values of a knob and return rows.

A row has the columns line and value, then error and ms (formulas, kernels), psnr_db and bytes
(files), or psnr_db, bytes and seconds (training). Times are processor times, taken in turn, of this
process or, for kernels, of one process each; trainings may run in others.
"""

import os
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np

from ...arithmetic import CHOSEN, OWN, kernels
from ...codec.file import ATTRIBUTE_SECTIONS
from ...designs import choose, decode, encode, trainer_of
from ...report.evaluate import evaluate
from ...report.inspect import components
from ...report.jobs import in_processes, processes
from ...scenes import load_scene
from ...training.presets import TINY
from ..clock import alternate, clocked

SCENE, ITERATIONS, SEEDS = "bouncing", 950, 3
STEPS = 10  # of a training with other kernels, timed together
# The iterations of a preset that are shortened together with its stages.
DATES = ("decay_from", "grow_from", "grow_until", "collect_from", "mask_from")


# --- trainings -----------------------------------------------------------------------------------
def shortened(preset, share):
    """The preset with a share of its iterations: all stages and dates are shortened alike."""
    ends = tuple(max(round(share * end), i + 1) for i, end in enumerate(preset.stage_ends))
    dates = {name: round(share * getattr(preset, name)) for name in DATES}
    return replace(preset, stage_ends=ends, **dates)


def reduced(iterations, **changes):
    """`tiny` for that many iterations, with other changes; the windows of growing shrink, too."""
    share = iterations / TINY.iterations
    window = max(20, round(share * TINY.grow_every))
    return choose(shortened(TINY, share), {"grow_every": window, **changes})


def step_at(scene, preset, stage, **options):
    """A function that does the first step of a stage again and again and returns all parameters.

    `options` are those of the Trainer.
    """
    # The anchors stay as they are.
    trainer = trainer_of(scene, replace(preset, grow_every=10**9), **options)

    def step():
        trainer.iteration = (0, *preset.stage_ends)[stage - 1]
        trainer.step()
        return trainer.parameters.vector

    return step


@cache
def scene_of(downscale=1):
    """The scene of all trainings, with views of some size."""
    return load_scene(SCENE, downscale=downscale)


def prepared(changes, iterations):
    """The scene, the preset and the Trainer's options of a training with some changes."""
    changes = dict(changes)
    scene = scene_of(changes.pop("downscale", 1))
    options = {name: changes.pop(name) for name in ("settings",) if name in changes}
    return scene, reduced(changes.pop("iterations", iterations), **changes), options


def trained(changes, iterations, seed=0):
    """The model of a training with some changes."""
    scene, preset, options = prepared(changes, iterations)
    with np.errstate(all="ignore"):  # the trainer itself looks for overflows
        return trainer_of(scene, preset, seed, **options).run()


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
    """A function that does the first step of stage 4."""
    return step_at(scene_of(), TINY, 4)


def clocked_steps():
    """The parameters after STEPS more steps of stage 4, and their seconds on both clocks.

    Views differ in time more than kernels do, so one step is too few.
    """
    return clocked(lambda: [step_of_stage_4()() for _ in range(STEPS)][-1])


def measure_kernels(knob):
    """Rows of a training step with the kernels in force, and with those of the processor's choice.

    Kernels are chosen when NumPy loads, so each has a process of its own, and these take turns. The
    error is the share of parameters that differ after the same steps.
    """
    with processes(1) as first, processes(1) as second:
        names = [first(kernels)()]
        with natively():
            names.append(second(kernels)())
        starts = dict(enumerate((first, second)))
        times = alternate(starts, knob.values, lambda start: start(clocked_steps)())
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
    """Columns of a model: PSNR of its decoded file, and bytes."""
    data = encode(model)
    metrics, sizes = evaluate(decode(data), scene)[0], components(data)
    return {
        "psnr_db": metrics["psnr_db"],
        "bytes": len(data),
        "attribute_bytes": sum(sizes[name] for name in ATTRIBUTE_SECTIONS),
        "anchors": metrics["anchors"],
    }


def measure_file(knob, model, scene):
    """Rows of a knob of files."""
    return [
        {"line": line, "value": value, **measured(changed, scene)}
        for (line, value), changed in knob.values(model).items()
    ]


def train_one(task):
    """Columns of one training: task = (changes, iterations, seed)."""
    return measured(trained(*task), scene_of())


def seconds(runs, iterations):
    """Columns of the processor seconds of trainings, {name: columns} for {name: changes}.

    A step of stage 3 and one of stage 4 of all runs are timed in turn, at their first parameters.
    Half of the iterations count as the one, half as the other; stages 1 and 2 are short.
    """
    pairs, ms_to_seconds = {}, {}
    for name, changes in runs.items():
        scene, preset, options = prepared(changes, iterations)
        steps = [step_at(scene, preset, stage, **options) for stage in (3, 4)]
        pairs[name] = lambda steps=steps: [step() for step in steps]
        ms_to_seconds[name] = 1e-3 * preset.iterations / len(steps)
    with np.errstate(all="ignore"):
        times = alternate(pairs, 5)
    return {name: times[name].columns("seconds", ms_to_seconds[name]) for name in runs}


def measure_trainings(knobs, iterations, progress, jobs):
    """Rows of all knobs of training, {name: rows}, and how far seeds differ, in dB.

    Trainings that several knobs share are done once.
    """
    runs = {repr(changes): changes for knob in knobs for changes in knob.values.values()}
    progress("training: times of steps")
    times, results = seconds(runs, iterations), []
    tasks = [(changes, iterations, 0) for changes in runs.values()]
    tasks += [({}, iterations, seed) for seed in range(SEEDS)]
    for result in in_processes(train_one, tasks, jobs):
        results.append(result)
        progress(f"training: {len(results)} of {len(tasks)} trainings")
    spread = float(np.ptp([result["psnr_db"] for result in results[len(runs) :]]))
    columns = {key: {**result, **times[key]} for key, result in zip(runs, results)}
    rows = {
        knob.name: [
            {"line": "", "value": value, **columns[repr(changes)]}
            for value, changes in knob.values.items()
        ]
        for knob in knobs
    }
    return rows, spread
