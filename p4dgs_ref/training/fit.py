"""Training to the end, with a checkpoint from which it goes on to the same bytes.

Warnings say before a training that views, pictures or points are of little use, and after it that a
model has lost what moves.
"""

import hashlib
import io
import json
import time
import warnings
import zlib
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike

from .. import effects as fx
from ..model import Model
from ..output import destination, locked, refuse_existing, write_atomically
from ..scenes.scene import Scene
from ..signals import deferred
from ..splatting.settings import FAST, Settings
from .initial import design_of, lattice_nodes, starting_points
from .parameters import Parameters
from .presets import PAPER_SYNTHETIC, Preset, choose
from .progress import Progress, psnr
from .trainer import Trainer, assemble, tagged

SAVE_EVERY = 20.0  # seconds between checkpoints
FEW_VIEWS = 24  # on `bouncing`, 24 views lose 1.2 dB against 48, 16 far more (reference.md, Limits)
FEW_POINTS = 0.1  # the share of starting points that may merge or be unseen without a warning
FAR = 10  # times the distance from the middle of nine tenths of the points
FOREGROUND_THRESHOLD = 0.1  # difference of a channel from which on two pixels disagree
TIMES = 9  # the model is drawn at so many; the median of these pictures shows it at rest
MAX_VIEWS = 20  # that are drawn so; of more views every second, third, ... is taken
MIN_GAIN = 3.0  # dB above the mean of the training pictures, where something moves
CHECKPOINT = "checkpoint.npz"
MAX_CHECKPOINT_BYTES = 2**30  # a model, the two moments of each number, and statistics
GO_ON = "--resume (resume=True) goes on from it, another folder starts anew"
# Part of what the checksum is taken of, so that the checkpoint of another release does not fit.
RELEASE = f"checkpoint 4, fields {[row.name for row in fields(Preset)]}".encode()
CHECKSUM_BYTES = 32


class RunError(ValueError):
    """A run folder that cannot be used: one line naming the file, the field and what to do."""


def run(trainer, folder=None, resume=False, stream=None, save_every=SAVE_EVERY):
    """Train to the end. In `folder` a checkpoint is kept; with `resume` training goes on from it.

    Raises RunError for a checkpoint that does not fit, OutputError for a folder in which another
    training runs or has run, and NotFinite. Ctrl-C, SIGTERM or SIGHUP raise KeyboardInterrupt
    after the current iteration, a second one at once.
    """
    # Non-finite values are found and named; NumPy's warnings would say the same less clearly.
    with np.errstate(all="ignore"):
        with nullcontext() if folder is None else locked(folder), deferred() as asked:
            progress, common = Progress(stream), identity(trainer)
            if resume and folder is not None:
                go_on(trainer, folder, common)
            elif folder is not None:
                refuse_existing(Path(folder) / CHECKPOINT, GO_ON)

            def keep():
                if folder is not None:
                    save_checkpoint(trainer, folder, common)

            keep()
            saved = time.monotonic()
            while trainer.iteration < trainer.preset.iterations and not asked:
                progress(trainer, *trainer.step())
                if time.monotonic() - saved > save_every:
                    keep()
                    saved = time.monotonic()
            keep()  # then `deferred` raises KeyboardInterrupt where it was asked for


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


def empty_pictures(scene):
    """What to say where pictures are blank, or the same as that of a camera elsewhere."""
    views, first = [*scene.train, *scene.test], {}
    others = [first.setdefault(view.image.tobytes(), view) for view in views]
    empty = sum(
        np.ptp(a.image, axis=(0, 1)).max() <= FOREGROUND_THRESHOLD
        or np.any(a.camera.center != b.camera.center)
        for a, b in zip(views, others)
    )
    if not empty:
        return ""
    return (
        f"scene {scene.name}: {empty} of {len(views)} pictures show hardly more than one colour, "
        "or the same as that of a camera elsewhere; good figures on these mean nothing"
    )


def odd_points(scene, preset, seed, points):
    """What to say where points that anchors start from merge, are not seen, or lie far off."""
    points = scene.points if points is None else points
    # The training draws the same points from this seed.
    points = starting_points(points, preset.anchors, preset.extent, np.random.default_rng(seed))
    depth = np.zeros(len(points))  # the largest one at which a picture has the point
    for view in scene.train:
        c = view.camera
        x, y, z = (points @ c.R.T + c.T).T
        u = c.f_x * x + (c.c_x + 0.5) * z  # pixels from the picture's corner, times z
        v = c.f_y * y + (c.c_y + 0.5) * z
        inside = (u >= 0) & (u <= c.width * z) & (v >= 0) & (v <= c.height * z)
        depth = np.maximum(depth, np.where(inside, z, 0))
    close = np.sum((depth > 0) & (depth <= FAST.near))
    merged = len(points) - len(lattice_nodes(points, preset))
    reach = np.abs(points - np.median(points, axis=0)).max(axis=1)
    far = np.sum(reach > FAR * np.quantile(reach, 0.9))
    counts = {
        f"sharing the voxel of another, so that they merge (voxel {preset.voxel:g})": merged,
        f"nearer than {FAST.near:g} to the cameras": close,
        "outside every training view": np.sum(depth == 0),
        f"more than {FAR} times as far from their middle as nine tenths of them": far,
    }
    if not far and max(counts.values()) <= FEW_POINTS * len(points):
        return ""
    told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    return (
        f"scene {scene.name}: of {len(points)} starting points, {told}; check their units and axes"
    )


def doubts(scene, preset, seed, points=None):
    """Three sentences to say before a training, each of them empty where it does not hold."""
    return few_views(scene), empty_pictures(scene), odd_points(scene, preset, seed, points)


def disagreements(image, other):
    """The pixels [H, W] in which an image [H, W, 3] differs from another one, or from a colour."""
    return np.abs(image - other).max(axis=2) > FOREGROUND_THRESHOLD


def lost(trainer):
    """What to say where what moves is hardly better than in one picture shown for all views.

    This picture is the mean of the training views. Both are compared with test views, which
    training has not seen, or with training views where a scene has no others, in all pixels that
    disagree with the median of the model's own pictures over nine times.
    """
    model, scene = trainer.model(), trainer.scene
    views, mean = scene.test or scene.train, np.mean([v.image for v in scene.train], axis=0)
    times = np.quantile([v.time for v in scene.train], np.linspace(0, 1, TIMES))
    pixels, size = [], 0
    for v in views[:: 1 + len(views) // MAX_VIEWS]:
        drawn, *others = (model.render(v.camera, t, trainer.settings) for t in (v.time, *times))
        moves = disagreements(v.image, np.median(others, axis=0))
        pixels.append([image[moves] for image in (drawn, mean, v.image)])
        size += moves.size
    drawn, mean, truth = map(np.concatenate, zip(*pixels))
    of_mean = psnr(mean, truth) if len(truth) else np.inf  # infinite: nothing moves
    if np.isinf(of_mean) or psnr(drawn, truth) >= of_mean + MIN_GAIN:
        return ""
    return (
        f"scene {scene.name}: "
        f"{'what moves is lost' if fx.moves(scene.effects) else 'the result is useless'}: where "
        f"{'test' if scene.test else 'training'} views differ from the model at rest "
        f"({len(truth) / size:.1%} of the pixels), it has {psnr(drawn, truth):.2f} dB, the mean of "
        f"the training pictures {of_mean:.2f} dB; try another seed, more iterations (stage_ends), "
        "more views or larger bodies"
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
        **{f"preset.{name}": value for name, value in vars(trainer.preset).items()},
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
    expected = f"expected a checkpoint, which `p4dgs-ref train SCENE -o {folder}` makes"
    try:
        if path.stat().st_size > MAX_CHECKPOINT_BYTES:
            raise RunError(f"{path}: larger than {MAX_CHECKPOINT_BYTES} bytes; {expected}")
        whole = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; {expected}") from None
    data, end = whole[:-CHECKSUM_BYTES], whole[-CHECKSUM_BYTES:]
    if end != checksum(data):
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
    for field, value in json.loads(json.dumps(common)).items():
        if values.get(field) != value:
            raise RunError(
                f"{Path(folder) / CHECKPOINT}: field '{field}': the checkpoint was made with "
                "another one; pass what the training was started with, or choose a new output "
                "folder"
            )
    trainer.restore(arrays, values)


def load_model(folder: str | Path) -> tuple[Model, dict]:
    """The model in the checkpoint of a run folder, and the values of the checkpoint."""
    arrays, values = load_checkpoint(folder)
    fields = {
        name.removeprefix("preset."): value
        for name, value in values.items()
        if name.startswith("preset.") and name != "preset.name"
    }
    design = design_of(choose(PAPER_SYNTHETIC, fields), values["effects"])
    p, box = Parameters(tagged(arrays, "p")), tuple(arrays["box"])
    return assemble(p, design, arrays["mask"], box, values["background"]), values


def fit(
    scene: Scene,
    preset: str | Preset = "tiny",
    seed: int = 0,
    settings: Settings = FAST,
    points: ArrayLike | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    stream: TextIO | None = None,
    save_every: float = SAVE_EVERY,
    **changes: Any,
) -> Trainer:
    """Do what `train` does without its warnings, and return the Trainer, which has the history."""
    trainer = Trainer(scene, choose(preset, changes), seed, settings, points)
    run(trainer, folder, resume, stream, save_every)
    return trainer


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
    fit, OutputError for a folder in which another training runs or has run, and NotFinite with the
    first equation, array and index that is NaN or infinite. Ctrl-C, SIGTERM or SIGHUP raise
    KeyboardInterrupt after the current iteration, a second one at once. Warns of a scene with few
    training views, of pictures and starting points that are of no use, and where what moves is
    hardly better than in the mean of the training pictures.
    """
    preset = choose(preset, changes)
    for sentence in doubts(scene, preset, seed, points):
        warn(sentence)
    trainer = fit(scene, preset, seed, settings, points, folder, resume, stream, save_every)
    warn(lost(trainer))
    return trainer.model()
