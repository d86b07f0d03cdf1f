"""Where the simulator's bodies are at a time: closed formulas of t in [0, 1], limbs carried by their parents."""

from typing import NamedTuple

import numpy as np


class Pose(NamedTuple):
    """world = R @ (scale * local) + T"""

    R: np.ndarray
    T: np.ndarray
    scale: float


def wave(motion, t):
    """One turn of the phase angle for every period."""
    return 2 * np.pi * (t / motion.period + motion.phase)


def line(motion, t):
    """Straight on, at even speed, by `by` in all."""
    return t * motion.by


def bounce(motion, t):
    """Up to `height` and down again, at rest at both ends: a soft bounce without a kink at the floor."""
    return np.array([0.0, 0.0, motion.height * 0.5 * (1 - np.cos(wave(motion, t)))])


def arc(motion, t):
    """To and fro on a circle about a vertical axis through `center`; the body does not turn with it."""
    return (
        turn((0, 0, 1), motion.degrees * np.sin(wave(motion, t))) @ -motion.center + motion.center
    )


def swing(motion, t):
    """To and fro about an axis through the body's origin, its joint."""
    return turn(motion.axis, motion.degrees * np.sin(wave(motion, t)))


def spin(motion, t):
    """Round an axis through the body's origin, at even speed, by `degrees` in all."""
    return turn(motion.axis, motion.degrees * t)


def pulse(motion, t):
    """Larger and smaller about the body's origin, by the fraction `amount`."""
    return 1 + motion.amount * np.sin(wave(motion, t))


# kind -> the effect that must be listed for it to happen, and its formula
MOTIONS = {
    "line": ("translation", line),
    "bounce": ("translation", bounce),
    "arc": ("translation", arc),
    "swing": ("rotation", swing),
    "spin": ("rotation", spin),
    "pulse": ("scaling", pulse),
}


def turn(axis, degrees):
    """The rotation by an angle about an axis (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    K, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def facing(T, viewer):
    """The rotation whose third column points from T to the viewer and whose first one stays level."""
    back = (viewer - T) / np.linalg.norm(viewer - T)
    level = np.array([-back[1], back[0], 0.0])
    right = level / np.linalg.norm(level) if level.any() else np.array([1.0, 0, 0])
    return np.stack([right, np.cross(back, right), back], axis=1)


def poses(bodies, effects, t, viewer):
    """The pose of every body at a time, seen by a viewer.

    Shapes     bodies: parents before their children; viewer (3,) -> {name: Pose}
    Units      offsets count in the parent's frame; a child inherits R and T, never the scale
    Choice     a motion whose effect is not listed is not computed; `faces_camera` is the simulator's view_geometry
    """
    found = {}
    for body in bodies:
        base = found.get(body.parent, Pose(np.eye(3), np.zeros(3), 1.0))
        R, offset, scale = base.R @ turn(body.turn.axis, body.turn.degrees), body.position, 1.0
        for motion in body.motion:
            effect, formula = MOTIONS[motion.kind]
            if effect not in effects:
                continue
            value = formula(motion, t)
            if effect == "translation":
                offset = offset + value
            elif effect == "rotation":
                R = R @ value
            else:
                scale *= value
        T = base.T + base.R @ offset
        if body.faces_camera and "view_geometry" in effects:
            R = facing(T, viewer)
        found[body.name] = Pose(R, T, scale)
    return found
