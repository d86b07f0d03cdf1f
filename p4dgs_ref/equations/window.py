"""The Gaussian window of SSIM (Q13), applied to a stack of images as a few matrix products."""

from typing import NamedTuple

import numpy as np

RADIUS, SIGMA = 5, 1.5  # 11 x 11 pixels
BLOCK = 16  # rows that one product blurs: short enough to skip most of the band's zeros; time only

_tap = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
# Row i of a block weighs the input rows i ... i + 2 RADIUS, counted from RADIUS before the block.
WINDOW = np.array([np.pad(_tap / _tap.sum(), (i, BLOCK - 1 - i)) for i in range(BLOCK)])


class Moments(NamedTuple):
    """What SSIM needs of the truth; constant per view, so a trainer may keep it.  Arrays are (H, C, W) float64."""

    y: np.ndarray
    mu: np.ndarray
    var: np.ndarray


def to_rows(image):
    """(H, W, C) to (H, C, W), at least float64: columns last, so that both directions of a blur are plain matrix products."""
    return np.ascontiguousarray(image.transpose(0, 2, 1), dtype=np.result_type(image, np.float64))


def blur(a):
    """Average a (H, ..., W) float64 over the window, with zeros around the image.  Symmetric: its own adjoint."""
    H, W = a.shape[0], a.shape[-1]
    down, across = np.empty_like(a, order="C"), np.empty_like(a, order="C")
    for start, stop, reach, window in blocks(H):
        np.matmul(window, a.reshape(H, -1)[reach], out=down.reshape(H, -1)[start:stop])
    for start, stop, reach, window in blocks(W):
        np.matmul(down.reshape(-1, W)[:, reach], window.T, out=across.reshape(-1, W)[:, start:stop])
    return across


def blocks(n):
    """Cut n rows into blocks: start, stop, the rows that a block draws on, and their weights."""
    for start in range(0, n, BLOCK):
        stop, low, high = (
            min(start + BLOCK, n),
            max(start - RADIUS, 0),
            min(start + BLOCK + RADIUS, n),
        )
        yield (
            start,
            stop,
            slice(low, high),
            WINDOW[: stop - start, low - start + RADIUS : high - start + RADIUS],
        )


def moments(truth):
    """Local mean and variance of the truth, for `ssim`."""
    y = to_rows(truth)
    mu, square = blur(np.stack([y, y * y], axis=1)).swapaxes(0, 1)
    return Moments(y, mu, square - mu * mu)
