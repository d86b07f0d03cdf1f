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
    N, F, nodes = len(x), planes[0].shape[2], np.array([plane.shape[:2] for plane in planes])
    extent = np.where(hi > lo, hi - lo, 1)  # a flat box: all its points are at the first node
    u = np.concatenate([(x - lo) / extent, np.full((N, 1), t, x.dtype)], axis=1).T
    index, a, b = cells(np.clip(u, 0, 1), nodes)
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], axis=2)
    entries = np.concatenate([plane.reshape(-1, F) for plane in planes])
    starts = np.arange(0, index.size + 1, 4)  # of the rows of a sparse matrix, one row per reading
    reads = csr_matrix((weights.ravel(), index.ravel(), starts), (index.size // 4, len(entries)))
    values = (reads @ entries).reshape(len(planes) // 6, 6, N, F)
    features = np.concatenate([*values.prod(axis=1)], axis=1)
    return features, (nodes, extent, (u > 0) & (u < 1), index, a, b, entries, reads, values)


def backward(saved, features_bar):
    """Gradients of x and planes; time and box are data.

    A coordinate on or beyond a face has gradient zero, as in PyTorch; on an inner node its slope
    is that of the cell above.
    """
    nodes, extent, inside, index, a, b, entries, reads, values = saved
    P, N, F = *a.shape, entries.shape[1]
    levels_bar = np.stack(np.split(features_bar, len(values), axis=1))
    others = [np.delete(values, i, axis=1).prod(axis=1) for i in range(6)]
    values_bar = (np.stack(others, axis=1) * levels_bar[:, None]).reshape(P, N, F)
    entries_bar = reads.T @ values_bar.reshape(P * N, F)
    planes_bar = np.split(entries_bar, nodes.prod(axis=1).cumsum()[:-1])
    c = np.einsum("pnkf,pnf->kpn", entries[index], values_bar)  # by the weights of the four nodes
    along = (
        (1 - b) * (c[2] - c[0]) + b * (c[3] - c[1]),
        (1 - a) * (c[1] - c[0]) + a * (c[3] - c[2]),
    )
    u_bar = np.zeros((4, N), features_bar.dtype)
    for p in range(P):
        for axis, position_bar, n in zip(AXES[p % 6], along, nodes[p]):
            u_bar[axis] += (n - 1) * position_bar[p]
    return {
        "x": (u_bar * inside)[:3].T / extent,
        "planes": [bar.reshape(I, J, F) for bar, (I, J) in zip(planes_bar, nodes)],
    }


def cells(u, nodes):
    """The four nodes [P, N, 4] around points u [4, N] in [0, 1] in planes of nodes [P, 2].

    Nodes are numbered through all planes. Also returned is where in the cell the points are, as
    fractions a, b [P, N] of its two axes.
    """
    last = (nodes - 1)[:, :, None]
    position = u[np.resize(AXES, nodes.shape)] * last.astype(u.dtype)
    low = position.astype(np.int64)
    high = np.minimum(low + 1, last)  # at the upper face its weight is 0
    rows = np.stack([low[:, 0], low[:, 0], high[:, 0], high[:, 0]], axis=2)
    columns = np.stack([low[:, 1], high[:, 1], low[:, 1], high[:, 1]], axis=2)
    first = nodes.prod(axis=1).cumsum() - nodes.prod(axis=1)
    a, b = (position - np.floor(position)).transpose(1, 0, 2)
    return first[:, None, None] + rows * nodes[:, 1, None, None] + columns, a, b
