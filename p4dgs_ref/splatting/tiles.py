"""Which Gaussians touch which tile of the image: lists in order of depth for the fast renderer."""

from typing import NamedTuple

import numpy as np

from .compositing import depth_order

# Pairs of a Gaussian and a tile in one list: 2 GB, with gradients in tiles of 8 pixels up to 6 GB.
MAX_PAIRS = 2**23


class Lists(NamedTuple):
    """M pairs of a Gaussian and a tile, tile by tile, and front to back within a tile."""

    tile: np.ndarray  # [M] number of the tile, counted row by row
    splat: np.ndarray  # [M] index of the Gaussian
    columns: int  # tiles across the image
    rows: int  # tiles down the image


def bin_splats(
    mean2d, cov2d, conic, alpha, depth, visible, width, height, settings, occlusion=True
):
    """List the pairs that `settings.footprint` asks for.

    "ellipse" lists a pair exactly if alpha reaches `settings.cut` at some point of the tile,
    "box" every tile that meets the square of side 2 ceil(3 sigma), "all" every tile. Without
    occlusion the Gaussians of a tile are listed in the order of their index. Returns None, before
    the pairs take memory, if there are more than MAX_PAIRS and the image can be cut between two
    rows of tiles.
    """
    side = settings.tile
    columns, rows = -(-width // side), -(-height // side)
    order = depth_order(depth, listable(alpha, visible, settings), occlusion)
    mean, conic, alpha = mean2d[order], conic[order], alpha[order]
    low, high = pixel_bounds(mean, cov2d[order], alpha, width, height, settings)
    # first tile, and the first one beyond: an empty range where the Gaussian is off the image
    ends = np.floor(np.stack([low, high + side]) / side)
    first, beyond = np.clip(ends, 0, (columns, rows)).astype(np.int64)
    extent = np.maximum(beyond - first, 0) * (low <= high).all(axis=1, keepdims=True)
    count = extent[:, 0] * extent[:, 1]
    if count.sum() > MAX_PAIRS and rows > 1:
        return None
    rank, tile_y = runs(first[:, 1], extent[:, 1])  # every row of tiles of every Gaussian
    at, tile_x = runs(first[rank, 0], extent[rank, 0])  # every tile of these rows
    rank, tile_y = rank[at], tile_y[at]  # rank is the place in depth order
    bits = max(1, len(order).bit_length())  # one sort of packed keys: tile first, then depth
    key = (tile_y * columns + tile_x) << bits | rank
    if settings.footprint == "ellipse":
        corner = tile_x * side, tile_y * side
        form = nearest_form(mean.take(rank, axis=0), conic.take(rank, axis=0), *corner, side - 1)
        key = key[form <= largest_form(alpha, settings)[rank]]
    key.sort()
    return Lists(key >> bits, order[key & ((1 << bits) - 1)], columns, rows)


def listable(alpha, visible, settings):
    """Return which Gaussians [N] are evaluated at all: an ellipse needs an alpha above the cut."""
    return visible & (alpha > settings.cut) if settings.footprint == "ellipse" else visible


def pixel_bounds(mean, cov, alpha, width, height, settings):
    """Return the first and last pixel [N, 2] (x, y) of the rectangle in which a Gaussian is drawn.

    It may reach beyond the image, and it is empty if the last pixel is before the first.
    """
    if settings.footprint == "ellipse":
        reach = np.sqrt(largest_form(alpha, settings)[:, None] * cov[:, ::2])
        return np.ceil(mean - reach), np.floor(mean + reach)
    if settings.footprint == "box":
        middle = (cov[:, 0] + cov[:, 2]) / 2
        spread = np.sqrt(np.maximum(0.1, middle**2 - (cov[:, 0] * cov[:, 2] - cov[:, 1] ** 2)))
        radius = np.ceil(3 * np.sqrt(middle + spread))[:, None]
        # `getRect` of the published kernel truncates both quotients; the second one is exclusive.
        side = settings.tile
        first, beyond = (mean - radius) / side, (mean + radius + side - 1) / side
        return np.trunc(first) * side, np.trunc(beyond) * side - 1
    return np.zeros_like(mean), np.full_like(mean, (width - 1, height - 1))


def largest_form(alpha, settings):
    """Return the largest quadratic form at which alpha exp(-form / 2) reaches the cut [N]."""
    return 2 * np.log(alpha / settings.cut)


def runs(first, count):
    """List count_i numbers from first_i upwards for every i; return their i, and the numbers."""
    which = np.repeat(np.arange(len(count)), count)
    return which, np.arange(len(which)) + np.repeat(first - (np.cumsum(count) - count), count)


def nearest_form(mean, conic, x_0, y_0, side):
    """Return the smallest quadratic form over each tile's rectangle of pixel centres [M].

    The form is convex: unless the mean is inside, the smallest value lies on the nearest vertical
    or the nearest horizontal edge. Along an edge the form is a parabola, clamped to the edge's
    ends.
    """
    a, b, c = conic.T
    x_low, y_low = x_0 - mean[:, 0], y_0 - mean[:, 1]
    x_high, y_high = x_low + side, y_low + side
    x, y = np.clip(0, x_low, x_high), np.clip(0, y_low, y_high)  # offsets of the nearest edges
    along_y = np.clip(-b / c * x, y_low, y_high)
    along_x = np.clip(-b / a * y, x_low, x_high)
    return np.minimum(
        a * x * x + 2 * b * x * along_y + c * along_y**2,
        a * along_x**2 + 2 * b * along_x * y + c * y * y,
    )
