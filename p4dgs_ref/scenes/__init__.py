"""Scenes: what is learned from (views, cameras, times), where it is read from, and the simulator that draws it."""

from .dnerf import load_scene, packaged_scenes
from .scene import MODEL_EFFECTS, SIMULATOR_EFFECTS, Scene, SceneError, View
from .simulator import simulate

__all__ = [
    "MODEL_EFFECTS",
    "SIMULATOR_EFFECTS",
    "Scene",
    "SceneError",
    "View",
    "load_scene",
    "packaged_scenes",
    "simulate",
]
