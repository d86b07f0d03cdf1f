"""The maker of rows: any method on one scene is trained, written to a file, read and measured.

A study is a list of Tasks and what it says about their rows. A row begins with the fields method,
scene, seed, psnr_db and bytes; it has the first digits of its file's sha256 and the command that
makes this file. It lies as JSON beside the file, in a folder that is named after a checksum of the
scene's views, effects and background, and the length of the trainings. A row that is there is not
made again, so a killed study goes on, takes what another one has made, and can grow by scenes,
seeds and methods. Such a row is compared with its own checksum and with its file before it is used.
"""

import hashlib
import json
from ast import literal_eval
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ... import __version__, designs, output
from ... import model as paper
from ...arithmetic import arithmetic
from ...codec.file import ATTRIBUTE_SECTIONS
from ...designs import PRESETS, choose, decode, encode
from ...model import CONTEXT_NETWORKS, Anchors, bounding_box
from ...report.evaluate import evaluate, json_safe
from ...report.inspect import components, ledger
from ...report.jobs import in_processes
from ...scenes import Scene, SceneError
from ...scenes.fields import require
from ...scenes.files import read_json
from ...training.fit import fingerprint
from ...training.parameters import Parameters
from ...training.presets import TINY_REAL, differences
from .. import StudyError, baselines, entry
from ..accuracy.harness import shortened
from ..baselines import d3dgs_network
from ..clock import clocked

OURS = "p4dgs"
CODED = "p4dgs_coded"  # with coded networks and positions, beyond the paper
OUR_PRESETS = {OURS: "tiny", CODED: "tiny_coded"}
KNOBS = ("lambda_rate", "sh_degree")  # fields of presets that stand in the rows
# The fields of the baselines' presets that are counted in iterations.
DATES = (
    "iterations",
    "warm_up",
    "noise_until",
    "x_until",
    "sh_every",
    "collect_from",
    "grow_from",
    "grow_until",
    "reset_every",
)
# The fields of a row. Some presets lack KNOBS, and only our own files have the last four.
FIELDS = (
    *("method", "scene", "seed", "psnr_db", "bytes", "label", *KNOBS),
    *("ssim", "psnr_fg_db", "anchors", "gaussians"),
    *("gaussians_bytes", "network_bytes", "other_bytes", "file", "iterations", "train_seconds"),
    *("made", "arithmetic", "release", "sha256", "command"),
    *("estimated_bytes", "anchor_bytes", "positions_bytes", "deformation_bytes"),
)


class Task(NamedTuple):
    """One training and its file."""

    scene: Scene
    method: str
    seed: int
    folder: Path  # of the file
    iterations: int | None = None  # None: those of the preset
    changes: dict = {}  # of the preset; `preset` is another one than that of the method
    study: str = "compare"  # the command of which it is a row
    # Of the ablation's steps, which train our method in another form:
    step: str | None = None  # the name of the step
    network: dict = {}  # fields of the Design that are those of D3DGS's network
    zeros: tuple = ()  # parameters that start at zero
    plain: tuple | None = None  # in a plain file; the networks that are float16 there

    @property
    def is_ours(self):
        """Whether it is one of our designs, not a baseline."""
        return self.method in OUR_PRESETS

    @property
    def label(self):
        """The name of its rows: the step, or the method and its changes as `--set` takes them."""
        changed = (f" {field}={value}" for field, value in self.changes.items())
        return self.step or self.method + "".join(changed)

    @property
    def path(self):
        """The file."""
        name = f"{self.scene.name} {self.label} seed{self.seed}".replace("+ ", "")
        ending = ("p4dgs" if self.plain is None else "npy") if self.is_ours else "ply"
        return Path(self.folder) / f"{name.replace(' ', '_').replace('/', '_')}.{ending}"

    @property
    def command(self):
        """What makes the file: one training of ours, else the study of which it is a row."""
        scene, seed = self.scene.name, self.seed
        if self.is_ours and not self.step:
            preset = preset_of(self)
            changes = "".join(
                f" --set {field}={text_of(value)}"
                for field, _, value in differences(preset, PRESETS[preset.name])
            )
            return (
                f"p4dgs-ref train {scene} --preset {preset.name} --seed {seed}{changes} -o run && "
                f"p4dgs-ref encode run -o '{self.path.name}'"
            )
        method = f" --method {self.method}" * (not self.step)
        length = f" --iterations {self.iterations}" * bool(self.iterations)
        return f"p4dgs-ref {self.study} {scene}{method} --seeds {seed + 1}{length} --yes"

    @property
    def record(self):
        """The JSON of the row."""
        return self.path.with_suffix(".json")


def text_of(value):
    """A value of a preset as `--set` takes it."""
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def known(names):
    """The names of methods in the order of the tables; of none, all that the paper compares.

    Raises StudyError for an unknown one.
    """
    methods = {**OUR_PRESETS, **baselines.METHODS}
    for name in names:
        entry(methods, "method", name)
    return [name for name in methods if (name in names if names else name != CODED)]


def preset_of(task):
    """The preset for tiny scenes with the task's changes and iterations.

    All dates of its schedule are shortened or stretched alike. A baseline grows to the number of
    Gaussians with which it starts.
    """
    changes = dict(task.changes)
    preset = changes.pop("preset", OUR_PRESETS.get(task.method))
    if task.is_ours:
        # As in `tiny_real`: points know their depth, and anchors keep it.
        real = {} if task.scene.points is None else {"lr_x": TINY_REAL.lr_x}
        ours = choose(preset, {**real, **changes})
        return shortened(ours, (task.iterations or ours.iterations) / ours.iterations)
    limit = {"most": count for field, count in changes.items() if field == "gaussians"}
    theirs = baselines.choose(task.method, preset, {**limit, **changes})
    share = (task.iterations or theirs.iterations) / theirs.iterations
    dates = {name: getattr(theirs, name) for name in DATES if hasattr(theirs, name)}
    return replace(theirs, **{name: max(round(share * n), n > 0) for name, n in dates.items()})


def plan(sizes, names, scenes, folder, seeds=3, iterations=None, study="compare"):
    """The Tasks of some methods, for each of its `sizes` {method: [changes of the preset]}.

    All scenes with one seed come before the next seed.
    """
    length = "" if iterations is None else f"_{iterations}"
    sums = [
        fingerprint(scene.train + scene.test, f"{scene.effects} {scene.background} {scene.points}")
        for scene in scenes
    ]
    places = [(scene, f"points_{crc:08x}{length}") for scene, crc in zip(scenes, sums)]
    return [
        Task(scene, method, seed, Path(folder) / place, iterations, changes, study)
        for seed in range(seeds)
        for scene, place in places
        for method in names
        for changes in sizes[method]
    ]


def trainer_of(task):
    """The Trainer of a task before its first step."""
    preset = preset_of(task)
    if not task.is_ours:
        return baselines.module_of(task.method)[0].Trainer(task.scene, preset, task.seed)
    if task.network:
        trainer = d3dgs_network.Trainer(task.scene, preset, task.seed, task.network)
    else:
        trainer = designs.trainer_of(task.scene, preset, task.seed)
    for name in task.zeros:
        trainer.parameters[name][...] = 0
    return trainer


def trainers(tasks):
    """Pairs of a Trainer and the number of tasks that differ from its task in the seed alone."""
    alike = {}
    for task in tasks:
        alike.setdefault(task._replace(seed=0).path, []).append(task)
    return [(trainer_of(group[0]), len(group)) for group in alike.values()]


def fit(task):
    """The trained model of a task."""
    with np.errstate(all="ignore"):  # the trainers look for non-finite values themselves
        return trainer_of(task).run()


def write(task, model):
    """Write the file of a task; returns its bytes by kind."""
    if not task.is_ours:
        return model.save(task.path)
    if task.plain is not None:
        return save_plain(model, task.path, task.plain)
    data = encode(model)
    output.write_atomically(task.path, lambda file: file.write(data))
    return kinds(components(data))


def kinds(sizes):
    """The bytes of one of our files as those of a baseline: Gaussians, networks, the rest.

    The hash grid counts among the networks, like the planes of 4DHexPlane.
    """
    network = sum(
        n for name, n in sizes.items() if name.endswith(("mlp", "mlps")) or name == "hash_grid"
    )
    return {
        "gaussians": sum(sizes.values()) - network - sizes["header"],
        "network": network,
        "other": sizes["header"],
    }


def load(path):
    """The model in a file of any method."""
    if path.suffix == ".p4dgs":
        return decode(path.read_bytes())
    return (load_plain if path.suffix == ".npy" else baselines.load)(path)


def make(task):
    """Train, write the file, read it back and measure it; the row, which is also written.

    `train_seconds` are processor time.
    """
    model, (seconds, _) = clocked(fit, task)
    with output.made(task.folder):
        sizes = write(task, model)
    metrics, _, _ = evaluate(load(task.path), task.scene)
    found = {
        **known_of(task),
        **metrics,
        "bytes": sum(sizes.values()),
        **{f"{kind}_bytes": size for kind, size in sizes.items()},
        "train_seconds": float(seconds),
        "made": f"{date.today()}",
        "arithmetic": arithmetic(),
        "command": task.command,
    }
    if task.path.suffix == ".p4dgs":
        sections = {part["name"]: part for part in ledger(task.path.read_bytes())}
        found["estimated_bytes"] = round(sum(part["estimate_bytes"] for part in sections.values()))
        found["anchor_bytes"] = sum(sections[name]["bytes"] for name in ATTRIBUTE_SECTIONS)
        found["positions_bytes"] = sections["positions"]["bytes"]
        found["deformation_bytes"] = sections.get("deformation_mlp", {}).get("bytes", 0)
    row = {name: found[name] for name in FIELDS if name in found}
    text = json.dumps(sealed(json_safe(row)), indent=1) + "\n"
    output.write_atomically(task.record, lambda file: file.write(text.encode()))
    return row


def sealed(row):
    """A row with the first digits of its own sha256, which tell whether it was changed later."""
    return {**row, "row_sha256": digits(json.dumps(row).encode())}


def digits(data):
    """The first digits of the sha256 of bytes."""
    return hashlib.sha256(data).hexdigest()[:16]


def make_missing(tasks, progress=lambda line: None, jobs=1, agree=lambda trainers, jobs: None):
    """Make the rows that are not there.

    Before the first training, `agree` gets the `trainers` of these tasks and how many of them run
    at once; it raises an error to stop. Raises SceneError where a scene has no test views, and
    StudyError for a row that is not as `make` has written it.
    """
    for task in tasks:
        require(task.scene.test, f"scene {task.scene.name}", "split 'test': no views to measure on")
    missing = [task for task in tasks if row_of(task) is None]
    agree(trainers(missing), min(jobs, len(missing)))
    for done, _ in enumerate(in_processes(make, missing, jobs), 1):
        progress(f"{done} of {len(missing)} trainings")


def made(tasks):
    """The rows that are there."""
    return [row for row in map(row_of, tasks) if row is not None]


def row_of(task):
    """The row that is there, or None. Raises StudyError unless it is as `make` has written it."""
    try:
        for path in (task.path, task.record):
            output.destination(path)  # a pipe would be read without end
        return checked_row(task) if task.record.exists() else None
    except (OSError, output.OutputError, SceneError) as error:
        raise StudyError(f"{error}; delete it, or name another folder") from None


def checked_row(task):
    """The row that is there, after it was compared with its checksum, its task and its file."""
    kept = read_json(task.record, "the row of a training")
    row = {name: value for name, value in kept.items() if name != "row_sha256"}
    require(task.path.exists(), task.record, f"its file is missing; expected {task.path}")
    for name, value in known_of(task).items():
        require(
            row.get(name) == value,
            f"{task.record}: {name}",
            f"{row.get(name)!r:.200}; expected {value!r}",
        )
    require(kept == sealed(row), task.record, "changed; expected it as the training has written it")
    return row


def known_of(task):
    """The fields of a row that follow from its task and its file."""
    preset = preset_of(task)
    return {
        "method": task.method,
        "scene": task.scene.name,
        "seed": task.seed,
        "label": task.label,
        **{name: getattr(preset, name) for name in KNOBS if hasattr(preset, name)},
        "file": task.path.name,
        "iterations": preset.iterations,
        "release": __version__,
        "sha256": digits(task.path.read_bytes()),
    }


# --- plain files ----------------------------------------------------------------------------------
# A model of anchors without quantisation and entropy coding, for the ablation: one record of NumPy,
# whose fields are the arrays, in float32, or in float16 for the networks in `half`. Every child of
# an anchor is stored, as in Scaffold-GS; the networks and the grid of the entropy coder are not.
def save_plain(model, path, half=()):
    """Write the file and return its bytes by kind, like a baseline's."""
    gaussians = {name: a for name, a in model.anchors._asdict().items() if name != "mask"}
    network = {
        key: a
        for name, layers in model.networks.items()
        if name not in CONTEXT_NETWORKS
        for key, a in baselines.explicit.of_network(name, *layers).items()
    }
    values = {**gaussians, **network, "background": model.background}
    types = [
        (name, "f2" if name.split(".")[0] in half else "f4", a.shape) for name, a in values.items()
    ]
    design = str(vars(model.design))
    record = np.array((*values.values(), design), [*types, ("design", f"S{len(design)}")])
    output.write_atomically(path, lambda file: np.save(file, record))
    anchors, weights = (sum(record[n].nbytes for n in part) for part in (gaussians, network))
    return {
        "gaussians": anchors,
        "network": weights,
        "other": path.stat().st_size - anchors - weights,
    }


def load_plain(path):
    """The model in a file, ready to be rendered."""
    record = np.load(path)
    *names, _ = record.dtype.names
    p = Parameters({name: record[name] for name in names}, float)
    attributes = [p[name] for name in Anchors._fields[:-1]]
    anchors = Anchors(*attributes, mask=np.ones(p["O_a"].shape[:2], bool))
    networks = dict.fromkeys(name.split(".")[0] for name in names if "." in name)
    design = literal_eval(record["design"].item().decode())
    form = d3dgs_network if "time_net" in design else paper
    box, networks = bounding_box(anchors.x_a), {name: p.network(name) for name in networks}
    return form.Model(form.Design(**design), anchors, networks, [], box, p["background"])
