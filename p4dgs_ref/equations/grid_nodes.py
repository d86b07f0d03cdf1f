"""Which nodes of a multi-resolution hash grid surround a point, and how much each of them weighs.

A level covers the box with `res` nodes along each of its axes. A point reads the corners of the
cell around it with multilinear weights. The level's table has T rows of F entries each; a hashed
row may belong to several nodes. Node (i, j, k), in the order of the level's axes, has the row

    i + j res + k res**2                           if the table contains all nodes
    (i XOR 2654435761 j XOR 805459861 k) mod T     otherwise, with products modulo 2**32

This is the hash of Instant-NGP. Nodes on the border are included; HAC excludes them (Q11).
"""

import numpy as np
from scipy.sparse import csr_matrix

PRIMES = np.array([1, 2654435761, 805459861], np.uint32)  # one for each axis of the level


def locate(x_a, lo, hi, resolutions, tables):
    """Return the weights of all anchors [A, 3] in all levels as one sparse matrix [A L, sum of T].

    `tables` lists the number of rows T of every level's table. Row a L + i of the matrix contains
    the weights of anchor a in level i; its columns are the rows of all tables. Reading the grids is
    then one product with this matrix, and their gradient one with its transpose.
    """
    A, L, starts = len(x_a), len(resolutions), np.cumsum([0, *tables])
    columns, weights = [], []
    for (axes, res), table, start in zip(resolutions, tables, starts[:-1], strict=True):
        index, weight = nodes(x_a, lo, hi, axes, res, table)
        columns.append(index + start)
        weights.append(weight)
    per_row = [index.shape[1] for index in columns]
    row_starts = np.cumsum([0, *(A * per_row)])
    columns, weights = (np.concatenate(parts, axis=1).ravel() for parts in (columns, weights))
    return csr_matrix((weights, columns, row_starts), shape=(A * L, starts[-1]))


def nodes(x_a, lo, hi, axes, res, table):
    """Return the table rows [A, 2**D] int64 of the nodes around every anchor, and their weights.

    D is the number of the level's axes. The weights of an anchor add up to 1. Positions outside the
    box are moved to its nearest face; on an axis without extent (hi = lo) all anchors are at the
    first node. Raises ValueError for an axis other than x, y, z, for a NaN position and for a box
    that is not finite.
    """
    axis = ["xyz".index(name) for name in axes]
    wrong = np.argwhere(np.isnan(x_a))
    if len(wrong):  # it would become an index out of range
        raise ValueError(f"x_a{wrong[0].tolist()} is nan: expected a coordinate")
    if not np.isfinite([lo, hi]).all():
        raise ValueError(f"box {lo.tolist()} to {hi.tolist()}: expected finite corners lo, hi")
    extent = (hi - lo)[axis]
    u = np.zeros((len(x_a), len(axis)), x_a.dtype)
    with np.errstate(over="ignore"):  # an infinite u, far outside a flat box, is clipped as well
        np.divide((x_a - lo)[:, axis], extent, out=u, where=extent > 0)
    position = np.clip(u, 0, 1) * (res - 1)
    base = np.floor(position)
    step = np.indices((2,) * len(axis)).reshape(len(axis), -1).T  # [2**D, D]: the cell's corners
    fraction = (position - base)[:, None, :]
    weight = np.where(step, fraction, 1 - fraction).prod(axis=2)
    return table_rows(base.astype(np.int64), step, res, table), weight


def table_rows(base, step, res, table):
    """Return the rows [A, 2**D] of the nodes base [A, D] + step [2**D, D], as defined above."""
    # On the upper face the fraction is 0: the corner beyond it weighs nothing and is folded back.
    corner = np.minimum(base[:, None, :] + step, res - 1)
    D = base.shape[1]
    if res**D <= table:
        return corner @ res ** np.arange(D)
    hashed = np.bitwise_xor.reduce(corner.astype(np.uint32) * PRIMES[:D], axis=2)
    return (hashed % np.uint32(table)).astype(np.int64)
