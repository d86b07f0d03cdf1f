"""Training to the end, with checkpoints: a training that resumes from one gives the same bytes."""

import hashlib
import io
import json
import time
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from ..model import Design, Model
from ..output import destination, locked, refuse_existing, write_atomically
from ..scenes.scene import Scene
from ..signals import deferred
from ..splatting.settings import FAST, Settings
from . import advice
from .parameters import Parameters
from .presets import FIELDS, Preset, choose
from .progress import Progress
from .trainer import Trainer, assemble, with_prefix

SAVE_EVERY = 20.0  # seconds between checkpoints
CHECKPOINT = "checkpoint.npz"
MAX_CHECKPOINT_BYTES = 2**30  # a model, the two moments of each number, and statistics
HOW_TO_RESUME = "--resume (resume=True) continues from it; another folder starts a new training"
# The checksum covers it, so that the checkpoint of another release is refused.
RELEASE = f"checkpoint 6, fields {FIELDS}".encode()


class RunError(ValueError):
    """A run folder that cannot be used: one line naming the file, the field and what to do."""


def train(
    scene: Scene,
    preset: str | Preset = "tiny",
    seed: int = 0,
    *,
    settings: Settings = FAST,
    points: ArrayLike | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    stream: TextIO | None = None,
    **changes: Any,
) -> Model:
    """Fit a scene and return the model, ready to be rendered or encoded.

    `preset` is a preset or its name; further keywords change its fields. Anchors start at `points`
    [A, 3] in scene units, by default those of the scene, or at random if it has none. In `folder`,
    which must exist, a checkpoint is kept and renewed every SAVE_EVERY seconds; with `resume`
    training continues from it. The progress line goes to `stream`.

    Raises ValueError for an unknown preset, field or value, RunError for a checkpoint that does not
    fit, OutputError for a folder in which another training runs or has run, and NotFinite with the
    first equation, array and index that is NaN or infinite. Ctrl-C, SIGTERM or SIGHUP raise
    KeyboardInterrupt after the current iteration, a second one at once. Warns of few training
    views, of blank pictures, of starting points that merge or lie far off, of kernels with which
    other machines give other bytes, of anchors that stop growing because a file could not contain
    more, of a model that draws nothing, and of one that draws little of what moves.
    """
    trainer = Trainer(scene, choose(preset, changes), seed, settings, points)
    fit_with_advice(trainer, folder, resume, stream)
    return trainer.model()


def fit_with_advice(trainer, folder=None, resume=False, stream=None, keep=lambda trainer: None):
    """Train to the end and warn; return the warning after it, or "", and the seconds of training.

    `keep` is called with the trained Trainer before the model is measured for that warning.
    """
    for sentence in advice.warnings_before(trainer):
        warnings.warn(sentence, stacklevel=3)
    start = time.perf_counter()
    run(trainer, folder, resume, stream)
    seconds = time.perf_counter() - start
    keep(trainer)
    sentence = advice.warning_after(trainer)
    if sentence:
        warnings.warn(sentence, stacklevel=3)
    return sentence, seconds


def fit(
    scene,
    preset="tiny",
    seed=0,
    settings=FAST,
    points=None,
    folder=None,
    resume=False,
    stream=None,
    save_every=SAVE_EVERY,
    **changes,
):
    """Do what `train` does, without its warnings; return the Trainer, which has the history."""
    trainer = Trainer(scene, choose(preset, changes), seed, settings, points)
    run(trainer, folder, resume, stream, save_every)
    return trainer


def run(trainer, folder, resume, stream, save_every=SAVE_EVERY):
    """Train to the end, with checkpoints in a folder; warn if the first round draws nothing."""
    progress, total = Progress(stream), trainer.preset.iterations
    with checkpoints(trainer, folder, resume) as save, deferred() as asked:
        save()
        saved, has_drawn = time.monotonic(), trainer.iteration > 0
        while trainer.iteration < total and not asked:
            losses, rendered, view = trainer.step()
            progress(trainer, losses, rendered, view)
            has_drawn |= bool(rendered.visible.any())
            if not has_drawn and trainer.iteration == len(trainer.scene.train) < total:
                warnings.warn(f"after a round of all views, {advice.nothing_is_drawn(trainer)}")
            if time.monotonic() - saved > save_every:
                save()
                saved = time.monotonic()
        save()  # then `deferred` raises KeyboardInterrupt if it was asked for


@contextmanager
def checkpoints(trainer, folder, resume):
    """Lock the folder of a run, and yield a function that saves the trainer's state there.

    With `resume` the trainer first takes over what was saved. Without a folder nothing is saved.
    """
    if folder is None:
        yield lambda: None
        return
    with locked(folder):
        common = identity(trainer)
        if resume:
            restore_checkpoint(trainer, folder, common)
        else:
            refuse_existing(Path(folder) / CHECKPOINT, HOW_TO_RESUME)
        yield lambda: save_checkpoint(trainer, folder, common)


def fingerprint(views):
    """Return CRC-32 of all that training reads of views: pictures, cameras and times."""
    crc = 0
    for view in views:
        for part in (view.image, *vars(view.camera).values(), view.time):
            crc = crc32(np.asarray(part).tobytes(), crc)
    return crc


def identity(trainer):
    """Return what a checkpoint and a training that resumes from it must share, as JSON values."""
    return {
        **{f"preset.{name}": value for name, value in vars(trainer.preset).items()},
        "seed": trainer.seed,
        "effects": trainer.design.effects,
        "design": vars(trainer.design),
        "background": trainer.scene.background.tolist(),
        "settings": trainer.settings,
        "scene": fingerprint(trainer.scene.train),
        "points": crc32(np.ascontiguousarray(trainer.points, float)),  # of NaN without points
    }


def checksum(data):
    """Return the SHA-256 of an archive and of the RELEASE that can read it."""
    return hashlib.sha256(RELEASE + data).digest()


def save_checkpoint(trainer, folder, common):
    """Write the state of the trainer to checkpoint.npz; `common` is its `identity`.

    The checksum follows the archive.
    """
    arrays, values = trainer.state()
    archive = io.BytesIO()
    np.savez(archive, values=json.dumps({**common, **values}), **arrays)
    data = archive.getvalue()
    write_atomically(Path(folder) / CHECKPOINT, lambda file: file.write(data + checksum(data)))


def load_checkpoint(folder):
    """Return arrays and JSON values of a checkpoint; raise RunError if it cannot be used."""
    path = Path(folder) / CHECKPOINT
    destination(path)  # a pipe or a device would be read without end
    expected = f"expected a checkpoint, which `p4dgs-ref train SCENE -o {folder}` makes"
    try:
        if path.stat().st_size > MAX_CHECKPOINT_BYTES:
            raise RunError(f"{path}: larger than {MAX_CHECKPOINT_BYTES} bytes; {expected}")
        whole = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; {expected}") from None
    data = whole[:-32]  # the bytes of SHA-256
    if whole != data + checksum(data):
        raise RunError(
            f"{path}: damaged, edited or written by another release; expected a checkpoint as "
            "`p4dgs-ref train` writes it; train again into another folder"
        )
    arrays = dict(np.load(io.BytesIO(data)))
    return arrays, json.loads(str(arrays.pop("values")))


def restore_checkpoint(trainer, folder, common):
    """Put the state of a checkpoint into a fresh trainer of the same preset, seed and scene.

    Raises RunError with the first field in which their identities differ.
    """
    arrays, values = load_checkpoint(folder)
    for field, value in json.loads(json.dumps(common)).items():
        if values.get(field) != value:
            raise RunError(
                f"{Path(folder) / CHECKPOINT}: field '{field}': the checkpoint was made with "
                "another one; pass what the training was started with, or choose a new output "
                "folder"
            )
    trainer.restore(arrays, values)


def load_model(folder):
    """Return the model in the checkpoint of a run folder, and the values of the checkpoint."""
    arrays, values = load_checkpoint(folder)
    model = assemble(
        Parameters(with_prefix(arrays, "p/")),
        Design(**values["design"]),
        arrays["mask"],
        tuple(arrays["box"]),
        values["background"],
    )
    return model, values
