"""The covariance of a Gaussian from its scale and its quaternion.

    Sigma = R(r) diag(s)**2 R(r)^T

Kerbl et al. 2023 (3DGS), Eq. (6); P-4DGS uses it without a number. Computed as M M^T with
M = R diag(s). Training and rendering run `factored`, which takes R(r) from here and does not form
Sigma, because Sigma loses an axis whose scale is below 1e-8 of the longest one's.
"""

import numpy as np


def forward(
    s,  # [N, 3]  standard deviations along the axes (scene units); the sign cancels (Q9)
    r,  # [N, 4]  quaternion (w, x, y, z) of unit length; it is not normalised here
):
    """Return Sigma [N, 3, 3] (square scene units) and what `backward` needs."""
    R = rotation_matrix(r)
    M = R * s[:, None, :]
    return M @ M.transpose(0, 2, 1), (M, R, s, r)


def backward(saved, Sigma_bar):
    """Return the gradients of s and r; that of r is not projected on the unit sphere."""
    M, R, s, r = saved
    M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ M  # both factors of M M^T
    s_bar = np.einsum("nij,nij->nj", M_bar, R)
    R_bar = M_bar * s[:, None, :]
    return {"s": s_bar, "r": rotation_backward(r, R_bar)}


def rotation_matrix(r):
    """Return the matrices [N, 3, 3] of unit quaternions (w, x, y, z) [N, 4]."""
    w, x, y, z = r.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.transpose(rows, (2, 0, 1)))


def rotation_backward(r, R_bar):
    """Return the gradient of r [N, 4], the plain derivative, from that of the matrices."""
    w, x, y, z = r.T
    (a, b, c), (d, e, f), (g, h, i) = R_bar.transpose(1, 2, 0)
    w_bar = z * (d - b) + y * (c - g) + x * (h - f)
    x_bar = y * (b + d) + z * (c + g) + w * (h - f) - 2 * x * (e + i)
    y_bar = x * (b + d) + z * (f + h) + w * (c - g) - 2 * y * (a + i)
    z_bar = x * (c + g) + y * (f + h) + w * (d - b) - 2 * z * (a + e)
    return 2 * np.stack([w_bar, x_bar, y_bar, z_bar], axis=1)
