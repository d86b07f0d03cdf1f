"""The methods of the tables: how each is trained, and its file written and read.

The paper's design is trained by the preset `tiny`, a baseline by its preset for tiny scenes. All
dates of a preset are shortened or stretched with its iterations.
"""

from dataclasses import replace

from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.training.presets import TINY
from p4dgs_ref.training.trainer import Trainer

from .. import baselines
from ..coded_networks import file, training
from .rows import Task

PAPERS, CODED = "p4dgs", "p4dgs_coded"  # the paper's design, and networks that pay for their bits
GAUSSIANS = ("positions", "features", "scales", "offset_scales", "offsets", "masks")  # sections
# The fields of presets that are counted in iterations, besides `stage_ends`.
DATES = (
    *("iterations", "warm_up", "sh_every", "decay_from", "mask_from"),
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


def preset_of(task):
    """The preset `tiny` with the changes of a Task and its iterations.

    They are not checked: a training without the rate has steps that no file could hold.
    """
    return lasting(replace(TINY, **task.changes), task.iterations)


def make(task, path, source=None):
    """Train the paper's design and write its file; returns columns of the row."""
    return save(Trainer(task.scene, preset_of(task), task.seed), path)


def make_coded(task, path, source=None):
    """The same with coded networks."""
    trainer = training.Trainer(task.scene, preset_of(task), task.seed)
    return save(trainer, path, file.encode, file.read_container)


def save(trainer, path, encode=encode, read_container=read_container):
    """Train and write the file of the model; returns its bytes by kind and the price of a bit.

    The hash grid counts among the networks, like the planes of 4DHexPlane.
    """
    data = encode(trainer.run())
    path.write_bytes(data)
    sizes = {name: len(body) for name, body in read_container(data).items()}
    gaussians = sum(sizes[name] for name in GAUSSIANS)
    network = sum(sizes.values()) - gaussians - sizes["header"]
    return {
        "lambda_rate": trainer.preset.lambda_rate,
        **columns(gaussians=gaussians, network=network, other=len(data) - gaussians - network),
        "deformation_bytes": sizes.get("deformation_mlp", 0),
    }


def columns(**sizes):
    """The columns of a row that have some sizes."""
    return {f"{kind}_bytes": size for kind, size in sizes.items()}


def make_baseline(task, path, source=None):
    """Train a baseline, which grows to as many Gaussians as it has at first, and write its file."""
    module, preset = baselines.METHODS[task.method]
    changed = replace(preset, **task.changes)
    changed = lasting(replace(changed, most=changed.gaussians), task.iterations)
    return columns(**module.Trainer(task.scene, changed, task.seed).run().save(path))


METHODS = {
    PAPERS: (make, decode, "p4dgs"),
    CODED: (make_coded, file.decode, "p4dgs"),
    **dict.fromkeys(baselines.METHODS, (make_baseline, baselines.decode, "ply")),
}


def task_of(scene, method, seed, iterations, command, changes={}):
    """The Task of a method, whose file is as its authors store it."""
    return Task(scene, method, seed, iterations, *METHODS[method], command, changes)
