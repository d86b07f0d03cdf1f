"""Where the bodies of the simulator are at a time t in [0, 1], in closed form.

A body with a parent moves with its parent.
"""

from typing import NamedTuple

import numpy as np


class Pose(NamedTuple):
    """Places a body: world = R @ (scale * local) + T."""

    R: np.ndarray
    T: np.ndarray
    scale: float


def wave(motion, t):
    """The phase angle, which makes one turn in every period."""
    return 2 * np.pi * (t / motion.period + motion.phase)


def line(motion, t):
    """Move straight on at constant speed, by `by` from t = 0 to t = 1."""
    return t * motion.by


def bounce(motion, t):
    """Rise to `height` and come down again, at rest at both ends and without a kink."""
    return np.array([0.0, 0.0, motion.height * 0.5 * (1 - np.cos(wave(motion, t)))])


def arc(motion, t):
    """Swing on a circle about a vertical axis through `center`; the body itself does not turn."""
    R = turn((0, 0, 1), motion.degrees * np.sin(wave(motion, t)))
    return R @ -motion.center + motion.center


def swing(motion, t):
    """Turn to and fro about an axis through the origin of the body, its joint."""
    return turn(motion.axis, motion.degrees * np.sin(wave(motion, t)))


def spin(motion, t):
    """Turn about an axis through the origin of the body, by `degrees` from t = 0 to t = 1."""
    return turn(motion.axis, motion.degrees * t)


def pulse(motion, t):
    """Grow and shrink about the origin of the body by the fraction `amount`."""
    return 1 + motion.amount * np.sin(wave(motion, t))


# kind: the effect that a scene must list for the motion to happen, and its formula
MOTIONS = {
    "line": ("translation", line),
    "bounce": ("translation", bounce),
    "arc": ("translation", arc),
    "swing": ("rotation", swing),
    "spin": ("rotation", spin),
    "pulse": ("scaling", pulse),
}


def turn(axis, degrees):
    """The rotation by an angle about an axis (Rodrigues' formula)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    K, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def facing(T, viewer):
    """The rotation whose third column points from T to the viewer; its first one is horizontal."""
    back = (viewer - T) / np.linalg.norm(viewer - T)
    level = np.array([-back[1], back[0], 0.0])
    right = level / np.linalg.norm(level) if level.any() else np.array([1.0, 0, 0])
    return np.stack([right, np.cross(back, right), back], axis=1)


def poses(bodies, effects, t, viewer):
    """The pose of every body at time t, {name: Pose}; parents stand before their children.

    Offsets are in the frame of the parent. A child inherits R and T of its parent, not the scale. A
    motion whose effect is not listed is not computed. `faces_camera`, the simulator's form of
    view_geometry, turns a body to the viewer.
    """
    found = {}
    for body in bodies:
        base = found.get(body.parent, Pose(np.eye(3), np.zeros(3), 1.0))
        R = base.R @ turn(body.turn.axis, body.turn.degrees)
        offset, scale = body.position, 1.0
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
