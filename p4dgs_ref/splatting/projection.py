"""The projection of 3D Gaussians to 2D splats: mean, covariance, its inverse (the conic) and depth.

    mean2d = (f_x x/z + c_x, f_y y/z + c_y)        in camera coordinates
    cov2d  = J W Sigma W^T J^T + blur I            J = [[f_x/z, 0, -f_x u/z], [0, f_y/z, -f_y v/z]]
    u, v   = x/z, y/z clamped to +-tan_clamp * size / (2 focal)

Zwicker et al. 2001 and Kerbl et al. 2023 (3DGS); P-4DGS uses it without a number. Symmetric 2 x 2
matrices are stored as the numbers (a, b, c) of [[a, b], [b, c]], so that the gradient of b counts
both off-diagonal entries. Computed in float64 throughout, because the determinant of a needle
cancels.
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
):
    """Return mean2d [N, 2], cov2d and conic [N, 3], depth, visible [N] and what `backward` needs.

    Culled rows are zero and not visible: a depth at or before `near`, a determinant that is not
    positive, and every NaN or infinity. The conic of a needle L pixels long is accurate to
    eps L**2 / blur.
    """
    dtype, inner = x.dtype, np.result_type(x, np.float64)
    W, T, focal, center = (np.asarray(a, inner) for a in (W, T, focal, center))
    Sigma = Sigma.astype(inner, copy=False)
    x_c = x @ W.T + T
    visible = (x_c[:, 2] > near) & np.isfinite(x_c).all(axis=1)
    x_c = np.where(visible[:, None], x_c, (0.0, 0.0, 1.0))
    z = x_c[:, 2:]
    ratio, limit = x_c[:, :2] / z, tan_clamp * np.asarray(size) / (2 * focal)
    uv = np.clip(ratio, -limit, limit)
    m = (W[None, :2] - uv[:, :, None] * W[2]) * (focal / z)[:, :, None]  # the rows of J W
    mS = m @ Sigma
    a, c = (np.einsum("nij,nij->ni", mS, m) + blur).T
    # the mean of both off-diagonal entries
    b = ((mS[:, 0] * m[:, 1]).sum(axis=1) + (mS[:, 1] * m[:, 0]).sum(axis=1)) / 2
    with np.errstate(over="ignore", invalid="ignore"):  # splats beyond every image, culled below
        det = a * c - b * b
    visible &= (det > 0) & np.isfinite(det)
    det, Sigma = np.where(visible, det, 1), np.where(visible[:, None, None], Sigma, 0)
    inverse = np.where(visible, np.stack([c, -b, a]) / det, 0).T
    mean2d, cov2d, conic, depth = (
        np.where(visible[:, None], a, 0).astype(dtype, copy=False)
        for a in (ratio * focal + center, np.stack([a, b, c], axis=1), inverse, z)
    )
    saved = (x_c, np.abs(ratio) <= limit, m, Sigma, inverse, visible, W, focal, dtype)
    return (mean2d, cov2d, conic, depth[:, 0], visible), saved


def backward(saved, mean2d_bar=None, cov2d_bar=None, conic_bar=None, depth_bar=None):
    """Gradients of x and Sigma (symmetric); zero for culled rows.

    The gradient of the clamp is 1 inside and on its ends and 0 outside.
    """
    x_c, inside, m, Sigma, inverse, visible, W, focal, dtype = saved
    z = x_c[:, 2:]
    cov_bar = np.zeros((len(z), 2, 2), z.dtype)  # gradient of the symmetric matrix [[a, b], [b, c]]
    if conic_bar is not None:
        K = symmetric(*inverse.T)
        a_bar, b_bar, c_bar = conic_bar.T
        cov_bar -= K @ symmetric(a_bar, b_bar / 2, c_bar) @ K  # d(K) = -K d(cov) K
    if cov2d_bar is not None:
        a_bar, b_bar, c_bar = cov2d_bar.T
        cov_bar += symmetric(a_bar, b_bar / 2, c_bar)
    cov_bar = np.where(visible[:, None, None], cov_bar, 0)
    cov_bar[:, 1, 0] = cov_bar[:, 0, 1]  # exactly symmetric, also in the last bits
    Sigma_bar = m.transpose(0, 2, 1) @ cov_bar @ m
    m_bar = cov_bar @ m @ (Sigma + Sigma.transpose(0, 2, 1))
    uv_bar = -(m_bar @ W[2]) * focal / z
    z_bar = -(m_bar * m).sum(axis=(1, 2))[:, None] / z  # m is proportional to 1/z
    ratio_bar = uv_bar * inside
    if mean2d_bar is not None:
        ratio_bar = ratio_bar + np.where(visible[:, None], mean2d_bar, 0) * focal
    z_bar -= (ratio_bar * x_c[:, :2]).sum(axis=1, keepdims=True) / z**2
    if depth_bar is not None:
        z_bar[:, 0] += np.where(visible, depth_bar, 0)
    x_bar = np.concatenate([ratio_bar / z, z_bar], axis=1) @ W
    return {"x": x_bar.astype(dtype, copy=False), "Sigma": Sigma_bar.astype(dtype, copy=False)}


def symmetric(a, b, c):
    """The matrices [[a, b], [b, c]] [N, 2, 2]."""
    return np.stack([a, b, b, c], axis=1).reshape(-1, 2, 2)
