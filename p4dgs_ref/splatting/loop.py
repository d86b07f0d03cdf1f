"""The readable renderer: one Gaussian after the other, front to back. Read this file first.

A 2D splat has a centre `mean2d`, an opacity `alpha`, a colour, and a `conic` K, the inverse of its
2 x 2 covariance, which says how fast the splat fades away from its centre. At the pixel p it
covers the share

    A = min(0.99, alpha * exp(-(p - mean2d)^T K (p - mean2d) / 2))

of what lies behind it. The transmittance T of a pixel is the share of it that is not covered yet;
it starts at 1. For every splat, from front to back,

    image += T * A * color          the splat shows its colour where nothing covers it
    T     *= 1 - A                  and covers the share A of what was left

and at the end image += T * background. `backward` goes from back to front. It needs one number for
each pixel, `behind`: the product of d loss / d image with the colour seen behind the splat. Then

    d loss / d A = T * (d loss / d image . color - behind)

because a splat that covers more of the pixel shows more of its colour and less of what is behind.

The loop touches only the rectangle of pixels on which `settings` evaluates a splat. `compositing`
does the same for all splats and pixels at once, `fast` for lists of splats by tile; a test
compares all three.
"""

import numpy as np

from .compositing import depth_order
from .tiles import listable, pixel_bounds


def forward(
    mean2d,  # [N, 2]  centres (pixels)
    cov2d,  # [N, 3]  the numbers (a, b, c) of the covariance [[a, b], [b, c]] (square pixels)
    conic,  # [N, 3]  the same numbers of its inverse
    alpha,  # [N]  opacities
    color,  # [N, 3]  colours
    depth,  # [N]  decides the order only
    visible,  # [N]  bool: rows to draw
    background,  # [3]  colour behind everything
    height,  # []  of the image (pixels)
    width,  # []
    settings,  # a Settings; a stop by tile is ignored, because the loop has no tiles
):
    """Return image [height, width, 3], transmittance [height, width] and what `backward` needs."""
    image, T = np.zeros((height, width, 3)), np.ones((height, width))
    stopped = np.zeros((height, width), bool)
    drawn = []
    order = depth_order(depth, listable(alpha, visible, settings), occlusion=True)
    bounds = pixel_bounds(mean2d[order], cov2d[order], alpha[order], width, height, settings)
    for i, low, high in zip(order, *bounds):
        x_0, y_0 = low.clip(0, (width, height)).astype(int)
        x_1, y_1 = (high + 1).clip(0, (width, height)).astype(int)
        area = slice(y_0, max(y_0, y_1)), slice(x_0, max(x_0, x_1))
        y, x = np.mgrid[area]
        e_x, e_y = x - mean2d[i, 0], y - mean2d[i, 1]
        a, b, c = conic[i]
        falloff = np.exp(-0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y)
        A = np.minimum(alpha[i] * falloff, settings.alpha_max)
        A[A < settings.mask] = 0
        if settings.stop_by_pixel:
            stopped[area] |= T[area] * (1 - A) < settings.stop
            A[stopped[area]] = 0
        before = T[area].copy()
        image[area] += (before * A)[:, :, None] * color[i]
        T[area] *= 1 - A
        drawn.append((i, area, e_x, e_y, falloff, A, before))
    saved = (drawn, T, conic, alpha, color, background, settings)
    return (image + T[:, :, None] * background, T), saved


def backward(saved, image_bar):
    """Return the gradients of mean2d, conic, alpha, color and background."""
    drawn, T, conic, alpha, color, background, settings = saved
    N = len(alpha)
    mean2d_bar, conic_bar = np.zeros((N, 2)), np.zeros((N, 3))
    alpha_bar, color_bar = np.zeros(N), np.zeros((N, 3))
    behind = image_bar @ background
    for i, area, e_x, e_y, falloff, A, before in reversed(drawn):
        g = image_bar[area]
        color_bar[i] = ((before * A)[:, :, None] * g).sum(axis=(0, 1))
        gain = g @ color[i] - behind[area]
        behind[area] += A * gain
        V = before * gain * falloff * (A > 0)  # gradient of alpha, pixel by pixel
        if not settings.clamp_passes_gradient:
            V *= alpha[i] * falloff <= settings.alpha_max
        alpha_bar[i] = V.sum()
        V *= alpha[i]  # gradient of the exponent
        a, b, c = conic[i]
        mean2d_bar[i] = (V * (a * e_x + b * e_y)).sum(), (V * (b * e_x + c * e_y)).sum()
        conic_bar[i] = -(V * e_x**2).sum() / 2, -(V * e_x * e_y).sum(), -(V * e_y**2).sum() / 2
    return {
        "mean2d": mean2d_bar,
        "conic": conic_bar,
        "alpha": alpha_bar,
        "color": color_bar,
        "background": (T[:, :, None] * image_bar).sum(axis=(0, 1)),
    }
