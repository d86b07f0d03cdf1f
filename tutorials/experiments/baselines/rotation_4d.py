"""G1: a rotation of space and time from two quaternions.

    R v = l v conj(r)        l = raw_l / |raw_l|,  r = raw_r / |raw_r|

Yang et al. 2023 (4DGS). A point v = (x, y, z, t) is read as the quaternion t + xi + yj + zk, so
that R is the matrix of the product with l from the left, times that of the product with conj(r)
from the right (left and right isoclinic rotations). With l = r it turns space alone, as in 3DGS,
and keeps time; (l, r) and (-l, -r) are one rotation. The authors' code numbers the axes backwards,
which gives the same set of rotations.
"""

import numpy as np

from p4dgs_ref.equations.numerics import normalise, normalise_backward


def forward(
    raw_l,  # [N, 4]  quaternions (w, x, y, z) of any length
    raw_r,  # [N, 4]  likewise
):
    """Return the rotations R [N, 4, 4] of (x, y, z, t) and what `backward` needs.

    A quaternion of zeros gives a matrix of zeros.
    """
    l, norm_l = normalise(raw_l)
    r, norm_r = normalise(raw_r)
    left, right = product(l, 1), product(r, -1)
    return left @ right, (l, norm_l, left, r, norm_r, right)


def backward(saved, R_bar):
    """Gradients of raw_l and raw_r."""
    l, norm_l, left, r, norm_r, right = saved
    l_bar = product_backward(R_bar @ right.transpose(0, 2, 1), 1)
    r_bar = product_backward(left.transpose(0, 2, 1) @ R_bar, -1)
    return {
        "raw_l": normalise_backward(l, norm_l, l_bar),
        "raw_r": normalise_backward(r, norm_r, r_bar),
    }


def product(q, side):
    """The matrices [N, 4, 4] of v -> q v (side 1) and of v -> v conj(q) (side -1)."""
    w, x, y, z = q.T
    rows = [
        [w, -z, y, side * x],
        [z, w, -x, side * y],
        [-y, x, w, side * z],
        [-side * x, -side * y, -side * z, w],
    ]
    return np.ascontiguousarray(np.transpose(rows, (2, 0, 1)))


def product_backward(M_bar, side):
    """Gradient of q [N, 4] from the cotangent of `product`."""
    (a, b, c, d), (e, f, g, h), (i, j, k, m), (n, o, p, q) = M_bar.transpose(1, 2, 0)
    return np.stack(
        [
            a + f + k + q,
            j - g + side * (d - n),
            c - i + side * (h - o),
            e - b + side * (m - p),
        ],
        axis=1,
    )
