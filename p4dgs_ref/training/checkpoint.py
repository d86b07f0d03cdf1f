"""Run folders: a checkpoint from which training goes on to the same bytes."""

import hashlib
import io
import json
import zlib
from pathlib import Path

import numpy as np

from ..scenes.output import destination, write_atomically
from .presets import Preset

VERSION = 2  # without a checksum: 1
CHECKPOINT = "checkpoint.npz"
CHECKSUM_BYTES = 32


class RunError(ValueError):
    """A run folder that cannot be used: one line naming the file, the field and what to do."""


def fingerprint(scene):
    """CRC-32 of everything that training reads of a scene: background, pictures, cameras, times."""
    crc = zlib.crc32(np.asarray(scene.background, float).tobytes())
    for view in scene.train:
        camera = view.camera
        lens = (camera.f_x, camera.f_y, camera.c_x, camera.c_y)
        numbers = np.array([*camera.R.ravel(), *camera.T, *lens, view.time], float)
        crc = zlib.crc32(view.image.tobytes(), zlib.crc32(numbers.tobytes(), crc))
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
    """Write the state of the trainer to checkpoint.npz; `common` is its `identity`.

    The SHA-256 of the archive stands behind it.
    """
    arrays, values = trainer.state()
    text = json.dumps({"version": VERSION, **common, **values}).encode()
    arrays["_values"] = np.frombuffer(text, np.uint8)
    archive = io.BytesIO()
    np.savez(archive, **arrays)
    data = archive.getvalue()
    checksum = hashlib.sha256(data).digest()
    write_atomically(Path(folder) / CHECKPOINT, lambda file: file.write(data + checksum))


def load(folder):
    """The arrays and the JSON values of a checkpoint; raises RunError where it cannot be used."""
    path = Path(folder) / CHECKPOINT
    destination(path)  # a pipe or a device would be read without end
    try:
        whole = path.read_bytes()
    except OSError as error:
        raise RunError(
            f"{path}: {error.strerror}; expected a checkpoint, "
            f"which `p4dgs-ref train SCENE -o {folder}` makes"
        ) from None
    data, checksum = whole[:-CHECKSUM_BYTES], whole[-CHECKSUM_BYTES:]
    if hashlib.sha256(data).digest() != checksum:
        raise RunError(
            f"{path}: damaged or edited, or not a checkpoint of this version; expected one as "
            "`p4dgs-ref train` writes it; train again into another folder"
        )
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    values = json.loads(arrays.pop("_values").tobytes())
    if values["version"] != VERSION or set(values["preset"]) != set(Preset._fields):
        raise RunError(
            f"{path}: field 'version': written by another release (version {values['version']}); "
            f"expected version {VERSION}; train again into another folder"
        )
    return arrays, values


def resume(trainer, folder, common):
    """Put the state of a checkpoint into a fresh trainer of the same preset, seed and scene.

    Raises RunError with the first field in which their identities differ.
    """
    arrays, values = load(folder)
    for field, ours in json.loads(json.dumps(common)).items():
        theirs = values[field]
        if isinstance(ours, dict) and ours != theirs:
            field += "." + next(name for name in ours if ours[name] != theirs.get(name))
        if ours != theirs:
            raise RunError(
                f"{Path(folder) / CHECKPOINT}: field '{field}': the checkpoint was made with "
                "another one; pass what the training was started with, or choose a new output "
                "folder"
            )
    trainer.restore(arrays, values)
