"""Which Gaussians touch which tile of the image: depth-ordered lists for the fast renderer."""

from typing import NamedTuple

import numpy as np

from .compositing import depth_order

MOST_PAIRS = 2**25  # of Gaussians and tiles, before memory is taken: about 200 bytes each


class Lists(NamedTuple):
    """Gaussian-tile pairs, tile by tile, front to back within a tile."""

    tile: np.ndarray  # (K,) number of the tile, row by row
    row: np.ndarray  # (K,) row of the Gaussian in the arrays given
    columns: int  # tiles in a row of the image
    rows: int


def bin_splats(mean2d, cov2d, conic, alpha, depth, visible, width, height, settings):
    """List the pairs that `settings.footprint` asks for.

    Shapes     as in `projection` and `compositing`; N Gaussians -> Lists of K pairs
    Domain     settings.footprint "ellipse": pairs where alpha reaches settings.cut at some point of the tile, decided
               exactly; "box": every tile of the square of side 2 ceil(3 sqrt(largest eigenvalue)); "all": every tile
    Raises     ValueError where there are more than MOST_PAIRS, naming the widest Gaussian
    Reference  the box is the published kernel's rule (Kerbl et al. 2023, their rasteriser's `getRect`)
    """
    side = settings.tile
    columns, rows = -(-width // side), -(-height // side)
    if settings.footprint == "ellipse":
        visible = visible & (alpha > settings.cut)
    order = depth_order(depth, visible)
    mean, cov = mean2d[order], cov2d[order]
    if settings.footprint == "ellipse":
        tau = 2 * np.log(
            alpha[order] / settings.cut
        )  # alpha >= cut where the quadratic form <= tau
        reach = np.sqrt(tau[:, None] * cov[:, ::2])
        low, high = (
            np.ceil(mean - reach),
            np.floor(mean + reach),
        )  # first and last pixel centre inside
    elif settings.footprint == "box":
        middle = (cov[:, 0] + cov[:, 2]) / 2
        spread = np.sqrt(np.maximum(0.1, middle**2 - (cov[:, 0] * cov[:, 2] - cov[:, 1] ** 2)))
        radius = np.ceil(3 * np.sqrt(middle + spread))[:, None]
        # The kernel truncates (u + r + side - 1) / side to an exclusive tile bound: the last pixel taken is
        # one short of u + r, also where u + r is not an integer.
        low, high = np.trunc(mean - radius), np.trunc(mean + radius + side - 1) // side * side - 1
    else:
        low, high = np.zeros_like(mean), np.full_like(mean, (width - 1, height - 1))
    first = np.clip(
        low // side, 0, (columns, rows)
    )  # exclusive upper bounds: empty where off the image
    beyond = np.clip(high // side + 1, 0, (columns, rows))
    extent = np.where(
        (low <= high).all(axis=1, keepdims=True), np.maximum(beyond - first, 0), 0
    ).astype(np.int64)
    count = extent[:, 0] * extent[:, 1]
    if count.sum() > MOST_PAIRS:
        widest = int(np.argmax(count))
        raise ValueError(
            f"{count.sum()} pairs of Gaussians and tiles: expected {MOST_PAIRS} at most; Gaussian "
            f"{order[widest]} alone touches {count[widest]} of {columns * rows} tiles"
        )
    rank = np.repeat(
        np.arange(len(order)), count
    )  # ranks follow depth: they sort and they point back
    step = np.arange(len(rank)) - np.repeat(np.cumsum(count) - count, count)
    first = first.astype(np.int64)
    tile_y = step // np.maximum(extent[rank, 0], 1)
    tile_x = step - tile_y * extent[rank, 0] + first[rank, 0]
    tile_y += first[rank, 1]
    if settings.footprint == "ellipse":
        touches = (
            _nearest_form(mean[rank], conic[order][rank], tile_x * side, tile_y * side, side - 1)
            <= tau[rank]
        )
        rank, tile_x, tile_y = rank[touches], tile_x[touches], tile_y[touches]
    bits = max(1, int(len(order)).bit_length())  # one sort of packed keys: tile first, then depth
    key = np.sort((tile_y * columns + tile_x) << bits | rank)
    return Lists(key >> bits, order[key & ((1 << bits) - 1)], columns, rows)


def _nearest_form(mean, conic, x_0, y_0, side):
    """Least value of the quadratic form over each tile's rectangle of pixel centres (K,).

    The form is convex: unless the mean is inside, the least value lies on the nearest vertical or the nearest
    horizontal edge, and along an edge it is a parabola, clamped to the edge's ends.
    """
    a, b, c = conic.T
    x_low, y_low = x_0 - mean[:, 0], y_0 - mean[:, 1]
    x_high, y_high = x_low + side, y_low + side
    x, y = np.clip(0, x_low, x_high), np.clip(0, y_low, y_high)  # offset of the nearest edges
    along_y = np.clip(-b / c * x, y_low, y_high)
    along_x = np.clip(-b / a * y, x_low, x_high)
    return np.minimum(
        a * x * x + 2 * b * x * along_y + c * along_y**2,
        a * along_x**2 + 2 * b * along_x * y + c * y * y,
    )
