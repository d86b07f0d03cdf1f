"""Views for choices after a training, which neither training nor test has seen."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from p4dgs_ref.scenes import Scene, View
from p4dgs_ref.scenes.files import over_background
from p4dgs_ref.scenes.load import DESCRIPTION, read_scene_json
from p4dgs_ref.scenes.simulator import GOLDEN, PLASTIC, camera_at, read_description
from p4dgs_ref.scenes.simulator.trace import trace

QUARTER = 0.25  # of a step between test views, by which these differ from test and training
EVERY = 4  # of the training views of a scene that has no others


@lru_cache(maxsize=8)  # a study asks for every file
def held_back(scene: Scene) -> tuple[View, ...]:
    """Views between those of train and test.

    They are drawn from the scene's description. A scene without one has no other pictures, and
    gives some of its training views.
    """
    described = scene.source and "bodies" in read_scene_json(scene.source)
    if not described:
        return scene.train[::EVERY]
    description = read_description(scene.source / DESCRIPTION)
    small = scene.train[0].camera
    views = []
    low, high = description.cameras.elevation
    for i in range(description.cameras.test):
        step = i + QUARTER
        elevation = np.radians(low + (high - low) * ((0.5 + PLASTIC * step) % 1))
        camera = camera_at(description, 2 * np.pi * (GOLDEN * step % 1), elevation)
        t = step / description.cameras.test
        looking = replace(small, R=camera.R, T=camera.T)
        pixels = trace(description, looking, t).astype(np.float32)
        views.append(View(f"val/{i}", *over_background(pixels, scene.background), looking, t))
    return tuple(views)
