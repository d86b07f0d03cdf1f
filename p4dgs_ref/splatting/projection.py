"""The projection of 3D Gaussians to 2D splats: mean, covariance, its inverse (the conic) and depth.

    mean2d = (f_x x/z + c_x, f_y y/z + c_y)        in camera coordinates
    cov2d  = J W Sigma W^T J^T + blur I            J = [[f_x/z, 0, -f_x u/z], [0, f_y/z, -f_y v/z]]
    u, v   = x/z, y/z clamped to +-tan_clamp * size / (2 focal)

Zwicker et al. 2001 and Kerbl et al. 2023 (3DGS); P-4DGS uses it without a number. Symmetric 2 x 2
matrices are stored as the numbers (a, b, c) of [[a, b], [b, c]], so that the gradient of b counts
both off-diagonal entries. Computed in float64 throughout, because the determinant a c - b b of a
long thin splat is a difference of nearly equal numbers. Training and rendering run `factored`,
which computes the same from scales and quaternions, without this difference.
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

    A row is culled, zero and not visible, if its depth is at or before `near`, if its camera
    coordinates are not finite, or if the determinant of cov2d is not positive or not finite.
    The conic of a splat that is L pixels long is accurate to eps L**2 / blur.
    """
    (mean2d, depth, JW, in_front), saved_centers = project_centers(
        x, W, T, focal, center, size, near, tan_clamp
    )
    Sigma = Sigma.astype(JW.dtype, copy=False)
    a, b, c = covariance2d(JW, JW @ Sigma, blur)
    with np.errstate(over="ignore", invalid="ignore"):  # splats beyond every image, culled below
        det = a * c - b * b
    outputs, K = splats(mean2d, (a, b, c), det, depth, in_front, x.dtype)
    *_, visible = outputs
    m, Sigma = (np.where(visible[:, None, None], a, 0) for a in (JW, Sigma))
    return outputs, (saved_centers, m, Sigma, K, visible, x.dtype)


def backward(saved, mean2d_bar=None, cov2d_bar=None, conic_bar=None, depth_bar=None):
    """Return the gradients of x and Sigma (symmetric); zero for culled rows.

    The gradient of the clamp is 1 inside and on its ends and 0 outside.
    """
    saved_centers, m, Sigma, K, visible, dtype = saved
    cov_bar = np.zeros_like(K)  # gradient of the symmetric matrix [[a, b], [b, c]]
    if conic_bar is not None:
        # In the forward (a, b, c) becomes the conic K = cov^-1, so d(K) = -K d(cov) K.
        cov_bar -= K @ matrix_gradient(conic_bar, visible) @ K
    if cov2d_bar is not None:
        cov_bar += matrix_gradient(cov2d_bar, visible)
    cov_bar[:, 1, 0] = cov_bar[:, 0, 1]  # exactly symmetric, also in the last bits
    # In the forward cov = m Sigma m^T, so Sigma gets m^T cov_bar m and m, which stands there
    # twice, gets cov_bar m (Sigma + Sigma^T).
    Sigma_bar = m.transpose(0, 2, 1) @ cov_bar @ m
    m_bar = cov_bar @ m @ (Sigma + Sigma.transpose(0, 2, 1))
    x_bar = project_centers_backward(saved_centers, m_bar, mean2d_bar, depth_bar, visible)
    return {"x": x_bar.astype(dtype, copy=False), "Sigma": Sigma_bar.astype(dtype, copy=False)}


def project_centers(x, W, T, focal, center, size, near, tan_clamp):
    """Return mean2d [N, 2], depth [N, 1], J W [N, 2, 3], in_front [N] and what `backward` needs."""
    inner = np.result_type(x, np.float64)
    W, T, focal, center = (np.asarray(a, inner) for a in (W, T, focal, center))
    x_c = x @ W.T + T  # [N, 3]  camera coordinates
    in_front = (x_c[:, 2] > near) & np.isfinite(x_c).all(axis=1)
    x_c = np.where(in_front[:, None], x_c, (0.0, 0.0, 1.0))
    z = x_c[:, 2:]
    ratio, limit = x_c[:, :2] / z, tan_clamp * np.asarray(size) / (2 * focal)
    uv = np.clip(ratio, -limit, limit)
    JW = (W[None, :2] - uv[:, :, None] * W[2]) * (focal / z)[:, :, None]
    inside = np.abs(ratio) <= limit
    return (ratio * focal + center, z, JW, in_front), (x_c, inside, JW, W, focal)


def project_centers_backward(saved, JW_bar, mean2d_bar, depth_bar, visible):
    """Return the gradient of x."""
    x_c, inside, JW, W, focal = saved
    z = x_c[:, 2:]
    # In the forward J W = focal / z (W_xy - uv W_z), so uv gets -W_z focal / z and z gets -J W / z.
    uv_bar = -(JW_bar @ W[2]) * focal / z
    z_bar = -(JW_bar * JW).sum(axis=(1, 2))[:, None] / z
    ratio_bar = uv_bar * inside
    if mean2d_bar is not None:
        ratio_bar = ratio_bar + np.where(visible[:, None], mean2d_bar, 0) * focal
    # In the forward ratio = (x, y) / z, so x and y get 1 / z and z gets -(x, y) / z**2.
    z_bar -= (ratio_bar * x_c[:, :2]).sum(axis=1, keepdims=True) / z**2
    if depth_bar is not None:
        z_bar[:, 0] += np.where(visible, depth_bar, 0)
    return np.concatenate([ratio_bar / z, z_bar], axis=1) @ W


def covariance2d(m, mS, blur):
    """Return the numbers a, b, c [N] of m S m^T + blur I."""
    a, c = (np.einsum("nij,nij->ni", mS, m) + blur).T
    # the mean of both off-diagonal entries
    b = ((mS[:, 0] * m[:, 1]).sum(axis=1) + (mS[:, 1] * m[:, 0]).sum(axis=1)) / 2
    return a, b, c


def splats(mean2d, cov2d, det, depth, in_front, dtype):
    """Return the outputs, with zeros in culled rows, and the conics as matrices K [N, 2, 2]."""
    visible = in_front & (det > 0) & np.isfinite(det)
    a, b, c = cov2d
    conic = np.stack([c, -b, a], axis=1) / np.where(visible, det, 1)[:, None]
    rows = mean2d, np.stack([a, b, c], axis=1), conic, depth
    mean2d, cov2d, conic, depth = (np.where(visible[:, None], values, 0) for values in rows)
    floats = (a.astype(dtype, copy=False) for a in (mean2d, cov2d, conic, depth[:, 0]))
    return (*floats, visible), symmetric(*conic.T)


def matrix_gradient(bar, visible):
    """Return the gradients [N, 2, 2] of matrices from those of (a, b, c); zero if culled."""
    a_bar, b_bar, c_bar = np.where(visible[:, None], bar, 0).T
    return symmetric(a_bar, b_bar / 2, c_bar)


def cross(a, b):
    """Return cross products of vectors [N, 3]; `np.cross` takes twice as long."""
    (a_1, a_2, a_3), (b_1, b_2, b_3) = a.T, b.T
    return np.stack([a_2 * b_3 - a_3 * b_2, a_3 * b_1 - a_1 * b_3, a_1 * b_2 - a_2 * b_1], axis=1)


def symmetric(a, b, c):
    """Return the matrices [[a, b], [b, c]] [N, 2, 2]."""
    return np.stack([a, b, b, c], axis=1).reshape(-1, 2, 2)
