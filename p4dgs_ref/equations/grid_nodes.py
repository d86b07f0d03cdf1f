"""Which entries of a multi-resolution hash grid surround a point, and how much each counts (Q11)."""

import numpy as np
from scipy.sparse import csr_matrix

PRIMES = np.array(
    [1, 2654435761, 805459861], np.uint32
)  # of Instant-NGP, one per axis of the level


def locate(x_a, lo, hi, resolutions, tables):
    """Where anchors read the grids: one sparse matrix, so that reading all levels is one product and learning another.

    Shapes     x_a (A, 3), lo, hi (3,), resolutions ((axes, res), ...) as (("xyz", 8), ("xy", 16)), tables [T, ...]
               -> (A L, sum of T): row a L + l holds the weights of anchor a in level l, columns run level by level
    Raises     ValueError where resolutions and tables differ in number
    Reference  P-4DGS Eq. (9)
    """
    A, L, starts = len(x_a), len(resolutions), np.cumsum([0, *tables])
    found = [
        nodes(x_a, lo, hi, axes, res, T) for (axes, res), T in zip(resolutions, tables, strict=True)
    ]
    columns = np.concatenate(
        [index + start for (index, _), start in zip(found, starts)], axis=1
    ).ravel()
    weights = np.concatenate([weight for _, weight in found], axis=1).ravel()
    widths = [index.shape[1] for index, _ in found]
    return csr_matrix((weights, columns, np.cumsum([0, *(A * widths)])), shape=(A * L, starts[-1]))


def nodes(x_a, lo, hi, axes, res, table):
    """The corners of the cell around every anchor, in one level.

    Shapes     x_a (A, 3), lo, hi (3,) -> index int64 (A, 2^D), weight (A, 2^D)
    Units      x_a, lo, hi: scene units; index: row of the level's array; weights add up to 1
    Domain     all reals: outside the box the nearest face counts; u = 0 on an axis without extent (hi = lo); res >= 1
    Raises     ValueError where axes names anything but x, y, z, or a coordinate is not a number or the box not finite
    Choice     Q11: nodes at u (res - 1), borders included; dense where res^D <= table, else hashed
    Reference  P-4DGS Eq. (9); the hash of Instant-NGP
    """
    D, axis = len(axes), ["xyz".index(name) for name in axes]
    wrong = np.argwhere(np.isnan(x_a))
    if len(wrong):  # it would become an index out of range
        raise ValueError(f"x_a{wrong[0].tolist()} is nan: expected a coordinate")
    if not np.isfinite([lo, hi]).all():
        raise ValueError(f"box {lo.tolist()} to {hi.tolist()}: expected finite corners lo, hi")
    extent = (hi - lo)[axis]
    with np.errstate(
        over="ignore"
    ):  # far outside a flat box: infinity is clipped like any other number
        u = np.divide(
            (x_a - lo)[:, axis], extent, out=np.zeros((len(x_a), D), x_a.dtype), where=extent > 0
        )
    position = np.clip(u, 0, 1) * (res - 1)
    base = np.floor(position)
    step = np.array(np.meshgrid(*[[0, 1]] * D, indexing="ij")).reshape(D, -1).T  # (2^D, D) corners
    fraction = (position - base)[:, None, :]
    weight = np.where(step, fraction, 1 - fraction).prod(axis=2)
    # On the upper face the fraction is 0, so the corner beyond it, folded back here, weighs nothing.
    return entries(base.astype(np.int64), step, res, table), weight


def entries(base, step, res, table):
    """Which rows of a level's array the corners base + step read: int64 (A, D), (2^D, D) -> (A, 2^D).

    A corner (i, j, k) in the order of `axes`, each at most res - 1, reads entry i + j res + k res^2 where res^D <= table,
    else (i XOR 2654435761 j XOR 805459861 k), products modulo 2^32, modulo table.
    """
    corner, D = np.minimum(base[:, None, :] + step, res - 1), base.shape[1]
    if res**D <= table:
        return corner @ res ** np.arange(D)  # x + y res + z res^2
    hashed = np.bitwise_xor.reduce(
        corner.astype(np.uint32) * PRIMES[:D], axis=2
    )  # wraps modulo 2^32
    return (hashed % np.uint32(table)).astype(np.int64)
