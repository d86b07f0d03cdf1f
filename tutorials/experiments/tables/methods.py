"""The maker of rows: any method on one scene is trained, written to a file, read and measured.

A study is a list of Tasks and what it says about their rows. A row begins with the fields method,
scene, seed, psnr_db and bytes; it has the first digits of its file's sha256 and the command that
makes this file. It lies as JSON beside the file, in a folder that is named after a checksum of the
scene's views, effects and background, and the length of the trainings. A row that is there is not
made again, so a killed study goes on, takes what another one has made, and can grow by scenes,
seeds and methods. Such a row is compared with its own checksum and with its file before it is used.

One training gives several files, which differ in their storage: as the authors of the method store
it, in float16, or coded alike (`baselines.coded`).
"""

import hashlib
import json
from ast import literal_eval
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p4dgs_ref import __version__, designs, output
from p4dgs_ref import model as paper
from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.attributes import ATTRIBUTES
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS
from p4dgs_ref.designs import PRESETS, choose, decode, encode
from p4dgs_ref.model import CONTEXT_NETWORKS, Anchors, bounding_box
from p4dgs_ref.report.evaluate import evaluate, json_safe
from p4dgs_ref.report.inspect import components, ledger
from p4dgs_ref.report.jobs import in_processes
from p4dgs_ref.scenes import Scene, SceneError
from p4dgs_ref.scenes.fields import require
from p4dgs_ref.scenes.files import read_json
from p4dgs_ref.training.fit import fingerprint
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import TINY_REAL, differences
from .. import StudyError, baselines, entry
from p4dgs_ref.accuracy.harness import shortened
from p4dgs_ref.baselines import coded, coded_anchors, d3dgs_network, half
from p4dgs_ref.clock import clocked
from p4dgs_ref.validation import held_back

OURS = "p4dgs"
CODED = "p4dgs_coded"  # with coded networks and positions, beyond the paper
OUR_PRESETS = {OURS: "tiny", CODED: "tiny_coded"}
AS_STORED, HALF, ALIKE = "as stored", "float16", "coded alike"  # the storage of a file
ENDINGS = {AS_STORED: "ply", HALF: "half", ALIKE: "coded"}  # of the files of baselines
PLAIN_ENDINGS = {AS_STORED: "npy", ALIKE: "anchors"}  # of plain files of our models
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
    *("method", "scene", "seed", "psnr_db", "bytes", "label", "storage", "loss", *KNOBS),
    *("held_back_db", "ssim", "psnr_fg_db", "anchors", "gaussians"),
    *("gaussians_bytes", "network_bytes", "other_bytes", "zlib_bytes", "file"),
    *("iterations", "train_seconds"),
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
    storage: str = AS_STORED  # another one is made of the file that is stored so
    loss: float | None = None  # of what is coded alike

    @property
    def trained(self):
        """The task of the training, and of its file as the authors of the method store it."""
        return self._replace(storage=AS_STORED, loss=None)

    @property
    def is_ours(self):
        """Whether it is one of our designs, not a baseline."""
        return self.method in OUR_PRESETS

    @property
    def label(self):
        """The name of its rows: the step, or the method and its changes as `--set` takes them."""
        changed = [f" {field}={value}" for field, value in self.changes.items()]
        storage = {AS_STORED: "", ALIKE: f" loss={self.loss:g}" if self.loss else ""}
        name = self.step or "".join([self.method, *changed])
        return name + storage.get(self.storage, f" {self.storage}")

    @property
    def path(self):
        """The file."""
        name = f"{self.scene.name} {self.label} seed{self.seed}".replace("+ ", "")
        ending = (PLAIN_ENDINGS if self.is_ours else ENDINGS)[self.storage]
        if self.is_ours and self.plain is None:
            ending = "p4dgs"
        return Path(self.folder) / f"{name.replace(' ', '_').replace('/', '_')}.{ending}"

    @property
    def command(self):
        """What makes the file: one training of ours, else the study of which it is a row."""
        scene, seed = self.scene.name, self.seed
        if self.is_ours and not self.step and self.storage == AS_STORED:
            preset = preset_of(self)
            changes = "".join(
                f" --set {field}={text_of(value)}"
                for field, _, value in differences(preset, PRESETS[preset.name])
            )
            return (
                f"p4dgs-ref train {scene} --preset {preset.name} --seed {seed}{changes} -o run && "
                f"p4dgs-ref encode run -o '{self.path.name}'"
            )
        if self.study == "effects":
            return f"p4dgs-ref effects {scene}"
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


def plan(sizes, names, scenes, folder, seeds=3, iterations=None, study="compare", storages=None):
    """The Tasks of some methods, for each of its `sizes` {method: [changes of the preset]}.

    All scenes with one seed come before the next seed. `storages` are further ones of the same
    trainings, {method: [(storage, loss)]}.
    """
    length = "" if iterations is None else f"_{iterations}"
    sums = [
        fingerprint(scene.train + scene.test, f"{scene.effects} {scene.background} {scene.points}")
        for scene in scenes
    ]
    places = [(scene, f"points_{crc:08x}{length}") for scene, crc in zip(scenes, sums)]
    return [
        Task(
            *(scene, method, seed, Path(folder) / place, iterations, changes, study),
            storage=storage,
            loss=loss,
        )
        for seed in range(seeds)
        for scene, place in places
        for method in names
        for changes in sizes[method]
        for storage, loss in ((AS_STORED, None), *(storages or {}).get(method, ()))
    ]


def part_of(tasks, i, n):
    """Every n-th training of some tasks, beginning with the i-th, and all files made of it.

    The parts of n processes are disjoint, also where rows are made meanwhile.
    """
    places = {path: j for j, path in enumerate(dict.fromkeys(t.trained.path for t in tasks))}
    return [task for task in tasks if places[task.trained.path] % n == i]


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
    if task.storage != AS_STORED:
        return write_again(task, model)
    if not task.is_ours:
        return model.save(task.path)
    if task.plain is not None:
        return save_plain(model, task.path, task.plain)
    data = encode(model)
    output.write_atomically(task.path, lambda file: file.write(data))
    return kinds(components(data))


def write_again(task, model):
    """Write a trained model in another storage; returns its bytes by kind.

    Of the paper's design only the networks change; its anchors are coded already.
    """
    if task.is_ours and task.plain is None:
        data = encode(coded_anchors.with_steps(model, *held_back_of(task), task.loss))
        sizes = kinds(components(data))
    elif task.storage == HALF:
        data, sizes = half.encode(model)
    else:
        model = coded_anchors.OfAnchors(model) if task.is_ours else model
        H = coded.sensitivity(model, *held_back_of(task))
        data, sizes = coded.encode(model, H, task.loss)
    output.write_atomically(task.path, lambda file: file.write(data))
    return sizes


def held_back_of(task):
    """The held-back views of a task, and the generator of the signs of the sensitivity."""
    return held_back(task.scene), np.random.default_rng(0)


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
    if path.suffix == f".{PLAIN_ENDINGS[ALIKE]}":
        return of_anchors(*coded.decode(path.read_bytes()))
    return (load_plain if path.suffix == ".npy" else baselines.load)(path)


def make(task):
    """Train, write the file, read it back and measure it; the row, which is also written.

    `train_seconds` are processor time. Another storage is made of the file of its training.
    """
    if task.storage != AS_STORED:
        model, seconds = load(task.trained.path), row_of(task.trained)["train_seconds"]
    else:
        model, (seconds, _) = clocked(fit, task)
    with output.writable_folder(task.folder):
        sizes = write(task, model)
    model = load(task.path)
    metrics, _, _ = evaluate(model, task.scene)
    choice, _, _ = evaluate(model, replace(task.scene, test=held_back(task.scene)))
    found = {
        **known_of(task),
        **metrics,
        "held_back_db": choice["psnr_db"],
        "bytes": task.path.stat().st_size,
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
    needed = {task.trained.path: task.trained for task in missing}
    trainings = [task for task in needed.values() if row_of(task) is None]
    agree(trainers(trainings), min(jobs, len(trainings)))
    again = [task for task in missing if task.storage != AS_STORED]
    for kind, group in (("trainings", trainings), ("files", again)):
        for done, _ in enumerate(in_processes(make, group, jobs), 1):
            progress(f"{done} of {len(group)} {kind}")


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
        "storage": task.storage,
        **({"loss": task.loss} if task.loss else {}),
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
    attributes = {name: p[name] for name in Anchors._fields[:-1]}
    return plain_model(p, attributes, record["design"].item().decode(), p["background"])


def of_anchors(p, values):
    """The model in such a file that is coded alike, from what `coded.decode` returns."""
    attributes = {
        row.name: np.exp(p[row.parameter]) if row.is_log else p[row.parameter] for row in ATTRIBUTES
    }
    background = np.array(values["background"])
    return plain_model(p, {"x_a": p["x"], **attributes}, values["design"], background)


def plain_model(p, attributes, design, background):
    """A model of all children of some anchors, of networks in p, and of a Design as a text."""
    design = literal_eval(design)
    names = dict.fromkeys(name.split(".")[0] for name in p.arrays if ".W" in name)
    anchors = Anchors(**attributes, mask=np.ones(attributes["O_a"].shape[:2], bool))
    networks = {name: p.network(name) for name in names}
    form = d3dgs_network if "time_net" in design else paper
    box = bounding_box(anchors.x_a)
    return form.Model(form.Design(**design), anchors, networks, [], box, background)
