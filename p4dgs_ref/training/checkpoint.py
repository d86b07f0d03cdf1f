"""Run folders: settings and an atomic checkpoint from which training goes on to the same bytes."""
import json
import os
from pathlib import Path

import numpy as np

from .presets import Preset

VERSION = 1
CHECKPOINT = "checkpoint.npz"


class RunError(ValueError):
    """A run folder that cannot be used: one line naming the file, the field and what was expected."""


def write_atomically(path, write):
    """Call `write(file)` on a file beside `path`, then rename: a reader sees the old file or the whole new one."""
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(beside, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def save(trainer, folder):
    """Write the trainer's whole state to `folder`/checkpoint.npz."""
    arrays, values = trainer.state()
    values = {"version": VERSION, "preset": trainer.preset._asdict(), "seed": trainer.seed, **values,
              "effects": list(trainer.design.effects), "background": [float(c) for c in trainer.scene.background]}
    text = np.frombuffer(json.dumps(values).encode(), np.uint8)
    write_atomically(Path(folder) / CHECKPOINT, lambda file: np.savez(file, _values=text, **arrays))


def load(folder):
    """(arrays, values) of a checkpoint.

    Raises     RunError where it is missing, not a checkpoint, or of another version
    """
    path = Path(folder) / CHECKPOINT
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        values = json.loads(arrays.pop("_values").tobytes())
    except FileNotFoundError:
        raise RunError(f"{path}: no such checkpoint; `p4dgs-ref train SCENE -o {folder}` makes one") from None
    except Exception as error:
        raise RunError(f"{path}: not a checkpoint of p4dgs_ref ({error})") from None
    if values.get("version") != VERSION:
        raise RunError(f"{path}: version {values.get('version')}, expected {VERSION}")
    return arrays, values


def preset_of(values):
    """The preset a checkpoint was made with."""
    return Preset(**{name: tuple(v) if isinstance(v, list) else v for name, v in values["preset"].items()})


def resume(trainer, folder):
    """Put a checkpoint's state into a fresh trainer of the same preset, seed and scene.

    Raises     RunError where preset, seed or effects are other ones
    """
    arrays, values = load(folder)
    for field, ours, theirs in (("preset", trainer.preset, preset_of(values)), ("seed", trainer.seed, values["seed"]),
                                ("effects", list(trainer.design.effects), values["effects"])):
        if ours != theirs:
            raise RunError(f"{Path(folder) / CHECKPOINT}: field '{field}': the checkpoint was made with another one; "
                           f"resume with the settings it was started with")
    trainer.restore(arrays, values)
