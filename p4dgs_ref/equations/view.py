r"""Eq. (2): how far an anchor is from the camera, and in which direction it is seen.

.. math:: \delta_{vc} = \|x_a - x_c\|_2, \qquad d_{vc} = (x_a - x_c) / \|x_a - x_c\|_2
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    delta_vc: np.ndarray  # (A, 1)
    d_vc: np.ndarray  # (A, 3) of unit length, or zero for an anchor inside the camera


class Res(NamedTuple):
    delta_vc: np.ndarray  # (A, 1)
    d_vc: np.ndarray  # (A, 3)  the gradient of the distance, and the normal of the projector


def forward(x_a, x_c):
    """Look at every anchor from the camera.

    Shapes     x_a (A, 3), x_c (3,) -> delta_vc (A, 1), d_vc (A, 3)
    Units      x_a, x_c, delta_vc: scene units; d_vc: dimensionless
    Domain     distance 0 or 1e-200 to 1e200 (float32: 1e-25 to 1e25); x_c is taken in the precision of x_a
    Raises     nothing
    Gradient   x_a; the camera is data; kink at delta_vc = 0: direction 0 and gradient 0
    Choice     Q22: x_a is the canonical anchor, not a deformed Gaussian
    Reference  P-4DGS Eq. (2), section 3.2, spatial prediction
    """
    v = x_a - np.asarray(x_c, dtype=x_a.dtype)
    delta_vc = np.hypot(np.hypot(v[:, 0], v[:, 1]), v[:, 2])[
        :, None
    ]  # squares of 1e200 or 1e-200 leave the range
    d_vc = v / np.where(delta_vc > 0, delta_vc, 1)
    return Out(delta_vc, d_vc), Res(delta_vc, d_vc)


def backward(res, delta_vc_bar=None, d_vc_bar=None):
    x_a_bar = np.zeros_like(res.d_vc)
    if delta_vc_bar is not None:
        x_a_bar += res.d_vc * delta_vc_bar
    if d_vc_bar is not None:
        # (I - d d^T) / delta: turning the direction needs a sideways step, the less the closer
        aside = across(res.d_vc, d_vc_bar)
        x_a_bar += np.divide(aside, res.delta_vc, out=np.zeros_like(aside), where=res.delta_vc > 0)
    return {"x_a": x_a_bar}


def across(unit, v):
    """What of v (..., n) stands across the unit vector: v |unit|^2 - unit (unit . v), as sums of 2 x 2 minors.

    So written no 1 - unit_i^2 cancels: along an axis that unit nearly follows, the small rest keeps its digits.
    """
    minors = v[..., :, None] * unit[..., None, :] - unit[..., :, None] * v[..., None, :]
    return np.einsum("...ij,...j->...i", minors, unit)


def cases():
    rng = np.random.default_rng(4)
    x_a, x_c = rng.normal(size=(5, 3)), rng.normal(size=3)
    yield Case("ordinary", dict(x_a=x_a, x_c=x_c))
    yield Case("one_anchor", dict(x_a=x_a[:1], x_c=x_c), ("single",))
    yield Case("no_anchor", dict(x_a=x_a[:0], x_c=x_c), ("empty",))
    tilted = np.array([[2.0, -3.0, 6.0], [-6.0, 2.0, 3.0]])  # both of length 7
    for name, size in (("far", 1e200), ("near", 1e-200)):
        yield Case(
            name,
            dict(x_a=size * tilted, x_c=np.zeros(3)),
            ("extreme",),
            expected={"delta_vc": np.full((2, 1), 7 * size), "d_vc": tilted / 7},
        )
    yield Case(
        "camera_in_anchor",
        dict(x_a=np.array([[1.0, 2, 3], [1, 2, 5]]), x_c=np.array([1.0, 2, 3])),
        ("zero", "kink"),
        smooth=False,
        cotangents={
            "delta_vc_bar": np.array([[2.0], [3]]),
            "d_vc_bar": np.array([[1.0, -1, 4], [6, -8, 5]]),
        },
        expected={
            "delta_vc": np.array([[0.0], [2]]),
            "d_vc": np.array([[0.0, 0, 0], [0, 0, 1]]),
            "x_a_bar": np.array([[0.0, 0, 0], [3, -4, 3]]),
        },
    )


view = declare(
    "view",
    "2",
    "delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc",
    {"x_a": "A 3", "x_c": "3", "delta_vc": "A 1", "d_vc": "A 3"},
    ("x_a",),
    forward,
    backward,
    cases,
)
