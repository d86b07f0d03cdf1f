"""Scenes of a bar, and a trained model that draws a share of what is missing."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref.training.presets import TINY


def scene(count, thick=2, color=(0.2, 0.3, 0.4)):
    """Views of a vertical bar of some pixels on white."""
    image = np.ones((12, 16, 3))
    image[:, 7 : 7 + thick] = color
    angles = np.linspace(0, 3, count)
    cameras = [
        p4.look_at((3 * np.cos(a), 3 * np.sin(a), 1), (0, 0, 0), 20, 20, 16, 12) for a in angles
    ]
    return p4.Scene.from_arrays([image] * count, cameras, list(np.linspace(0, 1, count)))


class Share:
    """A trained model that draws the mean of the training pictures, and a share of what is missing.

    At the times between the views it draws an empty picture, so the bar is what moves.
    """

    def __init__(self, scene, share):
        self.scene, self.share, self.settings, self.preset = scene, share, None, TINY
        self.points = None
        self.mean = np.mean([view.image for view in scene.train], axis=0)

    def model(self):
        return self

    def gaussians(self, t, camera):
        return SimpleNamespace(alpha=[1.0])

    def render(self, camera, t, settings):
        seen = [v for v in (*self.scene.train, *self.scene.test) if v.camera is camera]
        if t != seen[0].time:
            return np.ones_like(self.mean)
        return self.mean + self.share * (seen[0].image - self.mean)


def moving():
    """A bar that moves: four training views, and one that is kept back."""
    bars = [
        replace(view, image=np.roll(view.image, 2 * i, 1)) for i, view in enumerate(scene(5).train)
    ]
    return replace(scene(5), train=bars[:4], test=bars[4:])
