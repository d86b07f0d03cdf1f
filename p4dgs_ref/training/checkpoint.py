"""Run folders: a checkpoint from which training goes on to the same bytes."""

import json
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..scenes.output import destination, write_atomically
from ..scenes.scene import MODEL_EFFECTS, background_color, is_number, model_effects
from ..splatting.settings import Settings
from .presets import Preset, choose
from .progress import COLUMNS
from .trainer import Trainer

VERSION = 1
CHECKPOINT = "checkpoint.npz"
IDENTITY = {"preset", "seed", "effects", "background", "settings", "scene"}
STATE = {"iteration", "steps", "rng", "history"}
LARGEST = float(np.finfo(np.float32).max)


class RunError(ValueError):
    """A run folder that cannot be used: one line naming the file, the field and what to do."""


def fingerprint(scene):
    """CRC-32 of everything that training reads of a scene: background, pictures, cameras, times."""
    crc = zlib.crc32(np.asarray(scene.background, float).tobytes())
    for view in scene.train:
        camera = view.camera
        lens = (camera.f_x, camera.f_y, camera.c_x, camera.c_y)
        numbers = np.array([*camera.R.ravel(), *camera.T, *lens, view.time], float)
        crc = zlib.crc32(np.ascontiguousarray(view.image), zlib.crc32(numbers, crc))
    return crc


def identity(trainer):
    """What a checkpoint has in common with every training that goes on from it, as JSON values."""
    return {
        "preset": trainer.preset._asdict(),
        "seed": trainer.seed,
        "effects": list(trainer.design.effects),
        "background": [float(c) for c in trainer.scene.background],
        "settings": trainer.settings._asdict(),
        "scene": fingerprint(trainer.scene),
    }


def save(trainer, folder, common):
    """Write the state of the trainer to checkpoint.npz; `common` is its `identity`."""
    arrays, values = trainer.state()
    text = json.dumps({"version": VERSION, **common, **values}).encode()
    arrays["_values"] = np.frombuffer(text, np.uint8)
    write_atomically(Path(folder) / CHECKPOINT, lambda file: np.savez(file, **arrays))


def load(folder):
    """The arrays and the JSON values of a checkpoint; raises RunError where it cannot be used."""
    path = Path(folder) / CHECKPOINT
    destination(path)  # a pipe or a device would be read without end
    try:
        with np.load(path, allow_pickle=False) as file:
            if sum(info.file_size for info in file.zip.infolist()) > path.stat().st_size:
                raise ValueError("compressed")  # it could be larger than the memory
            arrays = {name: np.ascontiguousarray(file[name]) for name in file.files}
        values = json.loads(arrays.pop("_values").tobytes())
        version = values["version"]
    except OSError as error:
        raise RunError(
            f"{path}: {error.strerror or 'damaged'}; expected a checkpoint, "
            f"which `p4dgs-ref train SCENE -o {folder}` makes"
        ) from None
    except Exception:  # a damaged archive can fail in any layer of its reader
        raise RunError(f"{path}: damaged, or not a checkpoint of `p4dgs-ref train`") from None
    if version != VERSION or set(values) != IDENTITY | STATE | {"version"}:
        raise RunError(
            f"{path}: field 'version': written by another release (version {version}); expected "
            f"version {VERSION}; train again into another folder"
        )
    try:
        preset = preset_of(values)
        check_values(values, preset)
        check_arrays(arrays, values, preset)
    except ValueError as error:
        raise RunError(f"{path}: {error}") from None
    return arrays, values


def need(condition, field, expected):
    """Raise ValueError unless a field is as expected."""
    if not condition:
        raise ValueError(f"field {field!r}: expected {expected}")


def preset_of(values):
    """The preset that a checkpoint was made with. Raises ValueError where there is no such one."""
    fields = values["preset"]
    complete = isinstance(fields, dict) and set(fields) == set(Preset._fields)
    need(complete and isinstance(fields["name"], str), "preset", "all fields of a preset")
    changes = {field: value for field, value in fields.items() if field != "name"}
    return choose(Preset(name=fields["name"]), changes)


def check_values(values, preset):
    """Raise ValueError with the first JSON value that `save` would not have written."""
    seed, effects, background = (values[field] for field in ("seed", "effects", "background"))
    need(is_number(seed, int) and seed >= 0, "seed", "an integer of at least 0")
    known = isinstance(effects, list) and list(model_effects(effects, "effects")) == effects
    need(known, "effects", "effects of the model in their order")
    need(isinstance(background, list), "background", "three numbers in [0, 1]")
    background_color(background, MODEL_EFFECTS, "field 'background'")
    settings = values["settings"]
    complete = isinstance(settings, dict) and set(settings) == set(Settings._fields)
    need(complete, "settings", "all settings of the renderer")
    iteration, most = values["iteration"], preset.iterations
    counted = is_number(iteration, int) and 0 <= iteration <= most
    need(counted, "iteration", f"an integer from 0 to {most}")
    rows = values["history"]
    is_table = isinstance(rows, list) and len(rows) <= iteration and all(map(is_row, rows))
    need(is_table, "history", f"at most {iteration} rows of {len(COLUMNS)} numbers")
    generator = np.random.default_rng(0).bit_generator
    try:
        generator.state = values["rng"]
    except (ValueError, TypeError, KeyError, OverflowError):
        pass  # the state is not the one given
    need(generator.state == values["rng"], "rng", "the state of a PCG64")


def is_row(row):
    """Whether a value is a row of training.csv; the PSNR of equal pictures is infinite."""
    numbers = isinstance(row, list) and all(is_number(value, int, float) for value in row)
    return (
        numbers
        and len(row) == len(COLUMNS)
        and all(value == np.inf or abs(value) <= LARGEST for value in row)
    )


def check_arrays(arrays, values, preset):
    """Raise ValueError with the first array or count of steps that `save` would not have written.

    The arrays must be those that a new training with as many anchors would save.
    """
    mask, iteration = arrays.get("mask"), values["iteration"]
    need(mask is not None and mask.ndim == 2 and len(mask), "mask", "one row for each anchor")
    points = np.arange(len(mask))[:, None] * [preset.voxel, 0, 0]
    scene = SimpleNamespace(effects=values["effects"])
    wanted, counts = Trainer(scene, preset, points=points).state()
    wanted["order"] = np.zeros(arrays.get("order", mask).size, np.int64)
    if iteration > preset.stage_ends[2]:
        wanted["box"] = np.zeros((2, 3), np.float32)
    for name in sorted(set(arrays) ^ set(wanted)):
        need(False, name, "this array" if name in wanted else "no such array")
    for name, like in wanted.items():
        array, form = arrays[name], f"{like.dtype} of shape {list(like.shape)}"
        got = f"{array.dtype} of shape {list(array.shape)}"
        need(array.dtype == like.dtype and array.shape == like.shape, name, f"{form}, got {got}")
        need(np.all(np.abs(array) <= LARGEST), name, "finite numbers in the range of float32")
        signed = name.startswith(("p/", "m/", "box"))
        need(signed or np.all(array >= 0), name, "no negative number")
    need(len(set(arrays["order"].tolist())) == arrays["order"].size, "order", "each view once")
    box = arrays.get("box")
    need(box is None or np.all(box[0] <= box[1]), "box", "its lower corner, then its upper one")
    steps = values["steps"]
    counted = isinstance(steps, dict) and set(steps) == set(counts["steps"])
    counted = counted and all(is_number(n, int) and 0 <= n <= iteration for n in steps.values())
    need(counted, "steps", f"an integer from 0 to {iteration} for each parameter")


def resume(trainer, folder, common):
    """Put the state of a checkpoint into a fresh trainer of the same preset, seed and scene.

    Raises RunError with the first field in which their identities differ.
    """
    arrays, values = load(folder)
    for field, ours in json.loads(json.dumps(common)).items():
        theirs = values[field]
        if ours == theirs:
            continue
        if isinstance(ours, dict):
            field += "." + next(name for name in ours if ours[name] != theirs.get(name))
        raise RunError(
            f"{Path(folder) / CHECKPOINT}: field '{field}': the checkpoint was made with another "
            "one; pass what the training was started with, or choose a new output folder"
        )
    order = arrays["order"]
    if order.max(initial=-1) >= len(trainer.scene.train):
        raise RunError(f"{Path(folder) / CHECKPOINT}: field 'order': expected views of the scene")
    trainer.restore(arrays, values)
