"""Front-to-back alpha compositing: every Gaussian at every pixel, nothing skipped.

    image(p)   = sum_i color_i alpha_i(p) T_i(p) + T_N(p) background
    alpha_i(p) = min(alpha_max, alpha_i exp(-(p - mean2d_i)^T K_i (p - mean2d_i) / 2))
    T_i(p)     = product over j < i of 1 - alpha_j(p)                    i from front to back

Kerbl et al. 2023 (3DGS), Eq. (3); P-4DGS uses it without a number. K_i is the conic, the inverse
of the splat's covariance. This is the definition that `loop` and `fast` are compared with. It
keeps all pairs of N Gaussians and a block of pixels at once, and `backward` computes them again.
"""

import numpy as np

BLOCK = 1 << 20  # pairs of Gaussians and pixels in memory at once (bounds the memory)


def forward(
    mean2d,  # [N, 2]  centres (pixels; pixel centres are at integers)
    conic,  # [N, 3]  the numbers (a, b, c) of K = [[a, b], [b, c]] (1 / square pixels)
    alpha,  # [N]  opacities in [0, 1]
    color,  # [N, 3]  colours
    depth,  # [N]  decides the order only; equal depths stay in the order of their index
    visible,  # [N]  bool: rows to draw
    background,  # [3]  colour behind everything
    height,  # []  of the image (pixels)
    width,  # []
    occlusion=True,  # False: splats add up and hide nothing, T = 1 everywhere
    alpha_max=0.99,  # clamp of alpha (Q21)
):
    """Return image [height, width, 3], transmittance [height, width] and what `backward` needs."""
    order = depth_order(depth, visible, occlusion)
    splats = mean2d[order], conic[order], alpha[order], alpha_max
    image = np.empty((height * width, 3), mean2d.dtype)
    transmittance = np.empty(height * width, mean2d.dtype)
    for pixels, x, y in pixel_blocks(height, width, len(order), mean2d.dtype):
        A = alphas(*splats, x, y)[0]
        T, T_N = transmittances(A, occlusion)
        image[pixels] = (A * T).T @ color[order] + T_N[:, None] * background
        transmittance[pixels] = T_N
    saved = (order, splats, color, background, occlusion)
    return (image.reshape(height, width, 3), transmittance.reshape(height, width)), saved


def backward(saved, image_bar, transmittance_bar=None):
    """Return the gradients of mean2d, conic, alpha, color and background.

    Zero where alpha is clamped, and for rows that are not visible; the order has no gradient.
    """
    order, splats, all_colors, background, occlusion = saved
    mean2d, conic, alpha, alpha_max = splats
    height, width, _ = image_bar.shape
    dtype, M, color = mean2d.dtype, len(order), all_colors[order]
    g, T_N_bar = image_bar.reshape(-1, 3), np.zeros(height * width, dtype)
    if transmittance_bar is not None:
        T_N_bar += transmittance_bar.reshape(-1)
    a, b, c = conic.T[:, :, None]
    color_bar, background_bar = np.zeros((M, 3), dtype), np.zeros(3, dtype)
    sums = np.zeros((6, M), dtype)  # over all pixels, for every Gaussian
    for pixels, x, y in pixel_blocks(height, width, M, dtype):
        A, falloff, e_x, e_y = alphas(mean2d, conic, alpha, alpha_max, x, y)
        T, T_N = transmittances(A, occlusion)
        color_bar += (A * T) @ g[pixels]
        background_bar += T_N @ g[pixels]
        V = color @ g[pixels].T  # what a pixel gains per unit of weight of Gaussian i
        if occlusion:
            # `behind` is what the pixel gains from all that lies behind layer i. In the form
            # dL / d alpha_i = T_i (V_i - behind) nothing is divided by 1 - alpha.
            behind = g[pixels] @ background + T_N_bar[pixels]
            for i in reversed(range(M)):
                V[i] -= behind
                behind += A[i] * V[i]
        V *= T * falloff
        V *= alpha[:, None] * falloff <= alpha_max  # where not clamped
        sums[0] += V.sum(axis=1)
        V *= alpha[:, None]  # from here on the gradient of log alpha_i(p)
        terms = (
            V * (a * e_x + b * e_y),
            V * (b * e_x + c * e_y),
            V * e_x**2,
            V * e_x * e_y,
            V * e_y**2,
        )
        sums[1:] += [term.sum(axis=1) for term in terms]
    N = len(all_colors)
    return {
        "mean2d": scatter(sums[1:3].T, order, N),
        "conic": scatter(sums[3:].T * np.array([-0.5, -1, -0.5], dtype), order, N),
        "alpha": scatter(sums[0], order, N),
        "color": scatter(color_bar, order, N),
        "background": background_bar,
    }


def scatter(values, order, N):
    """Return the values of the rows `order` among N rows, zero elsewhere."""
    full = np.zeros((N, *values.shape[1:]), values.dtype)
    full[order] = values
    return full


def depth_order(depth, visible, occlusion):
    """Return the visible rows from front to back; equal depths stay in the order of their index.

    Without occlusion the order changes nothing, so nothing is sorted.
    """
    rows = np.flatnonzero(visible)
    return rows[np.argsort(depth[rows], kind="stable")] if occlusion else rows


def pixel_blocks(height, width, n, dtype):
    """Yield runs of pixels, row by row, and their coordinates; a run times n fits into BLOCK."""
    size = max(1, BLOCK // max(n, 1))
    for start in range(0, height * width, size):
        index = np.arange(start, min(start + size, height * width))
        x, y = (index % width).astype(dtype), (index // width).astype(dtype)
        yield slice(start, start + len(index)), x, y


def alphas(mean2d, conic, alpha, alpha_max, x, y):
    """Return clamped opacities of M Gaussians at P pixels [M, P], falloff, offsets from means."""
    e_x, e_y = x - mean2d[:, :1], y - mean2d[:, 1:]
    a, b, c = conic.T[:, :, None]
    power = -0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y
    falloff = np.exp(np.minimum(power, 0))  # above 0 only by rounding, far along a needle
    return np.minimum(alpha[:, None] * falloff, alpha_max), falloff, e_x, e_y


def transmittances(A, occlusion):
    """Return the light that reaches each Gaussian [M, P], and what passes the last one [P]."""
    before, T = np.ones_like(A), np.ones_like(A, shape=A.shape[1:])
    if occlusion:
        for i, alpha in enumerate(A):
            before[i] = T
            T *= 1 - alpha
    return before, T
