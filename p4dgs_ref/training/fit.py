"""Training from Python in one call."""

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
from . import advice, checkpoint
from .initial import design_of
from .parameters import Parameters
from .presets import Preset, choose
from .progress import Progress
from .trainer import Trainer, assemble, tagged

SAVE_EVERY = 20.0  # seconds between checkpoints


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
            keep = keeper(trainer, folder, resume)
            advice.warn_of_few_views(scene)

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
        advice.warn_of_failure(trainer)
    return trainer


def keeper(trainer, folder, resume):
    """The function that saves the trainer in the folder, called once so that a checkpoint exists.

    With `resume` the trainer first takes over the state in the folder.
    """
    if folder is None:
        return lambda trainer: None
    common = checkpoint.identity(trainer)
    if resume:
        checkpoint.resume(trainer, folder, common)
    checkpoint.save(trainer, folder, common)
    return lambda trainer: checkpoint.save(trainer, folder, common)


def load_model(folder: str | Path) -> tuple[Model, dict]:
    """The model in the checkpoint of a run folder, and the values of the checkpoint."""
    arrays, values = checkpoint.load(folder)
    p = Parameters(tagged(arrays, "p"))
    box = tuple(arrays["box"]) if "box" in arrays else None
    design = design_of(checkpoint.preset_of(values), values["effects"])
    return assemble(p, design, arrays["mask"], box, values["background"]), values
