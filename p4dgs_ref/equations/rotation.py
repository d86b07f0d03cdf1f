r"""Eq. (3) applied to rotation: unit quaternions of an anchor's k Gaussians; and how a quaternion is normalised.

.. math:: \{r_0,\dots,r_{k-1}\} = \psi_r / \|\psi_r\|_2, \quad \psi_r = \psi_r(f_a, \delta_{vc}, d_{vc})
"""

from typing import NamedTuple

import numpy as np

from . import mlp
from .equation import Case, declare
from .opacity import split_view, view_inputs, without_view
from .view import across

EPSILON = 1e-12  # r / sqrt(|r|^2 + EPSILON^2): value and gradient stay finite where r = 0


class Out(NamedTuple):
    r: np.ndarray  # (A, k, 4) w, x, y, z


class Res(NamedTuple):
    r: np.ndarray  # (A, k, 4)
    norm: np.ndarray  # (A, k, 1)
    mlp: mlp.Res
    d: int  # width of the feature, where the input splits


def normalise(r):
    """The unit quaternions (..., 4) along r, and the safe norms (..., 1) by which r was divided."""
    w, x, y, z = np.moveaxis(r, -1, 0)
    # hypot squares nothing, so neither 1e25 in float32 nor 1e-30 leaves the range
    norm = np.hypot(np.hypot(np.hypot(w, x), np.hypot(y, z)), EPSILON)[..., None]
    return r / norm, norm


def normalise_backward(unit, norm, unit_bar):
    """(I - unit unit^T) / norm: what points along r only makes it longer, and its length is divided out."""
    return (
        across(unit, unit_bar) + (EPSILON / norm) ** 2 * unit_bar
    ) / norm  # |unit|^2 = 1 - (EPSILON / norm)^2


def forward(f_a, delta_vc, d_vc, weights, biases):
    """Predict rotations.

    Shapes     f_a (A, d), delta_vc (A, 1), d_vc (A, 3), weights and biases of psi_r (d+4 -> 4k) -> r (A, k, 4)
    Units      r: unit quaternion, real part first; delta_vc: scene units
    Domain     all reals, psi_r = 0 gives r = 0; delta_vc and d_vc of zero width where the scene lists no view effect
    Raises     ValueError from NumPy where widths do not chain or the last one is no multiple of 4
    Gradient   f_a, delta_vc, d_vc, weights, biases; kinks of the ReLUs only; within 1e-12 of 0 the slope is 1e12
    Choice     Q3: input order as printed, outputs child by child; Q4: (w, x, y, z), r / sqrt(|r|^2 + 1e-24)
    Reference  P-4DGS Eq. (3), "predicted analogously"
    """
    y, res = mlp.forward(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
    A, width = y.y.shape
    r, norm = normalise(y.y.reshape(A, width // 4, 4))
    return Out(r), Res(r, norm, res, f_a.shape[1])


def backward(res, r_bar):
    A, k, _ = res.r.shape
    y_bar = normalise_backward(res.r, res.norm, r_bar)
    return split_view(mlp.backward(res.mlp, y_bar.reshape(A, 4 * k)), res.d)


def cases():
    inputs = view_inputs(np.random.default_rng(8), A=6, d=2, k=5, outputs=4)
    yield Case("ordinary", inputs)
    yield Case("no_view", without_view(inputs), ("off",))
    yield Case(
        "no_anchor", {n: a if isinstance(a, list) else a[:0] for n, a in inputs.items()}, ("empty",)
    )
    yield Case(
        "long",
        {**inputs, "weights": [*inputs["weights"][:-1], 1e30 * inputs["weights"][-1]]},
        ("normalise", "extreme"),
    )
    # psi_r is the bias alone: (1, 2, 2, 4) is of length 5; at zero the slope is 1 / EPSILON
    one = dict(
        f_a=np.ones((1, 1)),
        delta_vc=np.ones((1, 1)),
        d_vc=np.zeros((1, 3)),
        weights=[np.zeros((5, 4))],
    )
    yield Case(
        "by_hand",
        {**one, "biases": [np.array([1.0, 2, 2, 4])]},
        ("normalise", "single"),
        cotangents={"r_bar": np.array([[[50.0, 0, 0, 0]]])},
        expected={
            "r": np.array([[[0.2, 0.4, 0.4, 0.8]]]),
            "biases_bar": [np.array([9.6, -0.8, -0.8, -1.6])],
        },
    )
    yield Case(
        "zero_quaternion",
        {**one, "biases": [np.zeros(4)]},
        ("normalise", "zero"),
        smooth=False,
        cotangents={"r_bar": np.array([[[3.0, -5, 7, 11]]])},
        expected={"r": np.zeros((1, 1, 4)), "biases_bar": [np.array([3e12, -5e12, 7e12, 11e12])]},
    )


rotation = declare(
    "rotation",
    "3'",
    "r = psi_r / |psi_r|, psi_r = psi_r(f_a, delta_vc, d_vc)",
    {
        "f_a": "A d",
        "delta_vc": "A 1",
        "d_vc": "A 3",
        "weights": "*I J",
        "biases": "*J",
        "r": "A k 4",
    },
    ("f_a", "delta_vc", "d_vc", "weights", "biases"),
    forward,
    backward,
    cases,
)
