"""The readable twin of the renderer: one Gaussian after the other, front to back, on its rectangle of pixels.

Read this file first; `compositing` does the same for all Gaussians at all pixels, `fast` for lists by tile.
"""

import numpy as np

from .compositing import Out, depth_order


def rectangle(mean, cov, alpha, width, height, settings):
    """Pixel rows and columns (two slices) on which a Gaussian is evaluated under `settings.footprint`."""
    if settings.footprint == "all":
        return slice(0, height), slice(0, width)
    if settings.footprint == "ellipse":  # alpha exp(-form / 2) >= cut, as a bounding box
        if alpha <= settings.cut:
            return slice(0, 0), slice(0, 0)
        reach = np.sqrt(2 * np.log(alpha / settings.cut) * cov[::2])
        low, high = np.ceil(mean - reach), np.floor(mean + reach) + 1
    else:  # whole tiles that meet the 3-sigma square
        half = (cov[0] + cov[2]) / 2
        largest = half + np.sqrt(max(0.1, half**2 - (cov[0] * cov[2] - cov[1] ** 2)))
        radius, side = np.ceil(3 * np.sqrt(largest)), settings.tile
        low, high = (
            np.trunc((mean - radius) / side) * side,
            np.trunc((mean + radius + side - 1) / side) * side,
        )
    (x_0, y_0), (x_1, y_1) = (np.clip(edge, 0, (width, height)).astype(int) for edge in (low, high))
    return slice(y_0, max(y_0, y_1)), slice(x_0, max(x_0, x_1))


def forward(
    mean2d, cov2d, conic, alpha, color, depth, visible, background, height, width, settings
):
    """Composite splats; arguments and outputs as in `fast.forward` with occlusion, tile stop not used."""
    image, T = np.zeros((height, width, 3)), np.ones((height, width))
    done, drawn = np.zeros((height, width), bool), []
    for i in depth_order(depth, visible):
        rows, columns = rectangle(mean2d[i], cov2d[i], alpha[i], width, height, settings)
        y, x = np.mgrid[rows, columns]
        e_x, e_y = x - mean2d[i, 0], y - mean2d[i, 1]
        a, b, c = conic[i]
        falloff = np.exp(-0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y)
        A = np.minimum(alpha[i] * falloff, settings.alpha_max)
        A[A < settings.mask] = 0
        if settings.stop_by_pixel:
            done[rows, columns] |= T[rows, columns] * (1 - A) < settings.stop
            A[done[rows, columns]] = 0
        before = T[rows, columns].copy()
        image[rows, columns] += (before * A)[:, :, None] * color[i]
        T[rows, columns] *= 1 - A
        drawn.append((i, rows, columns, e_x, e_y, falloff, A, before))
    inputs = dict(conic=conic, alpha=alpha, color=color, background=background, settings=settings)
    return Out(image + T[:, :, None] * background, T), (drawn, inputs)


def backward(res, image_bar):
    """Gradients of mean2d, conic, alpha, color and background, back to front."""
    drawn, inputs = res
    conic, alpha, settings = inputs["conic"], inputs["alpha"], inputs["settings"]
    bars = {
        "mean2d": np.zeros((len(alpha), 2)),
        "conic": np.zeros((len(alpha), 3)),
        "alpha": np.zeros(len(alpha)),
        "color": np.zeros((len(alpha), 3)),
    }
    behind = image_bar @ inputs["background"]  # value of what each pixel sees behind the Gaussian
    for i, rows, columns, e_x, e_y, falloff, A, before in reversed(drawn):
        g = image_bar[rows, columns]
        bars["color"][i] = ((before * A)[:, :, None] * g).sum(axis=(0, 1))
        gain = g @ inputs["color"][i] - behind[rows, columns]
        behind[rows, columns] += A * gain
        V = before * gain * falloff * (A > 0)
        if not settings.clamp_passes_gradient:
            V *= alpha[i] * falloff <= settings.alpha_max
        bars["alpha"][i] = V.sum()
        V *= alpha[i]
        a, b, c = conic[i]
        bars["mean2d"][i] = (V * (a * e_x + b * e_y)).sum(), (V * (b * e_x + c * e_y)).sum()
        bars["conic"][i] = -(V * e_x**2).sum() / 2, -(V * e_x * e_y).sum(), -(V * e_y**2).sum() / 2
    T = np.ones(image_bar.shape[:2])
    for _, rows, columns, *_, A, _ in drawn:
        T[rows, columns] *= 1 - A
    return {**bars, "background": (T[:, :, None] * image_bar).sum(axis=(0, 1))}
