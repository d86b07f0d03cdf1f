"""The projection of 3D Gaussians to 2D splats: mean, covariance, its inverse (the conic) and depth.

    mean2d = (f_x x/z + c_x, f_y y/z + c_y)        in camera coordinates
    cov2d  = J W Sigma W^T J^T + blur I            J = [[f_x/z, 0, -f_x u/z], [0, f_y/z, -f_y v/z]]
    u, v   = x/z, y/z clamped to +-tan_clamp * size / (2 focal)

Zwicker et al. 2001 and Kerbl et al. 2023 (3DGS); P-4DGS uses it without a number. Symmetric 2 x 2
matrices are stored as the numbers (a, b, c) of [[a, b], [b, c]], so that the gradient of b counts
both off-diagonal entries. Computed in float64 throughout, because the determinant of a needle
cancels. In a frame R in which Sigma is diagonal it does not, whatever the needle's length: with
the rows m_1, m_2 of m = J W R and n = m_1 x m_2 every term of it is positive, and neither does
K m cancel, which the gradient needs:

    det = n^T adj(Sigma) n + blur (m_1^T Sigma m_1 + m_2^T Sigma m_2) + blur^2
    K m = ((Sigma m_2) x n + blur m_1, n x (Sigma m_1) + blur m_2) / det
"""

import numpy as np


def forward(
    x,  # [N, 3]  centres (scene units)
    Sigma,  # [N, 3, 3]  covariances, symmetric (square scene units)
    W,  # [3, 3]  rotation from world to camera
    T,  # [3]  translation from world to camera (scene units)
    focal,  # [2]  f_x, f_y (pixels)
    center,  # [2]  principal point (pixels); pixel centres are at integers (Q20)
    size,  # [2]  width and height of the image (pixels)
    near=0.2,  # Gaussians at this depth or nearer are culled (scene units); constants of Q21
    blur=0.3,  # added to both variances (square pixels)
    tan_clamp=1.3,  # the clamp of u and v, relative to the image's edge, about the optical axis
    R=None,  # or rotations [N, 3, 3]: the covariances are R Sigma R^T, and Sigma is diagonal
):
    """Return mean2d [N, 2], cov2d and conic [N, 3], depth, visible [N] and what `backward` needs.

    Culled rows are zero and not visible: a depth at or before `near`, a determinant that is not
    positive, and every NaN or infinity. Without R, the conic of a needle L pixels long is accurate
    to eps L**2 / blur; with R, to a few eps.
    """
    dtype, inner = x.dtype, np.result_type(x, np.float64)
    W, T, focal, center = (np.asarray(a, inner) for a in (W, T, focal, center))
    Sigma = Sigma.astype(inner, copy=False)
    x_c = x @ W.T + T  # [N, 3]  camera coordinates
    visible = (x_c[:, 2] > near) & np.isfinite(x_c).all(axis=1)
    x_c = np.where(visible[:, None], x_c, (0.0, 0.0, 1.0))
    z = x_c[:, 2:]  # [N, 1]
    ratio, limit = x_c[:, :2] / z, tan_clamp * np.asarray(size) / (2 * focal)
    uv = np.clip(ratio, -limit, limit)  # [N, 2]
    JW = (W[None, :2] - uv[:, :, None] * W[2]) * (focal / z)[:, :, None]  # [N, 2, 3]
    m = JW if R is None else JW @ R  # [N, 2, 3]  its rows are m_1 and m_2
    mS = m @ Sigma
    a, c = (np.einsum("nij,nij->ni", mS, m) + blur).T  # [N]  the diagonal of cov2d
    # the mean of both off-diagonal entries
    b = ((mS[:, 0] * m[:, 1]).sum(axis=1) + (mS[:, 1] * m[:, 0]).sum(axis=1)) / 2
    with np.errstate(over="ignore", invalid="ignore"):  # splats beyond every image, culled below
        if R is None:
            det = a * c - b * b
        else:
            n, variance = cross(m[:, 0], m[:, 1]), np.einsum("nii->ni", Sigma)
            adjugate = variance[:, [1, 2, 0]] * variance[:, [2, 0, 1]]
            det = (n * n * adjugate).sum(axis=1) + blur * (a + c - blur)  # a and c have the blur
    visible &= (det > 0) & np.isfinite(det)
    det = np.where(visible, det, 1)
    m, Sigma = (np.where(visible[:, None, None], a, 0) for a in (m, Sigma))
    inverse = np.where(visible, np.stack([c, -b, a]) / det, 0).T
    mean2d, cov2d, conic, depth = (
        np.where(visible[:, None], a, 0).astype(dtype, copy=False)
        for a in (ratio * focal + center, np.stack([a, b, c], axis=1), inverse, z)
    )
    saved = (x_c, np.abs(ratio) <= limit, JW, m, R, det, blur, Sigma, inverse)
    saved += (visible, W, focal, dtype)
    return (mean2d, cov2d, conic, depth[:, 0], visible), saved


def backward(saved, mean2d_bar=None, cov2d_bar=None, conic_bar=None, depth_bar=None):
    """Gradients of x, Sigma (symmetric) and, if there was one, R; zero for culled rows.

    The gradient of the clamp is 1 inside and on its ends and 0 outside.
    """
    x_c, inside, JW, m, R, det, blur, Sigma, inverse, visible, W, focal, dtype = saved
    z, K = x_c[:, 2:], symmetric(*inverse.T)
    # In the forward (a, b, c) becomes the conic K = cov^-1, so d(K) = -K d(cov) K.
    cov_bar = np.zeros_like(K)  # gradient of the symmetric matrix [[a, b], [b, c]]
    if conic_bar is not None and R is None:
        cov_bar -= K @ halved(conic_bar, visible) @ K
    if cov2d_bar is not None:
        cov_bar += halved(cov2d_bar, visible)
    cov_bar[:, 1, 0] = cov_bar[:, 0, 1]  # exactly symmetric, also in the last bits
    # In the forward cov = m Sigma m^T, so Sigma gets m^T cov_bar m and m, which stands there
    # twice, gets cov_bar m (Sigma + Sigma^T).
    Sigma_bar, m_bar = m.transpose(0, 2, 1) @ cov_bar @ m, cov_bar @ m
    if conic_bar is not None and R is not None:  # the same, but nothing cancels
        n, mS = cross(m[:, 0], m[:, 1]), m @ Sigma
        Km = np.stack([cross(mS[:, 1], n), cross(n, mS[:, 0])], axis=1) + blur * m
        Km /= det[:, None, None]
        K_bar_Km = halved(conic_bar, visible) @ Km
        Sigma_bar -= Km.transpose(0, 2, 1) @ K_bar_Km
        m_bar -= K @ K_bar_Km
    m_bar = m_bar @ (Sigma + Sigma.transpose(0, 2, 1))
    bars = {"Sigma": Sigma_bar}
    if R is not None:
        bars["R"] = JW.transpose(0, 2, 1) @ m_bar
        m_bar = np.where(visible[:, None, None], m_bar @ R.transpose(0, 2, 1), 0)
    # In the forward J W = focal / z (W_xy - uv W_z), so uv gets -W_z focal / z and z gets -J W / z.
    uv_bar = -(m_bar @ W[2]) * focal / z
    z_bar = -(m_bar * JW).sum(axis=(1, 2))[:, None] / z
    ratio_bar = uv_bar * inside
    if mean2d_bar is not None:
        ratio_bar = ratio_bar + np.where(visible[:, None], mean2d_bar, 0) * focal
    # In the forward ratio = (x, y) / z, so x and y get 1 / z and z gets -(x, y) / z**2.
    z_bar -= (ratio_bar * x_c[:, :2]).sum(axis=1, keepdims=True) / z**2
    if depth_bar is not None:
        z_bar[:, 0] += np.where(visible, depth_bar, 0)
    bars["x"] = np.concatenate([ratio_bar / z, z_bar], axis=1) @ W
    return {name: bar.astype(dtype, copy=False) for name, bar in bars.items()}


def halved(bar, visible):
    """The gradients [N, 2, 2] of symmetric matrices from those of (a, b, c); zero if culled."""
    a_bar, b_bar, c_bar = np.where(visible[:, None], bar, 0).T
    return symmetric(a_bar, b_bar / 2, c_bar)


def cross(a, b):
    """Cross products of vectors [N, 3]; `np.cross` takes twice as long."""
    (a_1, a_2, a_3), (b_1, b_2, b_3) = a.T, b.T
    return np.stack([a_2 * b_3 - a_3 * b_2, a_3 * b_1 - a_1 * b_3, a_1 * b_2 - a_2 * b_1], axis=1)


def symmetric(a, b, c):
    """The matrices [[a, b], [b, c]] [N, 2, 2]."""
    return np.stack([a, b, b, c], axis=1).reshape(-1, 2, 2)
