"""Training in one call, and the checkpoint from which it goes on to the same bytes.

`train` warns of a scene with few views, and of a model that has lost what moves.
"""

import hashlib
import io
import json
import time
import warnings
import zlib
from contextlib import nullcontext
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike

from .. import effects as fx
from ..model import Model
from ..output import destination, locked, write_atomically
from ..scenes.scene import Scene
from ..signals import deferred
from ..splatting.settings import FAST, Settings
from .body import unlike
from .initial import design_of
from .loop import Progress, psnr
from .parameters import Parameters
from .presets import PAPER_SYNTHETIC, Preset, choose
from .trainer import Trainer, assemble, tagged

SAVE_EVERY = 20.0  # seconds between checkpoints
FEW_VIEWS = 24  # on `bouncing`, 24 views lose 1.2 dB against 48, 16 far more (reference.md, Limits)
TIMES = 9  # the model is drawn at so many; the median of these pictures shows it at rest
MOST_VIEWS = 20  # that are drawn so; of more views every second, third, ... is taken
LEAST_GAIN = 3.0  # dB above the mean of the training pictures, where something moves
CHECKPOINT = "checkpoint.npz"
# Part of what the checksum is taken of, so that the checkpoint of another release does not fit.
RELEASE = f"checkpoint 3, fields {Preset._fields}".encode()
CHECKSUM_BYTES = 32


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
    save_every: float = SAVE_EVERY,
    **changes: Any,
) -> Model:
    """Fit a scene and return the model, ready to be rendered or encoded.

    `preset` is a preset or its name; further keywords change its fields. Anchors start at `points`
    [A, 3] in scene units, without them at those of the scene, and at random where it has none. In
    `folder`, which must exist, a checkpoint is kept and renewed every `save_every` seconds; with
    `resume` training goes on from it. The progress line goes to `stream`.

    Raises ValueError for an unknown preset, field or value, RunError for a checkpoint that does not
    fit, OutputError for a folder in which another training runs, and NotFinite with the first
    equation, array and index that is NaN or infinite. Ctrl-C or SIGTERM raise KeyboardInterrupt
    after the current iteration, a second one at once. Warns of a scene with few training views, and
    where what moves is hardly better than in the mean of the training pictures.
    """
    warn(few_views(scene))
    trainer = fit(
        scene, preset, seed, settings, points, folder, resume, stream, save_every, **changes
    )
    warn(lost(trainer))
    return trainer.model()


def fit(
    scene: Scene,
    preset: str | Preset,
    seed: int,
    settings: Settings = FAST,
    points: ArrayLike | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    stream: TextIO | None = None,
    save_every: float = SAVE_EVERY,
    **changes: Any,
) -> Trainer:
    """Do what `train` does without its warnings, and return the Trainer, which has the history."""
    chosen = choose(preset, changes)
    # Non-finite values are found and named; NumPy's warnings would say the same less clearly.
    with np.errstate(all="ignore"):
        trainer, progress = Trainer(scene, chosen, seed, settings, points), Progress(stream)
        with nullcontext() if folder is None else locked(folder), deferred() as asked:
            common = identity(trainer)
            if resume and folder is not None:
                go_on(trainer, folder, common)

            def keep():
                if folder is not None:
                    save_checkpoint(trainer, folder, common)

            keep()
            saved = time.monotonic()
            while trainer.iteration < chosen.iterations and not asked:
                progress(trainer, *trainer.step())
                if time.monotonic() - saved > save_every:
                    keep()
                    saved = time.monotonic()
            keep()  # then `deferred` raises KeyboardInterrupt where it was asked for
    return trainer


def warn(sentence):
    """Warn the caller of the calling function, if there is something to say."""
    if sentence:
        warnings.warn(sentence, stacklevel=3)


def few_views(scene):
    """What to say where a scene has too few training views to show how it looks from elsewhere."""
    if len(scene.train) >= FEW_VIEWS:
        return ""
    return (
        f"scene {scene.name}: {len(scene.train)} training views; views that were not trained "
        f"on will be poor with fewer than {FEW_VIEWS}; 48 are enough for the packaged scenes"
    )


def lost(trainer):
    """What to say where what moves is hardly better than in one picture shown for all views.

    This picture is the mean of the training views. Both are compared with test views, which
    training has not seen, or with training views where a scene has no others, in all pixels that
    are unlike the median of the model's own pictures over nine times.
    """
    model, scene = trainer.model(), trainer.scene
    views, mean = scene.test or scene.train, np.mean([v.image for v in scene.train], axis=0)
    times = np.quantile([v.time for v in scene.train], np.linspace(0, 1, TIMES))
    found, size = [], 0
    for v in views[:: 1 + len(views) // MOST_VIEWS]:
        drawn, *others = (model.render(v.camera, t, trainer.settings) for t in (v.time, *times))
        moves = unlike(v.image, np.median(others, axis=0))
        found.append([image[moves] for image in (drawn, mean, v.image)])
        size += moves.size
    drawn, mean, truth = map(np.concatenate, zip(*found))
    if not len(truth) or psnr(drawn, truth) >= psnr(mean, truth) + LEAST_GAIN:
        return ""
    moved = fx.moves(scene.effects)
    remedy = (
        "`--set body=true` or a preset that has it, such as tiny_coded (B3)"
        if moved and not trainer.preset.body
        else "another seed, more iterations (stage_ends), more views or larger bodies"
    )
    return (
        f"scene {scene.name}: {'what moves is lost' if moved else 'the result is useless'}: where "
        f"{'test' if scene.test else 'training'} views differ from the model at rest "
        f"({len(truth) / size:.1%} of the pixels), it has {psnr(drawn, truth):.2f} dB, the mean of "
        f"the training pictures {psnr(mean, truth):.2f} dB; try {remedy}"
    )


def fingerprint(views, text=""):
    """CRC-32 of a text and of all that training reads of views: pictures, cameras and times."""
    crc = zlib.crc32(text.encode())
    for view in views:
        numbers = [*map(np.ravel, vars(view.camera).values()), [view.time]]
        crc = zlib.crc32(np.concatenate(numbers).tobytes(), zlib.crc32(view.image.tobytes(), crc))
    return crc


def identity(trainer):
    """What a checkpoint has in common with every training that goes on from it, as JSON values."""
    return {
        **{f"preset.{name}": value for name, value in trainer.preset._asdict().items()},
        "seed": trainer.seed,
        "effects": list(trainer.design.effects),
        "background": [float(c) for c in trainer.scene.background],
        **{f"settings.{name}": value for name, value in trainer.settings._asdict().items()},
        "scene": fingerprint(trainer.scene.train),
    }


def checksum(data):
    """The SHA-256 of an archive and of the RELEASE that can read it."""
    return hashlib.sha256(RELEASE + data).digest()


def save_checkpoint(trainer, folder, common):
    """Write the state of the trainer to checkpoint.npz; `common` is its `identity`.

    The checksum of the archive stands behind it.
    """
    arrays, values = trainer.state()
    archive = io.BytesIO()
    np.savez(archive, values=json.dumps({**common, **values}), **arrays)
    data = archive.getvalue()
    write_atomically(Path(folder) / CHECKPOINT, lambda file: file.write(data + checksum(data)))


def load_checkpoint(folder):
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
    data, found = whole[:-CHECKSUM_BYTES], whole[-CHECKSUM_BYTES:]
    if found != checksum(data):
        raise RunError(
            f"{path}: damaged, edited or written by another release; expected a checkpoint as "
            "`p4dgs-ref train` writes it; train again into another folder"
        )
    arrays = dict(np.load(io.BytesIO(data)))
    return arrays, json.loads(str(arrays.pop("values")))


def go_on(trainer, folder, common):
    """Put the state of a checkpoint into a fresh trainer of the same preset, seed and scene.

    Raises RunError with the first field in which their identities differ.
    """
    arrays, values = load_checkpoint(folder)
    for field, ours in json.loads(json.dumps(common)).items():
        if values.get(field) != ours:
            raise RunError(
                f"{Path(folder) / CHECKPOINT}: field '{field}': the checkpoint was made with "
                "another one; pass what the training was started with, or choose a new output "
                "folder"
            )
    trainer.restore(arrays, values)


def load_model(folder: str | Path) -> tuple[Model, dict]:
    """The model in the checkpoint of a run folder, and the values of the checkpoint."""
    arrays, values = load_checkpoint(folder)
    fields = {name: values[f"preset.{name}"] for name in Preset._fields[1:]}
    p = Parameters(tagged(arrays, "p"))
    design = design_of(choose(PAPER_SYNTHETIC, fields), values["effects"])
    return assemble(p, design, arrays["mask"], tuple(arrays["box"]), values["background"]), values
