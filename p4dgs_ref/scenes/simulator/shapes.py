"""Shapes and textures of the simulator: closed forms over arrays of rays and points, in the frame of a body.

A ray is o + t d with d of any length, so t keeps its meaning through a change of frame.  Every `*_hit`
returns the first t > 0 where a ray enters the shape from outside, and infinity where it misses.
Every `*_normal` returns unit vectors that point outwards at points on the surface.
"""

import numpy as np


def first_root(a, half_b, c):
    """The smaller root of a t^2 + 2 half_b t + c, infinity where there is none or it lies behind the origin."""
    discriminant = half_b * half_b - a * c
    with np.errstate(
        invalid="ignore", divide="ignore"
    ):  # a = 0: a ray along a cylinder's axis misses its side
        t = (-half_b - np.sqrt(discriminant)) / a
        return np.where((discriminant >= 0) & (t > 0), t, np.inf)


def ball_hit(o, d, center, radius):
    m = o - center
    return first_root(np.einsum("ni,ni->n", d, d), d @ m, m @ m - radius**2)


def sphere_hit(shape, o, d):
    return ball_hit(o, d, shape.center, shape.radius)


def sphere_normal(shape, p):
    return (p - shape.center) / shape.radius


def box_hit(shape, o, d):
    """Slabs: the ray is inside where it is between all three pairs of faces."""
    m = o - shape.center
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # a ray parallel to a face: infinities that compare well
        one, other = (-shape.half - m) / d, (shape.half - m) / d
    enter = np.fmax.reduce(np.fmin(one, other), axis=1)
    leave = np.fmin.reduce(np.fmax(one, other), axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def box_normal(shape, p):
    """The face is the one whose coordinate is largest in units of the box."""
    q = (p - shape.center) / shape.half
    face = np.abs(q).argmax(axis=1)[:, None]
    normal = np.zeros_like(q)
    np.put_along_axis(normal, face, np.sign(np.take_along_axis(q, face, axis=1)), axis=1)
    return normal


def capsule_hit(shape, o, d):
    """The union of a cylinder's side and two balls is entered where the first of the three is entered."""
    length = np.linalg.norm(shape.end - shape.start)
    axis = (shape.end - shape.start) / length
    m = o - shape.start
    m_along, d_along = m @ axis, d @ axis
    m_across, d_across = m - m_along * axis, d - d_along[:, None] * axis
    side = first_root(
        np.einsum("ni,ni->n", d_across, d_across),
        d_across @ m_across,
        m_across @ m_across - shape.radius**2,
    )
    with np.errstate(invalid="ignore"):  # inf * 0 where a ray along the axis misses
        along = m_along + side * d_along
    side = np.where((along >= 0) & (along <= length), side, np.inf)
    caps = [ball_hit(o, d, center, shape.radius) for center in (shape.start, shape.end)]
    return np.minimum(side, np.minimum(*caps))


def capsule_normal(shape, p):
    """Away from the nearest point of the segment."""
    segment = shape.end - shape.start
    along = np.clip((p - shape.start) @ segment / (segment @ segment), 0, 1)
    return (p - shape.start - along[:, None] * segment) / shape.radius


def checker(texture, p):
    """0 or 1 by the parity of the cells along the chosen axes; the corner of four cells is the body's origin."""
    cells = np.floor(p[:, texture.axes] / texture.cell).sum(axis=1)
    return cells % 2


def stripes(texture, p):
    """Soft stripes, a sine across the given direction."""
    direction = texture.direction / np.linalg.norm(texture.direction)
    return 0.5 + 0.5 * np.sin(2 * np.pi * (p @ direction) / texture.period)


HITS = {"sphere": sphere_hit, "box": box_hit, "capsule": capsule_hit}
NORMALS = {"sphere": sphere_normal, "box": box_normal, "capsule": capsule_normal}
TEXTURES = {"checker": checker, "stripes": stripes}
