"""Run folders: a checkpoint from which training goes on to the same bytes."""

import json
import zlib
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..scenes.output import destination, write_atomically
from ..scenes.scene import MODEL_EFFECTS, is_number
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
        check(arrays, values)
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


def is_count(value, most=np.inf):
    """Whether a value is an integer from 0 to `most`."""
    return is_number(value, int) and 0 <= value <= most


def is_row(row):
    """Whether a value is a row of training.csv; the PSNR of equal pictures is infinite."""
    fits = [is_number(n, int, float) and (n == np.inf or abs(n) <= LARGEST) for n in row]
    return len(fits) == len(COLUMNS) and all(fits)


def is_random_state(value):
    """Whether a value is a state of NumPy's default generator."""
    generator = np.random.PCG64()
    with suppress(ValueError, TypeError, KeyError, OverflowError):
        generator.state = value
    return generator.state == value


# What each JSON value must be, in words and as a test of it, of all values and of the preset.
VALUES = {
    "seed": ("an integer of at least 0", lambda seed, *_: is_count(seed)),
    "effects": (
        "some effects of the model, each once and in their order",
        lambda effects, *_: effects == [name for name in MODEL_EFFECTS if name in effects],
    ),
    "background": (
        "three numbers in [0, 1]",
        lambda color, *_: len(color) == 3 and all(0 <= c <= 1 for c in color),
    ),
    "settings": (
        "all settings of the renderer",
        lambda settings, *_: settings.keys() == set(Settings._fields),
    ),
    "iteration": (
        "an integer from 0 to the last iteration",
        lambda iteration, _, preset: is_count(iteration, preset.iterations),
    ),
    "history": (
        f"rows of {len(COLUMNS)} numbers, not more than iterations",
        lambda rows, values, _: len(rows) <= values["iteration"] and all(map(is_row, rows)),
    ),
    "rng": ("a state of NumPy's PCG64", lambda state, *_: is_random_state(state)),
}


def check(arrays, values):
    """Raise ValueError with the first field that `save` would not have written.

    The arrays must be those that a new training with as many anchors would save.
    """
    preset = preset_of(values)
    for field, (expected, is_met) in VALUES.items():
        try:
            need(is_met(values[field], values, preset), field, expected)
        except (TypeError, AttributeError):  # a value of another kind
            need(False, field, expected)
    mask, iteration = arrays.get("mask"), values["iteration"]
    need(mask is not None and mask.ndim == 2 and len(mask), "mask", "one row for each anchor")
    points = np.arange(len(mask))[:, None] * [preset.voxel, 0, 0]
    new = Trainer(SimpleNamespace(effects=values["effects"]), preset, points=points)
    wanted = new.state()[0]
    wanted["order"] = np.zeros(arrays.get("order", mask).size, np.int64)
    if iteration > preset.stage_ends[2]:
        wanted["box"] = np.zeros((2, 3), np.float32)
    for name in sorted({*arrays, *wanted}):
        check_array(name, arrays.get(name), wanted.get(name))
    order, box = arrays["order"].tolist(), arrays.get("box", np.zeros((2, 3)))
    need(len(set(order)) == len(order), "order", "each view once")
    need(np.all(box[0] <= box[1]), "box", "its lower corner, then its upper one")
    steps = values["steps"]
    complete = isinstance(steps, dict) and steps.keys() == new.adam.steps.keys()
    counted = complete and all(is_count(n, iteration) for n in steps.values())
    need(counted, "steps", f"an integer from 0 to {iteration} for each parameter")


def check_array(name, array, like):
    """Raise ValueError unless an array is like another and has values that it can have."""
    need(like is not None, name, "no such array")
    form = f"{like.dtype} of shape {list(like.shape)}"
    got = "nothing" if array is None else f"{array.dtype} of shape {list(array.shape)}"
    need(got == form, name, f"{form}, got {got}")
    need(np.all(np.abs(array) <= LARGEST), name, "finite numbers in the range of float32")
    signed = name.startswith(("p/", "m/", "box"))
    need(signed or np.all(array >= 0), name, "no negative number")


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
