"""Run folders: settings and an atomic checkpoint from which training goes on to the same bytes."""

import json
import zlib
from pathlib import Path

import numpy as np

from ..scenes.output import remove_leftovers, write_atomically
from .presets import Preset

VERSION = 1
CHECKPOINT = "checkpoint.npz"
FIELDS = {
    "version",
    "preset",
    "seed",
    "effects",
    "background",
    "settings",
    "scene",  # the settings: `identity`
    "iteration",
    "steps",
    "rng",
    "history",
}  # the state, beside the arrays


class RunError(ValueError):
    """A run folder that cannot be used: one line naming the file, the field and what was expected."""


def fingerprint(scene):
    """CRC-32 of all that training reads of a scene: background, pictures, cameras, times."""
    crc = zlib.crc32(np.asarray(scene.background, float).tobytes())
    for view in scene.train:
        camera = view.camera
        numbers = [
            *camera.R.ravel(),
            *camera.T,
            camera.f_x,
            camera.f_y,
            camera.c_x,
            camera.c_y,
            view.time,
        ]
        crc = zlib.crc32(
            np.ascontiguousarray(view.image), zlib.crc32(np.array(numbers, float), crc)
        )
    return crc


def identity(trainer):
    """What a checkpoint and the training that goes on from it must have in common, as JSON values."""
    return {
        "preset": trainer.preset._asdict(),
        "seed": trainer.seed,
        "effects": list(trainer.design.effects),
        "background": [float(c) for c in trainer.scene.background],
        "settings": trainer.settings._asdict(),
        "scene": fingerprint(trainer.scene),
    }


def save(trainer, folder, common):
    """Write the trainer's whole state to `folder`/checkpoint.npz; `common` is its `identity`, which never changes."""
    arrays, values = trainer.state()
    text = np.frombuffer(json.dumps({"version": VERSION, **common, **values}).encode(), np.uint8)
    write_atomically(Path(folder) / CHECKPOINT, lambda file: np.savez(file, _values=text, **arrays))


def load(folder):
    """(arrays, values) of a checkpoint.

    Raises     RunError where it is missing, not a checkpoint, damaged, or of another version
    """
    path = Path(folder) / CHECKPOINT
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        values = json.loads(arrays.pop("_values").tobytes())
        version = values["version"]
    except FileNotFoundError:
        raise RunError(
            f"{path}: no such checkpoint; `p4dgs-ref train SCENE -o {folder}` makes one"
        ) from None
    except OSError as error:
        raise RunError(
            f"{path}: cannot be read ({error.strerror or 'damaged'}); expected a checkpoint of `p4dgs-ref "
            f"train`"
        ) from None
    except Exception:  # a damaged archive can fail in any layer of its reader
        raise RunError(f"{path}: damaged, or not a checkpoint of `p4dgs-ref train`") from None
    if (
        version != VERSION
        or not FIELDS <= set(values)
        or set(values["preset"]) != set(Preset._fields)
    ):
        raise RunError(
            f"{path}: field 'version': {version}, or fields of another one; expected a checkpoint of this "
            f"release, version {VERSION}"
        )
    return arrays, values


def preset_of(values):
    """The preset a checkpoint was made with."""
    return Preset(
        **{name: tuple(v) if isinstance(v, list) else v for name, v in values["preset"].items()}
    )


def resume(trainer, folder, common):
    """Put a checkpoint's state into a fresh trainer of the same preset, seed and scene.

    Raises     RunError naming the first field of `identity` in which they differ
    """
    arrays, values = load(folder)
    for field, ours in json.loads(json.dumps(common)).items():
        theirs = values[field]
        if ours != theirs:
            inner = (
                [f".{name}" for name in ours if ours[name] != theirs.get(name)]
                if isinstance(ours, dict)
                else [""]
            )
            raise RunError(
                f"{Path(folder) / CHECKPOINT}: field '{field}{inner[0]}': made with another one; expected "
                f"the settings that the training was started with"
            )
    trainer.restore(arrays, values)
    remove_leftovers(Path(folder) / CHECKPOINT)
