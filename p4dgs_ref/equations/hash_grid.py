"""Eq. (9): the context of an anchor, read from one 3D and three 2D grids of binary features.

    h = H(x_a)        for every level, the sum over the cell's corners of weight * sign(parameter)

P-4DGS, section 3.3 (adaptive quantisation). The levels' nodes, their weights and the hash are
those of `grid_nodes` (Q11). A parameter >= 0, also -0, counts as +1.
"""

import numpy as np

from .grid_nodes import locate


def forward(
    x_a,  # [A, 3]  anchor positions (scene units)
    lo,  # [3]  corner of the box that the grids cover
    hi,  # [3]  opposite corner; positions outside the box are moved to its nearest face
    grids,  # list of [T, F], one per level: parameters, of which only the sign is used
    resolutions,  # for every level its axes and nodes per axis: (("xyz", 8), ("xy", 16), ...)
):
    """Return h [A, I], F numbers for each level in turn (I = L F), and what `backward` needs.

    Raises ValueError if grids and resolutions differ in number, if a position is NaN or if the
    box is not finite.
    """
    return query(locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids]), grids)


def backward(saved, h_bar):
    """Return the gradients of the grids; positions and box are data.

    Straight-through: the sign counts as the identity if |parameter| <= 1 and has no gradient
    elsewhere.
    """
    located, inside = saved
    rows_bar = located.T @ h_bar.reshape(-1, inside[0].shape[1])
    levels = np.split(rows_bar, np.cumsum([len(level) for level in inside])[:-1])
    return {"grids": [level * free for level, free in zip(levels, inside)]}


def query(located, grids):
    """Do what `forward` does for positions that have already gone through `locate`.

    In stage 4 the positions are fixed while the grids learn, so they are located only once.
    """
    signs = np.where(np.concatenate(grids) >= 0, 1, -1).astype(located.dtype)
    h = (located @ signs).reshape(-1, len(grids) * signs.shape[1])
    return h, (located, [np.abs(grid) <= 1 for grid in grids])
