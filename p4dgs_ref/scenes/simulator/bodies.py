"""The bodies of the simulator in closed form: their shapes, textures and motions.

Rays and points are in the frame of the body. A ray is o + t d with d of any length, so t keeps its
meaning when the frame changes. Every `*_hit` returns the first t > 0 where a ray enters the shape
from outside, or infinity if it misses. Every `*_normal` returns the outward unit normals at points
of the surface. Every motion is a function of the time t in [0, 1]; a body with a parent moves with
its parent.
"""

from typing import NamedTuple

import numpy as np


def dot(a, b):
    """Return the scalar products of the rows of a and b."""
    return np.einsum("ni,ni->n", a, b)


def first_root(a, half_b, c):
    """Return the smaller root of a t^2 + 2 half_b t + c, or infinity unless it is positive.

    a is 0 for a ray along the axis of a cylinder, which misses its side.
    """
    discriminant = half_b * half_b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-half_b - np.sqrt(discriminant)) / a
        return np.where((discriminant >= 0) & (t > 0), t, np.inf)


def ball_hit(o, d, center, radius):
    """Return where rays enter a ball."""
    m = o - center
    return first_root(dot(d, d), d @ m, m @ m - radius**2)


def sphere_hit(shape, o, d):
    """Return where rays enter a sphere."""
    return ball_hit(o, d, 0, shape.radius)


def sphere_normal(shape, p):
    """Return the direction away from the centre."""
    return p / shape.radius


def box_hit(shape, o, d):
    """Return where rays enter a box: inside, they are between the faces of all three pairs.

    A ray that is parallel to a face meets it at an infinity of the right sign.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-shape.half - o) / d, (shape.half - o) / d
    enter = np.fmax.reduce(np.fmin(one, other), axis=1)
    leave = np.fmin.reduce(np.fmax(one, other), axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def box_normal(shape, p):
    """Return the normal of the face whose coordinate is largest in units of the box."""
    q = p / shape.half
    face = np.abs(q).argmax(axis=1)[:, None]
    return np.where(np.arange(3) == face, np.sign(q), 0.0)


def capsule_hit(shape, o, d):
    """Return where rays enter a capsule: the first of a cylinder's side and two balls."""
    segment = shape.end - shape.start
    length = np.linalg.norm(segment) + 1e-150  # without a length it is a ball
    axis = segment / length
    m = o - shape.start
    m_along, d_along = m @ axis, d @ axis
    m_across, d_across = m - m_along * axis, d - d_along[:, None] * axis
    outside = m_across @ m_across - shape.radius**2
    side = first_root(dot(d_across, d_across), d_across @ m_across, outside)
    with np.errstate(invalid="ignore"):  # infinity times 0 if a ray along the axis misses
        along = m_along + side * d_along
    side = np.where((along >= 0) & (along <= length), side, np.inf)
    caps = [ball_hit(o, d, end, shape.radius) for end in (shape.start, shape.end)]
    return np.min([side, *caps], axis=0)


def capsule_normal(shape, p):
    """Return the direction away from the nearest point of the segment."""
    segment = shape.end - shape.start
    along = np.clip((p - shape.start) @ segment / (segment @ segment + 1e-300), 0, 1)
    return (p - shape.start - along[:, None] * segment) / shape.radius


def checker(texture, p):
    """Return 0 or 1, alternating from cell to cell; the origin of the body is a corner of cells."""
    return np.floor(p[:, : len(texture.axes)] / texture.cell).sum(axis=1) % 2


def stripes(texture, p):
    """Return a sine from 0 to 1 along the given direction."""
    direction = texture.direction / np.linalg.norm(texture.direction)
    return 0.5 + 0.5 * np.sin(2 * np.pi * (p @ direction) / texture.period)


HITS = {"sphere": sphere_hit, "box": box_hit, "capsule": capsule_hit}
NORMALS = {"sphere": sphere_normal, "box": box_normal, "capsule": capsule_normal}
TEXTURES = {"checker": checker, "stripes": stripes}


class Pose(NamedTuple):
    """Places a body: world = R @ (scale * local) + T."""

    R: np.ndarray
    T: np.ndarray
    scale: float


def wave(motion, t):
    """Return the phase angle, which makes one turn in every period."""
    return 2 * np.pi * (t / motion.period + motion.phase)


def line(motion, t):
    """Move in a straight line at constant speed, by `by` from t = 0 to t = 1."""
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


# How a motion changes the position, rotation or scale that the motions before it gave a body.
COMBINED = {"translation": np.add, "rotation": np.matmul, "scaling": np.multiply}
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
    """Return the rotation by an angle about an axis (Rodrigues' formula)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    K, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def poses(bodies, effects, t):
    """Return the pose of every body at time t, {name: Pose}; parents come before their children.

    Offsets are in the frame of the parent. A child inherits R and T of its parent, not the scale. A
    motion whose effect is not listed is not computed.
    """
    placed = {}
    for body in bodies:
        base = placed.get(body.parent, Pose(np.eye(3), np.zeros(3), 1.0))
        turned = base.R @ turn(body.turn.axis, body.turn.degrees)
        moved = {"translation": body.position, "rotation": turned, "scaling": 1.0}
        for motion in body.motion:
            effect, formula = MOTIONS[motion.kind]
            if effect in effects:
                moved[effect] = COMBINED[effect](moved[effect], formula(motion, t))
        offset, R, scale = moved.values()
        placed[body.name] = Pose(R, base.T + base.R @ offset, scale)
    return placed
