"""The Gaussian window of SSIM (Q13): local averages of an image as a few matrix products."""

import numpy as np

RADIUS, SIGMA = 5, 1.5  # 11 x 11 pixels
BLOCK = 16  # rows averaged by one product; a short block skips most of the band's zeros (time only)

_tap = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
# Row i of a block weighs the input rows i ... i + 2 RADIUS, counted from RADIUS before the block.
WINDOW = np.array([np.pad(_tap / _tap.sum(), (i, BLOCK - 1 - i)) for i in range(BLOCK)])


def to_rows(image):
    """Transpose [H, W, C] to [H, C, W], at least float64.

    With the columns last, averaging is a matrix product in both directions.
    """
    return np.ascontiguousarray(image.transpose(0, 2, 1), dtype=np.result_type(image, np.float64))


def blur(a):
    """Average a [H, ..., W] over the window, with zeros around the image.

    The window is symmetric, so that this function is its own adjoint.
    """
    H, W = a.shape[0], a.shape[-1]
    down, across = np.empty_like(a, order="C"), np.empty_like(a, order="C")
    for block, reach, window in blocks(H):
        np.matmul(window, a.reshape(H, -1)[reach], out=down.reshape(H, -1)[block])
    for block, reach, window in blocks(W):
        np.matmul(down.reshape(-1, W)[:, reach], window.T, out=across.reshape(-1, W)[:, block])
    return across


def blocks(n):
    """Yield every block of n rows, the rows that are averaged for it, and their weights."""
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        low, high = max(start - RADIUS, 0), min(start + BLOCK + RADIUS, n)
        window = WINDOW[: stop - start, low - start + RADIUS : high - start + RADIUS]
        yield slice(start, stop), slice(low, high), window
