r"""Eq. (10): hard quantisation, what a file holds instead of the noise of training.

.. math:: \hat f_a = \lfloor f_a / q \rceil \cdot q
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare

LIMIT = 2.0**31  # symbols stay below this in magnitude


class Out(NamedTuple):
    symbols: np.ndarray  # (A, n) int64, the primary output: a decoder multiplies, it never rounds
    f_hat: np.ndarray  # (A, n) symbols * q


class Res(NamedTuple):
    pass  # rounding has no gradient: nothing to remember


def forward(f, q):
    """Round to the nearest multiple of the step.

    Shapes     f (A, n), q (A, 1) -> symbols (A, n), f_hat (A, n)
    Units      f, q, f_hat: of the attribute; symbols: dimensionless
    Domain     q > 0, |f/q| < 2^31 and finite; divided in float64 whatever comes in
    Raises     OverflowError naming the first element outside the domain
    Gradient   none; training uses Eq. (7) instead
    Choice     Q19: ties to even, the grid centred at 0 (mu shifts the density only); -0 counts as 0
    Reference  P-4DGS Eq. (10)
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ratio = np.rint(
            np.divide(f, q, dtype=np.float64)
        )  # a quotient in float32 can fall on a tie that is none
    wrong = np.argwhere(~(np.abs(ratio) < LIMIT))
    if len(wrong):
        a, i = (int(j) for j in wrong[0])
        raise OverflowError(f"f[{a}, {i}] = {f[a, i]} at step {q[a, 0]}: expected |f/q| below 2^31")
    symbols = ratio.astype(np.int64)
    return Out(symbols, (symbols * q.astype(np.float64)).astype(f.dtype)), Res()


def backward(res, f_hat_bar=None):
    return {}


def cases():
    rng = np.random.default_rng(15)
    yield Case("ordinary", dict(f=rng.normal(size=(6, 5)) * 3, q=rng.lognormal(size=(6, 1))))
    ties = np.array([[-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, -0.0]])
    even = np.array([[-2, -2, 0, 0, 2, 2, 0]])
    yield Case(
        "ties",
        dict(f=ties * 0.25, q=np.array([[0.25]])),
        ("tie", "single"),
        expected={"symbols": even, "f_hat": even * 0.25},
        tolerance=0,
    )
    near = np.array([[np.nextafter(0.5, 0), 0.5, np.nextafter(0.5, 1), np.nextafter(1.5, 0)]])
    yield Case(
        "beside_ties",
        dict(f=near, q=np.ones((1, 1))),
        ("tie", "single"),
        expected={"symbols": np.array([[0, 0, 1, 1]])},
        tolerance=0,
    )
    yield Case(
        "large",
        dict(f=np.array([[2.0**29, -(2.0**29)]]), q=np.array([[0.5]])),
        ("extreme", "single"),
        expected={"symbols": np.array([[2**30, -(2**30)]])},
        tolerance=0,
    )
    yield Case("no_anchor", dict(f=np.zeros((0, 5)), q=np.zeros((0, 1))), ("empty",))


rounding = declare(
    "rounding",
    "10",
    "f_hat = round_half_even(f / q) q",
    {"f": "A n", "q": "A 1", "symbols": "A n", "f_hat": "A n"},
    (),
    forward,
    backward,
    cases,
)
