"""H3: how rough the planes are in space and in time, and how much they change in time.

    L_space = sum over xy, xz, yz of mean (P[i+1, j] - P[i, j])^2 + mean (P[i, j+1] - P[i, j])^2
    L_time = sum over xt, yt, zt of mean (P[i, j+1] - 2 P[i, j] + P[i, j-1])^2
    L_one = sum over xt, yt, zt of mean |P - 1|

Wu et al. 2024 (4DGaussians), with the total variation of HexPlane and K-Planes. A plane in time
that is 1 everywhere leaves the features as they are in space. In space the authors' code takes the
squares of L_time, along the second axis of each plane alone, so that nothing becomes smooth along
x. That is a mistake; their article has the total variation.

The weights of `hexplane` are those of the authors' code: 1e-4 for its squares of second differences
in space, in whose place L_space stands here, 0.01 for L_time and 1e-4 for L_one, which are the same
there. tutorials/reference.md says how little the choice in space matters.
"""

import numpy as np


def forward(
    planes,  # list of [I, J, F]  level by level, each xy, xz, yz, xt, yt, zt
):
    """Return L_space [], L_time [], L_one [] and what `backward` needs."""
    losses = np.zeros(3, planes[0].dtype)
    for i, plane in enumerate(planes):
        if i % 6 < 3:
            losses[0] += roughness(plane, 1, axis=0) + roughness(plane, 1, axis=1)
        else:
            losses[1] += roughness(plane, 2, axis=1)
            losses[2] += np.abs(plane - 1).mean()
    return tuple(losses), planes


def backward(planes, L_space_bar, L_time_bar, L_one_bar):
    """Gradient of the planes; that of |P - 1| is 0 at P = 1."""
    planes_bar = []
    for i, plane in enumerate(planes):
        if i % 6 < 3:
            slope = roughness_slope(plane, 1, axis=0) + roughness_slope(plane, 1, axis=1)
            planes_bar.append(L_space_bar * slope)
        else:
            jerk = L_time_bar * roughness_slope(plane, 2, axis=1)
            planes_bar.append(jerk + L_one_bar * np.sign(plane - 1) / plane.size)
    return {"planes": planes_bar}


def roughness(plane, n, axis):
    """The mean square of the n-th differences along an axis; 0 where it is too short."""
    d = np.diff(plane, n, axis)
    return (d * d).sum() / max(d.size, 1)


def roughness_slope(plane, n, axis):
    """The derivative of `roughness` by every number of the plane."""
    slope = np.diff(plane, n, axis)
    slope *= 2 / max(slope.size, 1)
    zero = plane.dtype.type(0)
    for _ in range(n):  # the transpose of a difference is one of the other sign, with zeros around
        slope = -np.diff(slope, axis=axis, prepend=zero, append=zero)
    return slope
