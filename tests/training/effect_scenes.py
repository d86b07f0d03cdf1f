"""What the tests of effects share: the packaged scenes, made small, and short trainings of them."""

import json
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np

from p4dgs_ref.codec.file import encode
from p4dgs_ref.scenes import MODEL_EFFECTS, load_scene
from p4dgs_ref.scenes.load import packaged_folder
from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.trainer import Trainer
from p4dgs_ref.training.watch import equation_codes, watch_calls

# One packaged scene for each list of effects; orbit lists those of bouncing, orientation static's.
SCENES = ("bouncing", "figure", "glossy", "static")
EPS = np.finfo(float).eps
SHORT = replace(SMOKE, stage_ends=(1, 2, 3, 5))  # every stage, in five steps
SEEN_BY = {"view_color": ("psi_c",), "view_geometry": ("psi_alpha", "psi_r", "psi_s")}


@cache
def small_scene(name):
    """A packaged scene of 16 x 16 pixels."""
    return load_scene(name, downscale=4)


def listed(effects, effect, on):
    """The list of effects with one of them forced on or off."""
    return tuple(e for e in MODEL_EFFECTS if e in effects and e != effect or e == effect and on)


@cache
def trained(name, effect, on):
    """A short training with one effect forced on or off: trainer, its file, and calls.

    Calls {(equation, "forward" or "backward"): number} are those of the last step.
    """
    scene = small_scene(name)
    trainer = Trainer(replace(scene, effects=listed(scene.effects, effect, on)), SHORT)
    while trainer.iteration < SHORT.iterations:
        calls = Counter()
        with watch_calls(
            equation_codes(), lambda event, mark, *_: calls.update([mark] * (event == "call"))
        ):
            trainer.step()
    return trainer, encode(trainer.model()), calls


def small_camera(camera, width=8):
    """The same camera with fewer pixels."""
    by, height = camera.width / width, round(camera.height * width / camera.width)
    return replace(
        camera,
        f_x=camera.f_x / by,
        f_y=camera.f_y / by,
        c_x=(camera.c_x + 0.5) / by - 0.5,
        c_y=(camera.c_y + 0.5) / by - 0.5,
        width=width,
        height=height,
    )


def described(name, effects):
    """The description of a packaged scene with another list of effects."""
    data = json.loads((packaged_folder() / name / "scene.json").read_text(encoding="utf-8"))
    return {**data, "effects": list(effects)}


def simulated_effects(name):
    """The effects that the description of a packaged scene lists."""
    return json.loads((packaged_folder() / name / "scene.json").read_text(encoding="utf-8"))[
        "effects"
    ]
