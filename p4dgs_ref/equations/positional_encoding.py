r"""Text before Eq. (5): sines and cosines that let a network see fine detail in position and time.

.. math:: \mathcal{E}(p) = (p, \sin 2^0 p, \cos 2^0 p, \dots, \sin 2^{L-1} p, \cos 2^{L-1} p)
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    E: np.ndarray  # (N, D (1 + 2 L))


class Res(NamedTuple):
    E: np.ndarray  # (N, D (1 + 2 L))  the derivative of each sine is the cosine beside it
    L: int


def forward(p, L):
    """Encode vectors.

    Shapes     p (N, D), L scalar integer -> E (N, D (1 + 2 L)): p, then per frequency all sines, then all cosines
    Units      p: scene units or normalised time, used as radians; E: the same, then dimensionless
    Domain     2^(L-1) |p| finite; L = 0 gives p alone; an error that p brings along grows by 2^j
    Raises     nothing
    Gradient   p; smooth everywhere
    Choice     Q2: raw input first, no factor pi
    Reference  P-4DGS section 3.2, temporal prediction; frequencies as in D3DGS
    """
    N, D = p.shape
    powers = (1 << np.arange(L)).astype(p.dtype)  # integers: exactly 1, 2, 4, ...
    # Scaling by a power of two loses no bit, so in float32 too the argument of every sine is exactly 2^j p.
    angles = powers[:, None, None] * p.T
    E = np.empty(
        (D * (1 + 2 * L), N), dtype=p.dtype
    )  # one row per feature: sin and cos run along rows
    E[:D] = p.T
    waves = E[D:].reshape(L, 2, D, N)
    np.sin(angles, out=waves[:, 0])
    np.cos(angles, out=waves[:, 1])
    return Out(E.T), Res(E.T, L)


def backward(res, E_bar):
    N, width = res.E.shape
    D = width // (1 + 2 * res.L)
    waves, waves_bar = (a.T[D:].reshape(res.L, 2, D, N) for a in (res.E, E_bar))
    slopes = (
        waves[:, 1] * waves_bar[:, 0] - waves[:, 0] * waves_bar[:, 1]
    )  # sin' = cos, cos' = -sin
    powers = (1 << np.arange(res.L)).astype(slopes.dtype)
    return {"p": E_bar[:, :D] + np.tensordot(powers, slopes, axes=1).T}


def cases():
    rng = np.random.default_rng(6)
    p = rng.normal(size=(5, 2))
    yield Case("ordinary", dict(p=p, L=4))
    yield Case("paper_width", dict(p=rng.uniform(-1.3, 1.3, size=(7, 3)), L=10), ("extreme",))
    yield Case("one_time", dict(p=np.array([[0.375]]), L=6), ("single",))
    yield Case("no_rows", dict(p=p[:0], L=4), ("empty",))
    yield Case("no_waves", dict(p=p, L=0), ("off",), expected={"E": p})
    yield Case(
        "by_hand",
        dict(p=np.array([[0.0, np.pi / 2]]), L=2),
        ("zero",),
        cotangents={"E_bar": np.array([[1.0, 2, 3, 5, 7, 11, 13, 17, 19, 23]])},
        expected={
            "E": np.array([[0, np.pi / 2, 0, 1, 1, 0, 0, 0, 1, -1]]),
            "p_bar": np.array([[1.0 + 3 + 2 * 13, 2 - 11 - 2 * 17]]),
        },
    )


positional_encoding = declare(
    "positional_encoding",
    "",
    "E(p) = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1",
    {"p": "N D", "L": "", "E": "N I"},
    ("p",),
    forward,
    backward,
    cases,
)
