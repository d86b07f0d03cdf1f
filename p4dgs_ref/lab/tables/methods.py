"""Any method on one scene: trained, written to a file, read back and measured like all others."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...codec.file import decode, encode
from ...report.evaluate import evaluate
from ...report.inspect import components
from ...scenes import Scene
from ...scenes.output import write_atomically
from ...training.presets import TINY_REAL, choose
from ...training.trainer import Trainer
from .. import baselines
from ..clock import alternate, clocked
from ..effects.ledger import shortened

OURS = "p4dgs"
CODED = "p4dgs_coded"  # with coded networks and positions, beyond the paper
OWN = {OURS: "tiny", CODED: "tiny_coded"}  # their presets
# The fields of the baselines' presets that are counted in iterations.
DATES = (
    "iterations",
    "warm_up",
    "noise_until",
    "x_until",
    "coarse",
    "sh_every",
    "collect_from",
    "grow_from",
    "grow_until",
    "reset_every",
)
TURNS = 5  # of the pictures that are timed
PROBE = 0.05  # of the iterations of a training, by which its time is foretold


class StudyError(ValueError):
    """A mistake in what a study is asked for: one line with its name and what was expected."""


class Task(NamedTuple):
    """One training and its file."""

    scene: Scene
    method: str
    seed: int
    folder: Path  # of the file
    iterations: int | None = None  # None: those of the preset
    most: int | None = None  # Gaussians of a baseline; None: those of its preset
    changes: dict = {}  # of the preset

    @property
    def own(self):
        """Whether it is one of our designs, not a baseline."""
        return self.method in OWN

    @property
    def name(self):
        """The name of the file, without its ending."""
        parts = [self.scene.name, self.method, *map(str, self.changes.values())]
        parts += [str(self.most)] if self.most else []
        return "_".join([*parts, f"seed{self.seed}"]).replace("/", "_")

    @property
    def path(self):
        """The file."""
        return Path(self.folder) / f"{self.name}.{'p4dgs' if self.own else 'ply'}"


def known(names):
    """The names of methods in the order of the tables; of none, all that the paper compares.

    Raises StudyError for an unknown one.
    """
    methods = (*OWN, *baselines.METHODS)
    for name in names:
        if name not in methods:
            raise StudyError(f"method {name!r}: expected one of {', '.join(methods)}")
    return [name for name in methods if (name in names if names else name != CODED)]


def require_test_views(scene):
    """Raise StudyError for a scene that has nothing to measure on."""
    if not scene.test:
        raise StudyError(f"scene {scene.name}: split 'test': no views to measure on")


def preset_of(task):
    """The preset for tiny scenes with the task's changes and iterations.

    All dates of its schedule are shortened or stretched alike. Raises StudyError.
    """
    try:
        if task.own:
            # As in `tiny_real`: points know their depth, and anchors keep it.
            real = {} if task.scene.points is None else {"lr_x": TINY_REAL.lr_x}
            ours = choose(OWN[task.method], {**real, **task.changes})
            return shortened(ours, (task.iterations or ours.iterations) / ours.iterations)
        size = {"gaussians": task.most, "most": task.most} if task.most else {}
        theirs = baselines.choose(task.method, None, {**size, **task.changes})
    except ValueError as error:
        raise StudyError(str(error)) from None
    share = (task.iterations or theirs.iterations) / theirs.iterations
    dates = {name: getattr(theirs, name) for name in DATES if hasattr(theirs, name)}
    return replace(theirs, **{name: max(round(share * n), n > 0) for name, n in dates.items()})


def fit(task):
    """The trained model of a task."""
    kind = Trainer
    if not task.own:
        kind = baselines.module_of(task.method)[0].Trainer
    with np.errstate(all="ignore"):  # the trainers look for non-finite values themselves
        return kind(task.scene, preset_of(task), task.seed).run()


def train(task):
    """Train and write the file: its bytes by kind, and the processor seconds of the training."""
    model, (seconds, _) = clocked(fit, task)
    if task.own:
        data = encode(model)
        write_atomically(task.path, lambda file: file.write(data))
        sizes = kinds(components(data))
    else:
        sizes = model.save(task.path)
    return {
        "method": task.method,
        "scene": task.scene.name,
        "seed": task.seed,
        "most": task.most,
        "iterations": preset_of(task).iterations,
        "bytes": sum(sizes.values()),
        **{f"{kind}_bytes": size for kind, size in sizes.items()},
        "train_seconds": float(seconds),
    }


def kinds(sizes):
    """The bytes of one of our files as those of a baseline: Gaussians, networks, the rest.

    The hash grid counts among the networks, like the planes of 4DHexPlane.
    """
    network = sum(
        n for name, n in sizes.items() if name.endswith(("mlp", "mlps")) or name == "hash_grid"
    )
    other = sizes["header"]
    gaussians = sum(sizes.values()) - network - other
    return {"gaussians": gaussians, "network": network, "other": other}


def load(task):
    """The model in the file of a task."""
    return decode(task.path.read_bytes()) if task.own else baselines.load(task.path)


def measure(tasks):
    """Measure the files of some tasks on the test views of their one scene.

    Returns rows and the pictures of each model. The renderer's processor times are taken in turns.
    """
    views = tasks[0].scene.test
    models = {task.name: load(task) for task in tasks}

    def all_views(model):
        return lambda: [model.render(view.camera, view.time) for view in views]

    times = alternate({name: all_views(model) for name, model in models.items()}, TURNS)
    rows, pictures = [], []
    for task in tasks:
        metrics, _, images = evaluate(models[task.name], task.scene)
        names = ("psnr_db", "psnr_fg_db", "ssim", "gaussians")
        ms, stretch = times[task.name].median, times[task.name].stretch
        row = {name: metrics[name] for name in names}
        rows.append({**row, "render_fps": 1e3 * len(views) / ms, "stretch": stretch})
        pictures.append(images)
    return rows, pictures


def equal_times(tasks):
    """The tasks with as many iterations as take the processor time of the first one.

    Times are those of trainings in which everything happens PROBE times as late.
    """
    seconds, lengths = [], [preset_of(task).iterations for task in tasks]
    for task, length in zip(tasks, lengths):
        probe = task._replace(iterations=max(1, round(PROBE * length)))
        seconds.append(clocked(fit, probe)[1][0])
    return [
        task._replace(iterations=max(1, round(length * seconds[0] / own)))
        for task, length, own in zip(tasks, lengths, seconds)
    ]


def spread(values):
    """The mean of some values, and half of their range."""
    return float(np.mean(values)), float(np.ptp(values) / 2)


def aligned(table):
    """The lines of a table: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*table)]
    forms = [f"{'<' if i == 0 else '>'}{width}" for i, width in enumerate(widths)]
    return ["  ".join(map(format, line, forms)).rstrip() for line in table]
