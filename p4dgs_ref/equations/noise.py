r"""Eq. (7): additive uniform noise, the stand-in for rounding that has a gradient.

.. math:: \tilde f_a = f_a + \mathcal{U}(-\tfrac12, \tfrac12) \cdot q
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    f_noisy: np.ndarray  # (A, n)


class Res(NamedTuple):
    u: np.ndarray  # (A, n)  the untouched input, needed by q_bar


def forward(f, u, q):
    """Quantise with noise.

    Shapes     f, u (A, n), q (A, 1) -> f_noisy (A, n)
    Units      f, q, f_noisy: of the attribute; u: dimensionless in [-1/2, 1/2)
    Domain     q > 0; u is data, drawn by the caller
    Raises     nothing
    Gradient   f, q; smooth everywhere, none for u
    Choice     Q6: one step per anchor and group; Q23: one u for rendering and rate
    Reference  P-4DGS Eq. (7); the noise model is that of Balle et al. 2016
    """
    return Out(f + u * q), Res(u)


def backward(res, f_noisy_bar):
    return {"f": f_noisy_bar, "q": (f_noisy_bar * res.u).sum(axis=1, keepdims=True)}


def cases():
    rng = np.random.default_rng(12)
    f, u, q = rng.normal(size=(6, 5)), rng.random((6, 5)) - 0.5, rng.lognormal(size=(6, 1))
    yield Case("ordinary", dict(f=f, u=u, q=q))
    yield Case("no_noise", dict(f=f, u=0 * u, q=q), ("zero",), expected={"f_noisy": f})
    yield Case("tiny", dict(f=f * 1e-300, u=u, q=q * 1e-300), ("extreme",))
    yield Case(
        "by_hand",
        dict(f=np.array([[1.0, 2.0]]), u=np.array([[-0.5, 0.25]]), q=np.array([[0.2]])),
        ("single",),
        cotangents={"f_noisy_bar": np.array([[3.0, -8.0]])},
        expected={"f_noisy": np.array([[0.9, 2.05]]), "q_bar": np.array([[-3.5]])},
    )


noise = declare(
    "noise",
    "7",
    "f_noisy = f + u q",
    {"f": "A n", "u": "A n", "q": "A 1", "f_noisy": "A n"},
    ("f", "q"),
    forward,
    backward,
    cases,
)
