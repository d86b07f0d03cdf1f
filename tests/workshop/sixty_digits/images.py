"""Covariance, projection, compositing, SSIM and Eq. (16) in decimals, from the printed formulas."""

from decimal import Decimal, getcontext
from functools import lru_cache

import numpy as np

from .floats import each
from .functions import exp

C1, C2 = Decimal("0.0001"), Decimal("0.0009")  # Q13: 0.01^2, 0.03^2
RADIUS, WIDTH = 5, Decimal("1.5")  # Q13: 11 pixels, sigma 1.5
# Q21. Thresholds are floats like the inputs that they are compared with, so that a depth of 0.2 is
# not beyond a plane at 0.2.
NEAR, BLUR, TAN_CLAMP = (Decimal(v) for v in (0.2, 0.3, 1.3))
ALPHA_MAX = 0.99  # rounded once more where opacities are float32


def forward_covariance(s, r):
    """R S S^T R^T with the printed matrix of an unnormalised quaternion (w, x, y, z)."""
    w, x, y, z = r.T
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        object,
    ).reshape(3, 3, len(s))
    return {"Sigma": np.einsum("ijn,nj,kjn->nik", R, s * s, R)}


def forward_projection(
    x, Sigma, W, T, focal, center, size, near=NEAR, blur=BLUR, tan_clamp=TAN_CLAMP
):
    """Gaussian by Gaussian; culled ones are zero."""
    rows = [
        _project(p, S, W, T, focal, center, size, near, blur, tan_clamp) for p, S in zip(x, Sigma)
    ]
    nothing = np.zeros((0, 2), object), np.zeros((0, 3), object), np.zeros((0, 3), object), [], []
    columns = [np.array(column, object) for column in zip(*rows)] or nothing
    return dict(zip(("mean2d", "cov2d", "conic", "depth", "visible"), columns))


def _project(p, Sigma, W, T, focal, center, size, near, blur, tan_clamp):
    culled = [0] * 2, [0] * 3, [0] * 3, 0, False
    X, Y, z = W @ p + T
    if not z > near:
        return culled
    slope = np.array([X / z, Y / z], object)
    limit = tan_clamp * size / (2 * focal)
    u, v = np.clip(slope, -limit, limit)
    J = np.array(
        [
            [focal[0] / z, Decimal(0), -focal[0] * u / z],
            [Decimal(0), focal[1] / z, -focal[1] * v / z],
        ],
        object,
    )
    cov = J @ W @ Sigma @ W.T @ J.T
    a, b, c = cov[0, 0] + blur, (cov[0, 1] + cov[1, 0]) / 2, cov[1, 1] + blur
    det = a * c - b * b
    if not det > 0:
        return culled
    return list(focal * slope + center), [a, b, c], [c / det, -b / det, a / det], z, True


def forward_compositing(
    mean2d,
    conic,
    alpha,
    color,
    depth,
    visible,
    background,
    height,
    width,
    occlusion=True,
    *,
    alpha_max,
):
    """Pixel by pixel, front to back. Without occlusion the splats add up."""
    visible_ones = [i for i in range(len(depth)) if visible[i]]
    order = sorted(visible_ones, key=lambda i: depth[i])  # stable: ties by index
    image, transmittance = np.empty((height, width, 3), object), np.empty((height, width), object)
    for row in range(height):
        for column in range(width):
            C, T = [Decimal(0)] * 3, Decimal(1)
            for i in order:
                opacity = min(
                    alpha[i] * _falloff(column - mean2d[i, 0], row - mean2d[i, 1], conic[i]),
                    alpha_max,
                )
                C = C + color[i] * (opacity * T)
                T *= 1 - opacity if occlusion else 1
            image[row, column], transmittance[row, column] = C + T * background, T
    return {"image": image, "transmittance": transmittance}


def forward_render(x, s, r, W, T, focal, center, size, **looks):
    """From Gaussians to an image."""
    splats = forward_projection(x, forward_covariance(s, r)["Sigma"], W, T, focal, center, size)
    splats.pop("cov2d")
    return forward_compositing(**splats, **looks)


def _falloff(e_x, e_y, conic):
    a, b, c = conic
    return exp(min(-(a * e_x * e_x + c * e_y * e_y) / 2 - b * e_x * e_y, Decimal(0)))


# --- losses --------------------------------------------------------------------------------------
def blur(a):
    """Average (H, W, C) over the window, with zeros around the image."""
    return _blurred(a.shape, tuple(a.ravel()), getcontext().prec)


@lru_cache(8)
def _blurred(shape, numbers, precision):
    a = np.array(numbers, object).reshape(shape)
    tap = np.array([exp(-((i / WIDTH) ** 2) / 2) for i in range(-RADIUS, RADIUS + 1)], object)
    tap = tap / tap.sum()
    for axis in (0, 1):
        n = a.shape[axis]
        window = np.full((n, n), Decimal(0), object)
        for i in range(n):
            for j in range(max(0, i - RADIUS), min(n, i + RADIUS + 1)):
                window[i, j] = tap[j - i + RADIUS]
        a = np.moveaxis(np.tensordot(window, a, axes=(1, axis)), 0, axis)
    return a


def similarity(x, y):
    """The mean of SSIM over pixels and channels."""
    mu_x, mu_y = blur(x), blur(y)
    var_x, var_y, cov = (
        blur(x * x) - mu_x * mu_x,
        blur(y * y) - mu_y * mu_y,
        blur(x * y) - mu_x * mu_y,
    )
    ssim = (
        (2 * mu_x * mu_y + C1)
        * (2 * cov + C2)
        / ((mu_x * mu_x + mu_y * mu_y + C1) * (var_x + var_y + C2))
    )
    return ssim.sum() / ssim.size


def forward_ssim(image, truth):
    return {"ssim": similarity(image, truth)}


def forward_render_loss(image, truth, lambda_ssim):
    L1, D_SSIM = each(abs, image - truth).sum() / image.size, 1 - similarity(image, truth)
    return {"L_render": (1 - lambda_ssim) * L1 + lambda_ssim * D_SSIM, "L1": L1, "D_SSIM": D_SSIM}


FORMULAS = {  # key -> formula, inputs that receive a gradient
    "covariance": (forward_covariance, ("s", "r")),
    "projection": (forward_projection, ("x", "Sigma")),
    "compositing": (forward_compositing, ("mean2d", "conic", "alpha", "color", "background")),
    "render": (forward_render, ("x", "s", "r")),
    "ssim": (forward_ssim, ("image",)),
    "render_loss": (forward_render_loss, ("image",)),
}
