"""Training from Python in one call, and warnings about one that cannot learn its scene."""

import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike

from ..model import Model
from ..scenes.output import locked
from ..scenes.scene import Scene
from ..signals import deferred
from ..splatting.settings import FAST, Settings
from . import checkpoint
from .initial import design_of
from .parameters import Parameters
from .presets import PAPER_SYNTHETIC, Preset, choose
from .progress import Progress, psnr
from .trainer import Trainer, assemble, tagged

SAVE_EVERY = 20.0  # seconds between checkpoints
FEW_VIEWS = 24  # on `bouncing`, 24 views lose 1.2 dB against 48, 16 far more (reference.md, Limits)
LEAST_GAIN = 1.0  # dB above the best picture of one colour


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
    of a result that is hardly better than a picture of one colour.
    """
    return fit(
        scene, preset, seed, settings, points, folder, resume, stream, save_every, **changes
    ).model()


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
    """Do what `train` does, but return the Trainer, which also has the history."""
    chosen = choose(preset, changes)
    if not (isinstance(seed, int) and seed >= 0):
        raise ValueError(f"seed {seed!r}: expected an integer of at least 0")
    # Non-finite values are found and named; NumPy's warnings would say the same less clearly.
    with np.errstate(all="ignore"):
        trainer, progress = Trainer(scene, chosen, seed, settings, points), Progress(stream)
        with nullcontext() if folder is None else locked(folder), deferred() as asked:
            common = checkpoint.identity(trainer)
            if resume and folder is not None:
                checkpoint.resume(trainer, folder, common)

            def keep(trainer):
                if folder is not None:
                    checkpoint.save(trainer, folder, common)

            keep(trainer)
            warn_of_few_views(scene)

            def after_step(trainer, *seen):
                progress(trainer, *seen)
                if asked:
                    keep(trainer)
                    raise KeyboardInterrupt

            try:
                trainer.run(after_step, save_every, keep)
            finally:
                progress.close()
            keep(trainer)
        warn_of_failure(trainer)
    return trainer


def warn_of_few_views(scene):
    """Warn where a scene has too few training views to show how it looks from elsewhere."""
    count = len(scene.train)
    if count < FEW_VIEWS:
        warnings.warn(
            f"scene {scene.name}: {count} training views; views that were not trained on will be "
            f"poor with fewer than {FEW_VIEWS}; 48 are enough for the packaged scenes",
            stacklevel=4,
        )


def warn_of_failure(trainer):
    """Warn where the pictures of a trained model are hardly better than one colour.

    Both are compared with all training views. The mean of their colours has the smallest squared
    error of all colours.
    """
    model, views = trainer.model(), trainer.scene.train
    color = np.mean([view.image.mean(axis=(0, 1)) for view in views], axis=0)
    flat = np.mean([psnr(np.broadcast_to(color, v.image.shape), v.image) for v in views])
    learnt = np.mean(
        [psnr(model.render(v.camera, v.time, trainer.settings), v.image) for v in views]
    )
    if learnt < flat + LEAST_GAIN < np.inf:  # infinite where the scene itself has one colour
        warnings.warn(
            f"scene {trainer.scene.name}: the result has {learnt:.2f} dB on the training views, a "
            f"picture of one colour {flat:.2f} dB; try sparse_share=1, more iterations "
            "(stage_ends), another seed, or pictures in which the object is larger",
            stacklevel=4,
        )


def load_model(folder: str | Path) -> tuple[Model, dict]:
    """The model in the checkpoint of a run folder, and the values of the checkpoint."""
    arrays, values = checkpoint.load(folder)
    fields = {field: value for field, value in values["preset"].items() if field != "name"}
    p = Parameters(tagged(arrays, "p"))
    box = tuple(arrays["box"]) if "box" in arrays else None
    design = design_of(choose(PAPER_SYNTHETIC, fields), values["effects"])
    return assemble(p, design, arrays["mask"], box, values["background"]), values
