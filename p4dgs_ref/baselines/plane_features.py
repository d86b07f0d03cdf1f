"""H1: the features of a moving point, read from six planes at every level.

    features = concat over levels (prod over planes (plane[u_i, u_j]))

Wu et al. 2024 (4DGaussians, the paper's 4DHexPlane). A plane [I, J, F] holds F features at each of
I x J nodes. It spans two of the four axes x, y, z, t, and is read bilinearly; the first and the
last node of an axis are at the two ends of the box or of the time from 0 to 1. The planes of a
level are multiplied, so that a plane in space can mask what a plane in time says.

The authors give the time from 0 to 1 to a function that expects -1 to 1, so that half of the nodes
in time are never read. That is a mistake; here all of them are.
"""

import numpy as np
from scipy.sparse import csr_matrix

AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))  # of the planes xy, xz, yz, xt, yt, zt


def forward(
    x,  # [N, 3]  canonical centres (scene units)
    t,  # []  normalised time, converted to the precision of x
    lo,  # [3]  corner of the box that the planes cover
    hi,  # [3]  opposite corner; points outside the box are moved to its nearest face
    planes,  # list of [I, J, F]  level by level, each xy, xz, yz, xt, yt, zt
):
    """Return the features [N, K], those of the first level first, and what `backward` needs."""
    N, F, P = len(x), planes[0].shape[2], len(planes)
    extent = np.where(hi > lo, hi - lo, 1)  # a flat box: all its points are at the first node
    u = np.concatenate([(x - lo) / extent, np.full((N, 1), t, x.dtype)], axis=1).T
    inside = (u > 0) & (u < 1)
    nodes, axes = np.array([plane.shape[:2] for plane in planes]), np.resize(AXES, (P, 2))
    index, fraction = cells(np.clip(u, 0, 1)[axes], nodes)
    entries = np.concatenate([plane.reshape(-1, F) for plane in planes])
    weights = reader(index, bilinear(*fraction), len(entries))
    values = (weights @ entries).reshape(P // 6, 6, N, F)
    features = np.concatenate([*values.prod(axis=1)], axis=1)
    steps = (nodes - 1).T[:, :, None].astype(x.dtype)  # [2, P, 1]: cells along each axis
    return features, (index, fraction, entries, weights, values, steps, axes, inside, extent, nodes)


def backward(saved, features_bar):
    """Gradients of x and planes; time and box are data.

    A coordinate on or beyond a face has gradient zero, as in PyTorch; on an inner node its slope
    is that of the cell above.
    """
    index, fraction, entries, weights, values, steps, axes, inside, extent, nodes = saved
    _, _, N, F = values.shape
    levels_bar = np.stack(np.split(features_bar, len(values), axis=1))[:, None]
    values_bar = (levels_bar * product_of_others(values)).reshape(-1, F)
    entries_bar = np.split(weights.T @ values_bar, np.cumsum(nodes.prod(axis=1))[:-1])
    u_bar = np.zeros((4, N), features_bar.dtype)
    for axis, slope in enumerate(slopes(*fraction)):
        read = reader(index, slope, len(entries)) @ entries
        along = np.einsum("if,if->i", read, values_bar).reshape(len(nodes), N) * steps[axis]
        for i in range(3):
            u_bar[i] += along[axes[:, axis] == i].sum(axis=0)
    return {
        "x": (u_bar * inside)[:3].T / extent,
        "planes": [bar.reshape(*size, F) for bar, size in zip(entries_bar, nodes)],
    }


def cells(u, nodes):
    """The nodes [P, N, 4] around points u [P, 2, N] in [0, 1], and where in the cell they are.

    Nodes are counted through all P planes of nodes [P, 2]; the fractions are [2, P, N].
    """
    position = u * (nodes - 1)[:, :, None].astype(u.dtype)
    low = np.floor(position)
    fraction = (position - low).transpose(1, 0, 2)
    low = low.astype(np.int64)
    high = np.minimum(low + 1, nodes[:, :, None] - 1)  # at the upper face its weight is 0
    rows = np.stack([low[:, 0], low[:, 0], high[:, 0], high[:, 0]], axis=2)
    columns = np.stack([low[:, 1], high[:, 1], low[:, 1], high[:, 1]], axis=2)
    starts = np.cumsum([0, *nodes.prod(axis=1)])[:-1, None, None]
    return starts + rows * nodes[:, 1, None, None] + columns, fraction


def bilinear(a, b):
    """The weights [P, N, 4] of a cell's nodes at fractions a and b [P, N] of its two axes."""
    return np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], axis=2)


def slopes(a, b):
    """The derivatives of `bilinear` by a and by b."""
    return (
        np.stack([b - 1, -b, 1 - b, b], axis=2),
        np.stack([a - 1, 1 - a, -a, a], axis=2),
    )


def reader(index, weights, total):
    """A sparse matrix [P N, total] whose product with all nodes reads every point of each plane."""
    starts = np.arange(0, index.size + 1, 4)
    return csr_matrix((weights.ravel(), index.ravel(), starts), shape=(index.size // 4, total))


def product_of_others(values):
    """For each of six planes, axis 1, the product of the other five; there may be zeros."""
    others = np.ones_like(values)
    for i in range(5):
        others[:, i + 1] = others[:, i] * values[:, i]
    after = np.ones_like(values[:, 0])
    for i in reversed(range(5)):
        after *= values[:, i + 1]
        others[:, i] *= after
    return others
