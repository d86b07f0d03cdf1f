"""Training from Python in one call."""

import signal
import threading
from contextlib import contextmanager

import numpy as np

from ..splatting.settings import FAST
from .checkpoint import identity, load, preset_of, save
from .checkpoint import resume as restore
from .finite import NotFinite
from .initial import design_of
from .parameters import Parameters
from .presets import choose
from .progress import Progress
from .trainer import Trainer, assemble

SAVE_EVERY = 20.0  # seconds between checkpoints


def train(
    scene,
    preset="tiny",
    seed=0,
    *,
    settings=FAST,
    points=None,
    folder=None,
    resume=False,
    stream=None,
    save_every=SAVE_EVERY,
    **changes,
):
    """Fit a scene; returns the Model, ready to render or encode.

    Takes      a Scene; a preset's name (or a Preset) and fields of it to change, a seed; `points` (A, 3) to start
               from instead of random ones; an existing `folder` for checkpoints every `save_every` seconds, `resume` to
               go on from the one in it; `stream` for the progress line, None for silence
    Raises     ValueError for an unknown preset, field or value; RunError for a checkpoint that does not fit;
               NotFinite where a number stops being one, with the first equation and array in which it did;
               KeyboardInterrupt after Ctrl-C, which waits for the end of the iteration (a second one does not)
    """
    return fit(
        scene, preset, seed, settings, points, folder, resume, stream, save_every, **changes
    ).model()


def fit(
    scene,
    preset,
    seed,
    settings=FAST,
    points=None,
    folder=None,
    resume=False,
    stream=None,
    save_every=SAVE_EVERY,
    **changes,
):
    """As `train`, but returns the Trainer, with its history."""
    chosen = choose(preset, changes)
    if not (isinstance(seed, int) and seed >= 0):
        raise ValueError(f"seed {seed!r}: expected a whole number of at least 0")
    # Overflows are looked for and named, so NumPy's own warnings would say the same less well.
    with np.errstate(all="ignore"):
        trainer, progress = Trainer(scene, chosen, seed, settings, points), Progress(stream)
        keep = keeper(trainer, folder, resume)
        with stopping_between_steps() as asked:

            def after_step(trainer, *seen):
                refuse_non_finite(trainer)
                progress(trainer, *seen)
                if asked:
                    keep(trainer)
                    raise KeyboardInterrupt

            try:
                trainer.run(after_step, save_every, keep)
            finally:
                progress.close()
            keep(trainer)
    return trainer


def keeper(trainer, folder, resume):
    """The function that saves the trainer, called once: from here on there is always something to go on from."""
    if folder is None:
        return lambda trainer: None
    common = identity(trainer)
    if resume:
        restore(trainer, folder, common)
    save(trainer, folder, common)
    return lambda trainer: save(trainer, folder, common)


@contextmanager
def stopping_between_steps():
    """Within it the first Ctrl-C only makes the yielded list non-empty: half an iteration must never be saved.

    The second one raises at once, and the last checkpoint stays.  Other handlers, and other threads, are left alone.
    """
    asked = []

    def ask(number, frame):
        signal.signal(signal.SIGINT, signal.default_int_handler)
        asked.append(number)

    ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if ours:
        signal.signal(signal.SIGINT, ask)
    try:
        yield asked
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked:  # it came after the last step: the work is whole, but stop here
        raise KeyboardInterrupt


def refuse_non_finite(trainer):
    """Raise NotFinite where a step has made a parameter infinite or NaN, before it can reach a checkpoint."""
    if np.isfinite(trainer.parameters.vector).all():
        return
    name, array = next(
        (name, a) for name, a in trainer.parameters.arrays.items() if not np.isfinite(a).all()
    )
    index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
    raise NotFinite(
        trainer.iteration - 1, f"Adam's step made the parameter {name}{list(index)} {array[index]}"
    )


def load_model(folder):
    """The model of a run's checkpoint and the checkpoint's values; the scene is not needed.

    Raises     RunError where there is no usable checkpoint
    """
    arrays, values = load(folder)
    p = Parameters({name[2:]: a for name, a in arrays.items() if name.startswith("p/")})
    box = tuple(arrays["box"]) if "box" in arrays else None
    design = design_of(preset_of(values), values["effects"])
    return assemble(p, design, arrays["mask"], box, values["background"]), values
