r"""Eq. (14): the bits of the binary hash grid under one shared probability.

.. math:: R_{hash} = N_+ (-\log_2 p_+) + N_- (-\log_2 p_-), \qquad p_\pm = N_\pm / N
"""

import math
from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    R_hash: np.ndarray  # () bits
    n_pos: np.ndarray  # () int64, entries that count as +1
    n_neg: np.ndarray  # () int64


class Res(NamedTuple):
    grids: list  # (T, F) each, the untouched input
    n_pos: int
    n: int


def entropy(n_pos, n_neg):
    """Bits of so many signs of either kind; the counts may be real, and a kind that does not occur costs nothing."""
    # -log p = log(1 + other / own): with p next to 1 the logarithm of p itself would have lost the digits
    return sum(
        own * math.log1p(other / own) for own, other in ((n_pos, n_neg), (n_neg, n_pos)) if own
    ) / math.log(2)


def forward(grids):
    """Count signs and price them.

    Shapes     grids [(T, F), ...] one array a level -> R_hash (), n_pos (), n_neg ()
    Units      R_hash: bits; grids: parameters whose sign counts
    Domain     all reals, 0 and -0 count as +1; no levels or no entries: 0 bits
    Raises     nothing
    Gradient   grids, straight-through: of the sign replaced by the identity where |parameter| <= 1, else 0; 0 where
               all signs agree, though the slope there is infinite
    Choice     Q11: parameter >= 0 -> +1; HAC clamps p to [1e-6, 1 - 1e-6], not followed
    Reference  P-4DGS Eq. (14)
    """
    n = sum(grid.size for grid in grids)
    n_pos = sum(int(np.count_nonzero(grid >= 0)) for grid in grids)
    dtype = grids[0].dtype if grids else np.float64
    return (
        Out(np.asarray(entropy(n_pos, n - n_pos), dtype), np.asarray(n_pos), np.asarray(n - n_pos)),
        Res(grids, n_pos, n),
    )


def backward(res, R_hash_bar):
    # dR/dN+ = log2(N- / N+), the terms of dp cancel; N+ = sum (1 + b)/2, so half of it per entry b
    mixed = 0 < res.n_pos < res.n
    slope = 0.5 * np.log2((res.n - res.n_pos) / res.n_pos) * float(R_hash_bar) if mixed else 0.0
    return {
        "grids": [np.where(np.abs(grid) <= 1, slope, 0).astype(grid.dtype) for grid in res.grids]
    }


def surrogate(grids):
    """Around given parameters: their signs plus the change of the clipped parameters, then the same price."""
    base = [np.where(grid >= 0, 1.0, -1.0) - np.clip(grid, -1, 1) for grid in grids]

    def smooth(grids):
        b = [start + np.clip(grid, -1, 1) for start, grid in zip(base, grids)]
        n = sum(x.size for x in b)
        n_pos = sum((1 + x).sum() / 2 for x in b)
        return Out(np.asarray(entropy(n_pos, n - n_pos)), np.asarray(0), np.asarray(0))

    return smooth


def cases():
    rng = np.random.default_rng(19)
    grids = [rng.uniform(-0.9, 0.9, size=(7, 2)), rng.uniform(-0.3, 0.9, size=(5, 2))]
    yield Case("ordinary", dict(grids=grids))
    for name, sign in (("all_positive", 1), ("all_negative", -1)):
        yield Case(
            name,
            dict(grids=[sign * np.abs(g) for g in grids]),
            ("zero",),
            smooth=False,
            cotangents={"R_hash_bar": np.float64(3.0)},
            expected={"R_hash": np.float64(0), "grids_bar": [np.zeros((7, 2)), np.zeros((5, 2))]},
        )
    yield Case(
        "one_positive", dict(grids=[np.array([[0.5, -0.25, -0.5, -0.75]])]), ("single", "negative")
    )
    yield Case(
        "no_entries", dict(grids=[np.zeros((0, 2))]), ("empty",), expected={"R_hash": np.float64(0)}
    )
    # by hand: 0, -0, 1, 1.5 and one of -2 ... : six of eight positive; beyond +-1 nothing comes back
    row = np.array([[0.0, -0.0, 1.0, 1.5, 0.3, 0.7, -1.0, -2.0]])
    bits = 8 * (2 - 0.75 * np.log2(3))
    yield Case(
        "by_hand",
        dict(grids=[row]),
        ("kink", "single"),
        smooth=False,
        cotangents={"R_hash_bar": np.float64(2.0)},
        expected={
            "R_hash": np.float64(bits),
            "n_pos": np.int64(6),
            "n_neg": np.int64(2),
            "grids_bar": [-np.log2(3) * np.array([[1, 1, 1, 0, 1, 1, 1, 0.0]])],
        },
    )


hash_rate = declare(
    "hash_rate",
    "14",
    "R_hash = N+ (-log2 p+) + N- (-log2 p-)",
    {"grids": "*T F", "R_hash": "", "n_pos": "", "n_neg": ""},
    ("grids",),
    forward,
    backward,
    cases,
    surrogate=surrogate,
)
