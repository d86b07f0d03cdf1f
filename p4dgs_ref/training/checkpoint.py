"""Run folders: a checkpoint from which training goes on to the same bytes."""

import json
import zlib
from pathlib import Path

import numpy as np

from ..scenes.output import remove_leftovers, write_atomically
from .presets import Preset

VERSION = 1
CHECKPOINT = "checkpoint.npz"
IDENTITY = {"preset", "seed", "effects", "background", "settings", "scene"}
STATE = {"iteration", "steps", "rng", "history"}


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
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        values = json.loads(arrays.pop("_values").tobytes())
        version = values["version"]
    except OSError as error:
        raise RunError(
            f"{path}: {error.strerror or 'damaged'}; expected a checkpoint, "
            f"which `p4dgs-ref train SCENE -o {folder}` makes"
        ) from None
    except Exception:  # a damaged archive can fail in any layer of its reader
        raise RunError(f"{path}: damaged, or not a checkpoint of `p4dgs-ref train`") from None
    complete = IDENTITY | STATE <= set(values) and set(values["preset"]) == set(Preset._fields)
    if version != VERSION or not complete:
        raise RunError(
            f"{path}: field 'version': written by another release (version {version}); expected "
            f"version {VERSION}; train again into another folder"
        )
    return arrays, values


def preset_of(values):
    """The preset that a checkpoint was made with."""
    fields = values["preset"].items()
    return Preset(**{name: tuple(v) if isinstance(v, list) else v for name, v in fields})


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
    trainer.restore(arrays, values)
    remove_leftovers(Path(folder) / CHECKPOINT)
