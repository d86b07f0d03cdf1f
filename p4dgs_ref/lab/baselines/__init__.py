"""The methods that the paper compares itself with, trained by the same loop and renderer as ours.

    from p4dgs_ref import baselines
    model = baselines.train(scene, "d3dgs", seed=0)
    sizes = model.save("bouncing.ply")
    model = baselines.load("bouncing.ply")

The module of a method has Preset, PRESETS and Trainer, whose `kind` of model is a subclass of
`explicit.Explicit`; its equations are rows of `table.BASELINE_EQUATIONS`.
"""

from dataclasses import replace
from importlib import import_module

import numpy as np

from ...splatting.settings import FAST
from ...training.loop import Progress
from ...training.parameters import Parameters
from ...training.presets import read_changes
from . import explicit

# The names in comparisons, each with its module and its preset for the tiny scenes.
METHODS = {
    "d3dgs": ("d3dgs", "tiny"),
    "d3dgs_small": ("d3dgs", "tiny_small"),
    "hexplane": ("hexplane", "tiny"),
    "gaussian4d": ("gaussian4d", "tiny"),
}


def module_of(method):
    """The module of a method, and the name of its preset for the tiny scenes."""
    if method not in METHODS:
        raise ValueError(f"method {method!r}: expected one of {', '.join(METHODS)}")
    name, preset = METHODS[method]
    return import_module(f"{__name__}.{name}"), preset


def choose(method, preset=None, changes=None):
    """The preset of that name of a method, with some fields changed; a change may be a text.

    Raises ValueError with the name of the method, preset or field and what was expected.
    """
    module, tiny = module_of(method)
    name = preset or tiny
    if name not in module.PRESETS:
        raise ValueError(f"preset {name!r}: expected one of {', '.join(module.PRESETS)}")
    chosen = module.PRESETS[name]
    return replace(chosen, **read_changes(name, vars(chosen), changes))


def train(
    scene, method="d3dgs", preset=None, seed=0, settings=FAST, points=None, stream=None, **changes
):
    """Fit a scene by a method and return the model, ready to be rendered or saved.

    Without a preset it is that for the tiny scenes; the other arguments are those of our `train`.
    Raises ValueError for an unknown method, preset, field or value, and NotFinite.
    """
    chosen = choose(method, preset, changes)
    trainer = module_of(method)[0].Trainer(scene, chosen, seed, settings, points)
    with np.errstate(all="ignore"):  # non-finite values are found and named
        return trainer.run(Progress(stream))


def load(path):
    """The model in a file of any method. Raises ValueError for another file."""
    arrays, values = explicit.read_file(path)
    module, _ = module_of(values["method"])
    preset, background = module.Preset(**values["form"]), np.array(values["background"])
    return module.Trainer.kind(Parameters(arrays), preset, background, values["occlusion"])
