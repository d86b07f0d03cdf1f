"""Training from Python in one call."""
from ..splatting.settings import FAST
from ..networks.parameters import Parameters
from .checkpoint import load, preset_of, save
from .checkpoint import resume as restore
from .initial import design_of
from .presets import choose
from .progress import Progress
from .trainer import Trainer, assemble

SAVE_EVERY = 20.0      # seconds between checkpoints


def train(scene, preset="tiny", seed=0, *, settings=FAST, points=None, folder=None, resume=False, stream=None,
          **changes):
    """Fit a scene; returns the Model, ready to render or encode.

    Takes      a Scene; a preset's name (or a Preset) and fields of it to change, a seed; `points` (A, 3) to start
               from instead of random ones; `folder` for checkpoints, `resume` to go on from the one in it;
               `stream` for the progress line, None for silence
    Raises     ValueError for an unknown preset, field or value; RunError for a checkpoint that does not fit;
               NotFinite where a number stops being one, with the first equation and array in which it did
    """
    return fit(scene, preset, seed, settings, points, folder, resume, stream, **changes).model()


def fit(scene, preset, seed, settings=FAST, points=None, folder=None, resume=False, stream=None, **changes):
    """As `train`, but returns the Trainer, with its history."""
    chosen = choose(preset, changes) if isinstance(preset, str) else preset._replace(**changes)
    trainer = Trainer(scene, chosen, seed, settings, points)
    if resume:
        restore(trainer, folder)
    keep = None if folder is None else lambda trainer: save(trainer, folder)
    try:
        trainer.run(Progress(stream), SAVE_EVERY, keep)
    except KeyboardInterrupt:
        if keep:
            keep(trainer)
        raise
    if keep:
        keep(trainer)
    return trainer


def load_model(folder):
    """The model of a run's checkpoint and the checkpoint's values; the scene is not needed.

    Raises     RunError where there is no usable checkpoint
    """
    arrays, values = load(folder)
    p = Parameters({name[2:]: a for name, a in arrays.items() if name.startswith("p/")})
    box = tuple(arrays["box"]) if "box" in arrays else None
    return assemble(p, design_of(preset_of(values), values["effects"]), arrays["mask"], box, values["background"]), values
