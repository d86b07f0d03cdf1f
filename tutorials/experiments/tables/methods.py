"""The methods of the tables: how each is trained, and its file written and read.

The paper's design is trained by the preset `tiny`, a baseline by its preset for tiny scenes. All
dates of a preset are shortened or stretched with its iterations.
"""

from dataclasses import replace

import numpy as np

from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.report.inspect import components
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer

from .. import baselines
from .rows import Task

PAPERS = "p4dgs"  # the paper's design
# The fields of presets that are counted in iterations, besides `stage_ends`.
DATES = (
    *("iterations", "warm_up", "noise_until", "x_until", "sh_every", "decay_from", "mask_from"),
    *("collect_from", "grow_from", "grow_until", "reset_every"),
)


def lasting(preset, iterations):
    """The preset with that many iterations; all its dates are shortened or stretched alike."""
    share = iterations / preset.iterations
    dates = {name: getattr(preset, name) for name in DATES if name in vars(preset)}
    changes = {name: max(round(share * n), n > 0) for name, n in dates.items()}
    if "stage_ends" in vars(preset):
        ends = enumerate(preset.stage_ends, 1)
        changes["stage_ends"] = tuple(max(round(share * end), i) for i, end in ends)
    return replace(preset, **changes)


def trainer_of(task):
    """The Trainer of the paper's design, before its first step."""
    preset = lasting(choose("tiny", task.changes), task.iterations)
    return Trainer(task.scene, preset, task.seed)


def make(task, path, source=None):
    """Train the paper's design and write its file; returns its bytes by kind."""
    with np.errstate(all="ignore"):  # the trainer looks for non-finite values itself
        return save(trainer_of(task).run(), path)


def save(model, path):
    """Write the file of a model of the paper's design; returns its bytes by kind."""
    data = encode(model)
    path.write_bytes(data)
    return kinds(components(data))


def load(path):
    """The model in a file of the paper's design."""
    return decode(path.read_bytes())


def kinds(sizes):
    """The columns of a row that say how many bytes Gaussians, networks and the rest take.

    The hash grid counts among the networks, like the planes of 4DHexPlane.
    """
    of_networks = [n for name, n in sizes.items() if name.endswith(("mlp", "mlps", "hash_grid"))]
    gaussians = sum(sizes.values()) - sum(of_networks) - sizes["header"]
    return columns({"gaussians": gaussians, "network": sum(of_networks), "other": sizes["header"]})


def columns(sizes):
    """The columns of a row that have some sizes."""
    return {f"{kind}_bytes": size for kind, size in sizes.items()}


def make_baseline(task, path, source=None):
    """Train a baseline, which grows to as many Gaussians as it has at first, and write its file."""
    module, _ = baselines.module_of(task.method)
    limit = {"most": task.changes["gaussians"]} if "gaussians" in task.changes else {}
    preset = baselines.choose(task.method, changes={**limit, **task.changes})
    trainer = module.Trainer(task.scene, lasting(preset, task.iterations), task.seed)
    with np.errstate(all="ignore"):
        return columns(trainer.run().save(path))


METHODS = {
    PAPERS: (make, load, "p4dgs"),
    **dict.fromkeys(baselines.METHODS, (make_baseline, baselines.load, "ply")),
}


def task_of(scene, method, seed, iterations, command, changes={}):
    """The Task of a method, whose file is as its authors store it."""
    return Task(scene, method, seed, iterations, *METHODS[method], command, changes)
