"""Scenes to train on: views, cameras and times, read from files or taken from arrays.

The simulator that draws the packaged scenes is a room of its own, `p4dgs_ref.scenes.simulator`.
Loading a scene does not import it.
"""

from .fields import SceneError
from .load import load_scene, packaged_scenes
from .scene import MODEL_EFFECTS, SIMULATOR_EFFECTS, Scene, View

__all__ = [
    "MODEL_EFFECTS",
    "SIMULATOR_EFFECTS",
    "Scene",
    "SceneError",
    "View",
    "load_scene",
    "packaged_scenes",
]
