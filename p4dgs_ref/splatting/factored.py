"""Covariance and projection as training and rendering run them: Sigma stays in its factors s and R.

`covariance` and `projection` say what is computed. For a needle, a very long and thin Gaussian,
they lose digits twice: Sigma loses an axis whose scale is below 1e-8 of the longest one's, and the
determinant of the splat is a difference of nearly equal numbers. Here neither happens, whatever the
needle's length. With the rows m_1, m_2 of m = J W R, n = m_1 x m_2 and S = diag(s)^2,

    det = n^T adj(S) n + blur (m_1^T S m_1 + m_2^T S m_2) + blur^2
    K m = ((S m_2) x n + blur m_1, n x (S m_1) + blur m_2) / det

Every term of the determinant is positive. K m is what the gradient needs instead of K.
"""

import numpy as np

from .covariance import rotation_backward, rotation_matrix
from .projection import (
    covariance2d,
    cross,
    matrix_gradient,
    project_centers,
    project_centers_backward,
    splats,
)


def forward(
    x,  # [N, 3]  centres (scene units)
    s,  # [N, 3]  standard deviations (scene units)
    r,  # [N, 4]  unit quaternions (w, x, y, z)
    W,  # arguments of `projection` from here on
    T,
    focal,
    center,
    size,
    near,
    blur,
    tan_clamp,
):
    """Return what `projection` returns for the covariances of s and r.

    The conic of a needle is accurate to a few eps.
    """
    (mean2d, depth, JW, in_front), saved_centers = project_centers(
        x, W, T, focal, center, size, near, tan_clamp
    )
    R = rotation_matrix(r)
    m, S = JW @ R, s**2
    a, b, c = covariance2d(m, m * S[:, None], blur)
    with np.errstate(over="ignore", invalid="ignore"):  # splats beyond every image, culled below
        n = cross(m[:, 0], m[:, 1])
        adjugate = S[:, [1, 2, 0]] * S[:, [2, 0, 1]]
        det = (n * n * adjugate).sum(axis=1) + blur * (a + c - blur)  # a and c have the blur
    outputs, K = splats(mean2d, (a, b, c), det, depth, in_front, x.dtype)
    *_, visible = outputs
    m, det = np.where(visible[:, None, None], m, 0), np.where(visible, det, 1)
    return outputs, (saved_centers, JW, m, s, r, R, det, blur, K, visible)


def backward(saved, mean2d_bar, conic_bar, depth_bar=None):
    """Return the gradients of x, s and r; zero for culled rows."""
    saved_centers, JW, m, s, r, R, det, blur, K, visible = saved
    s = np.where(visible[:, None], s, 0)
    S = s[:, None] ** 2
    n, mS = cross(m[:, 0], m[:, 1]), m * S
    Km = np.stack([cross(mS[:, 1], n), cross(n, mS[:, 0])], axis=1) + blur * m
    Km /= det[:, None, None]
    # In `projection` Sigma gets -m^T K K_bar K m, and m gets -K K_bar K m times twice Sigma.
    K_bar_Km = matrix_gradient(conic_bar, visible) @ Km
    S_bar = -np.einsum("nii->ni", Km.transpose(0, 2, 1) @ K_bar_Km)
    m_bar = -(K @ K_bar_Km) * (2 * S)
    R_bar = JW.transpose(0, 2, 1) @ m_bar
    JW_bar = np.where(visible[:, None, None], m_bar @ R.transpose(0, 2, 1), 0)
    return {
        "x": project_centers_backward(saved_centers, JW_bar, mean2d_bar, depth_bar, visible),
        "s": 2 * s * S_bar,
        "r": rotation_backward(r, R_bar),
    }
