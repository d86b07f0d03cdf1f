r"""Eq. (9): the context of an anchor, read from one 3D and three 2D grids of binary features.

.. math:: h = \mathcal{H}(x_a) = \Bigl[\sum_{c} w_c(x_a)\,\mathrm{sign}\,\theta^l_{i_c(x_a)}\Bigr]_{l = 0 \dots L-1}
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from .equation import Case, declare
from .grid_nodes import locate


class Out(NamedTuple):
    h: np.ndarray  # (A, L F) level-major, then feature


class Res(NamedTuple):
    located: csr_matrix  # (A L, sum of T) the multilinear weights
    inside: list  # [(T, F)] where |parameter| <= 1


def forward(x_a, lo, hi, grids, resolutions):
    """Look anchors up.

    Shapes     x_a (A, 3), lo, hi (3,), grids [(T, F), ...], resolutions ((axes, res), ...) -> h (A, L F)
    Units      x_a, lo, hi: scene units; grids, h: dimensionless
    Domain     all reals; one level or more, T free, F the same in all; outside the box the nearest face counts
    Raises     ValueError where grids and resolutions differ in number, or a coordinate is not a number or the box not finite
    Gradient   grids: straight through the sign where |parameter| <= 1, 0 elsewhere; x_a, lo, hi are data
    Choice     Q11: nodes at u (res - 1); dense where res^D <= T, else hashed; parameter >= 0 is +1
    Reference  P-4DGS Eq. (9), section 3.3; hash of Instant-NGP
    """
    return query(locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids]), grids)


def query(located, grids):
    """`forward` for anchors that `locate` has placed before: in stage 4 they stand still while the grids learn."""
    signs = np.where(np.concatenate(grids) >= 0, 1, -1).astype(located.dtype)
    h = (located @ signs).reshape(-1, len(grids) * signs.shape[1])  # rows: anchor-major, then level
    return Out(h), Res(located, [np.abs(grid) <= 1 for grid in grids])


def backward(res, h_bar):
    entries_bar = res.located.T @ h_bar.reshape(-1, res.inside[0].shape[1])
    levels = np.split(entries_bar, np.cumsum([len(inside) for inside in res.inside])[:-1])
    return {"grids": [level * inside for level, inside in zip(levels, res.inside)]}


def surrogate(x_a, lo, hi, grids, resolutions):
    """Eq. (9) with signs held at `grids` that move by the clipped parameter's change: what backward differentiates."""
    located = locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids])

    def smooth(**moved):
        signs = [
            np.where(held >= 0, 1, -1) + np.clip(p, -1, 1) - np.clip(held, -1, 1)
            for p, held in zip(moved["grids"], grids)
        ]
        return Out(
            (located @ np.concatenate(signs)).reshape(len(x_a), len(grids) * grids[0].shape[1])
        )

    return smooth


def cases():
    rng = np.random.default_rng(14)
    box = dict(lo=np.array([-1.0, 0, 2]), hi=np.array([1.0, 3, 2.5]))
    x_a = rng.uniform(box["lo"], box["hi"], size=(7, 3))
    levels = dict(resolutions=(("xyz", 3), ("xy", 5), ("xz", 5), ("yz", 5)))
    dense, hashed = (
        [rng.uniform(-0.9, 0.9, size=(T, 2)) for T in tables]
        for tables in ((27,) + 3 * (25,), (11,) * 4)
    )
    yield Case("ordinary", dict(x_a=x_a, **box, grids=dense, **levels))
    yield Case("hashed", dict(x_a=x_a, **box, grids=hashed, **levels))
    lattice = box["lo"] + (box["hi"] - box["lo"]) * np.array(
        [[0, 0, 0], [0.5, 1, 0.5], [1, 1, 1], [1.5, -2, 0.5]]
    )
    yield Case(
        "nodes_faces_outside",
        dict(x_a=lattice, **box, grids=dense, **levels),
        ("clamped", "outside"),
    )
    yield Case(
        "no_extent",
        dict(x_a=x_a, lo=box["lo"], hi=box["hi"] * [1, 0, 1], grids=dense, **levels),
        ("zero",),
    )
    yield Case("no_anchor", dict(x_a=x_a[:0], **box, grids=dense, **levels), ("empty",))
    # by hand: weights 3/8 1/8 3/8 1/8; zero of either sign is +1; gradients end beyond +-1, not on it
    yield Case(
        "by_hand",
        dict(
            x_a=np.array([[0.25, 0.5, 9]]),
            lo=np.zeros(3),
            hi=np.array([1.0, 1, 0]),
            resolutions=(("xy", 2),),
            grids=[np.array([[0.0, -0.0], [-1, 1], [2, -2], [-1.5, 0.5]])],
        ),
        ("kink", "zero", "clamped"),
        smooth=False,
        cotangents={"h_bar": np.array([[8.0, -8]])},
        expected={
            "h": np.array([[0.5, 0.25]]),
            "grids_bar": [np.array([[3.0, -3], [1, -1], [0, 0], [0, -1]])],
        },
    )


hash_grid = declare(
    "hash_grid",
    "9",
    "h = H(x_a): multilinear reads of binary grids",
    {"x_a": "A 3", "lo": "3", "hi": "3", "grids": "*T F", "resolutions": "", "h": "A I"},
    ("grids",),
    forward,
    backward,
    cases,
    surrogate,
)
