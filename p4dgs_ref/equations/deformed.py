r"""Eq. (6): the Gaussians at time t.

.. math:: (x', s', r') = (x + \Delta x,\; s + \Delta s,\; r + \Delta r)

and r' is brought back to unit length (Q9).
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare
from .rotation import normalise, normalise_backward


class Out(NamedTuple):
    x_t: np.ndarray  # (N, 3)
    s_t: np.ndarray  # (N, 3) may be zero or negative: the covariance takes its square
    r_t: np.ndarray  # (N, 4)


class Res(NamedTuple):
    r_t: np.ndarray  # (N, 4)
    norm: np.ndarray | None  # (N, 1), None where rotation is off
    widths: list  # of the three deltas; zero where the effect is off


def forward(x, s, r, delta_x, delta_s, delta_r):
    """Apply the deformation.

    Shapes     x, s, delta_x, delta_s (N, 3), r, delta_r (N, 4) -> x_t, s_t (N, 3), r_t (N, 4)
    Units      x, s: scene units; r: quaternion, real part first
    Domain     all reals; a delta of zero width (N, 0) is an effect that is off: its attribute passes as it is
    Raises     nothing
    Gradient   all six; smooth; r + delta_r = 0 gives r_t = 0 with slope 1e12
    Choice     Q9: linear scale, no clamp; r_t = (r + delta_r) / sqrt(|r + delta_r|^2 + 1e-24)
    Reference  P-4DGS Eq. (6)
    """
    x_t, s_t, r_t = (
        a + delta if delta.shape[1] else a
        for a, delta in ((x, delta_x), (s, delta_s), (r, delta_r))
    )
    widths, norm = [delta.shape[1] for delta in (delta_x, delta_s, delta_r)], None
    if widths[2]:
        r_t, norm = normalise(r_t)
    return Out(x_t, s_t, r_t), Res(r_t, norm, widths)


def backward(res, x_t_bar=None, s_t_bar=None, r_t_bar=None):
    """Gradients of all six; attribute and delta share one array where the effect is on."""
    N, dtype = len(res.r_t), res.r_t.dtype
    x_bar, s_bar, r_bar = (
        np.zeros((N, width), dtype) if bar is None else bar
        for bar, width in ((x_t_bar, 3), (s_t_bar, 3), (r_t_bar, 4))
    )
    if res.norm is not None:
        r_bar = normalise_backward(res.r_t, res.norm, r_bar)
    n_x, n_s, n_r = res.widths
    return {
        "x": x_bar,
        "s": s_bar,
        "r": r_bar,
        "delta_x": x_bar[:, :n_x],
        "delta_s": s_bar[:, :n_s],
        "delta_r": r_bar[:, :n_r],
    }


def cases():
    rng = np.random.default_rng(11)
    x, s, r = rng.normal(size=(5, 3)), rng.lognormal(size=(5, 3)), rng.normal(size=(5, 4))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    deltas = dict(
        delta_x=rng.normal(size=(5, 3)),
        delta_s=rng.normal(size=(5, 3)),
        delta_r=rng.normal(size=(5, 4)),
    )
    yield Case("ordinary", dict(x=x, s=s, r=r, **deltas))
    yield Case("no_rows", {n: a[:0] for n, a in dict(x=x, s=s, r=r, **deltas).items()}, ("empty",))
    for name in deltas:
        yield Case(
            "no_" + name, {**dict(x=x, s=s, r=r, **deltas), name: deltas[name][:, :0]}, ("off",)
        )
    yield Case(
        "static",
        dict(x=x, s=s, r=r, **{n: a[:, :0] for n, a in deltas.items()}),
        ("off",),
        expected={"x_t": x, "s_t": s, "r_t": r},
    )
    yield Case(
        "inside_out",
        dict(x=x, s=s, r=r, **{**deltas, "delta_s": -2 * s}),
        ("negative",),
        expected={"s_t": -s},
    )
    # r + delta_r is (1, 2, 2, 4), of length 5; then it is zero, where the slope is 1 / EPSILON
    one = dict(
        x=np.zeros((1, 3)),
        s=np.ones((1, 3)),
        r=np.array([[1.0, 0, 0, 0]]),
        delta_x=np.ones((1, 3)),
        delta_s=-np.ones((1, 3)),
    )
    moved = {"x_t": np.ones((1, 3)), "s_t": np.zeros((1, 3))}
    yield Case(
        "by_hand",
        {**one, "delta_r": np.array([[0.0, 2, 2, 4]])},
        ("normalise", "single"),
        cotangents={"r_t_bar": np.array([[50.0, 0, 0, 0]]), "s_t_bar": np.array([[2.0, -3, 5]])},
        expected={
            **moved,
            "r_t": np.array([[0.2, 0.4, 0.4, 0.8]]),
            "s_bar": np.array([[2.0, -3, 5]]),
            "delta_r_bar": np.array([[9.6, -0.8, -0.8, -1.6]]),
            "x_bar": np.zeros((1, 3)),
        },
    )
    yield Case(
        "unmade_rotation",
        {**one, "delta_r": np.array([[-1.0, 0, 0, 0]])},
        ("normalise", "zero"),
        smooth=False,
        cotangents={"r_t_bar": np.array([[3.0, -5, 7, 11]])},
        expected={
            **moved,
            "r_t": np.zeros((1, 4)),
            "delta_r_bar": np.array([[3e12, -5e12, 7e12, 11e12]]),
        },
    )


deformed = declare(
    "deformed",
    "6",
    "x_t = x + delta_x, s_t = s + delta_s, r_t = (r + delta_r) / |r + delta_r|",
    {
        "x": "N 3",
        "s": "N 3",
        "r": "N 4",
        "delta_x": "N 3",
        "delta_s": "N 3",
        "delta_r": "N 4",
        "x_t": "N 3",
        "s_t": "N 3",
        "r_t": "N 4",
    },
    ("x", "s", "r", "delta_x", "delta_s", "delta_r"),
    forward,
    backward,
    cases,
)
