"""Fast compositing: lists by tile, one exp for all tiles, two array operations for each depth rank.

Inside a tile the logarithm of a splat's alpha is a polynomial of the pixel's offset (u, v) from the
tile's middle,

    log alpha = k_0 + k_1 u + k_2 v + k_3 u**2 + k_4 u v + k_5 v**2,

and the six monomials are the same for every tile. A chunk of the lists is therefore one product
with a constant matrix and one exp. A loop over depth ranks (first splat of every tile, second
splat of every tile, ...) then composites all tiles at once. In the backward pass the transposed
product returns the six moments of the gradient, from which the gradients of mean, conic and
opacity follow in closed form. The cost follows the listed pairs, not N H W.

The lists by tile are those of Kerbl et al. 2023 (3DGS), the arrangement by ranks is this project's.
`settings` says which pairs are listed and when a tile stops (Q21).

Axis letters: K ranks of a chunk, G tiles, P pixels of a tile, M listed pairs.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from .tiles import PAIR_BYTES, bin_splats, require_memory

RANKS = 32  # depth ranks that are evaluated together; 16 to 32 cost about the same
NOTHING = (-1e4, 0, 0, 0, 0, 0)  # coefficients of alpha = 0: exp(-1e4) is zero in every dtype


class Chunk(NamedTuple):
    """Up to RANKS successive splats of all tiles that still let light through."""

    tiles: np.ndarray  # [G]
    pairs: np.ndarray  # [K, G] row of the pair; M, the padding, where a tile's list has ended
    A: np.ndarray  # [K, G, P] alphas
    weights: np.ndarray  # [K, G, P] alpha T
    slope: np.ndarray | None  # [K G, P] of log alpha through its clamp; None if none is clamped


def forward(
    mean2d,  # [N, 2]  arguments as in `compositing`; mean2d, cov2d and conic in float64
    cov2d,  # [N, 3]
    conic,  # [N, 3]
    alpha,  # [N]
    color,  # [N, 3]
    depth,  # [N]
    visible,  # [N]
    background,  # [3]
    height,
    width,
    settings,
    occlusion=True,
):
    """Return image [height, width, 3], transmittance [height, width] and what `backward` needs."""
    dtype, side = np.dtype(settings.dtype), settings.tile
    lists = bin_splats(mean2d, cov2d, conic, alpha, depth, visible, width, height, settings)
    count = np.bincount(lists.tile, minlength=lists.columns * lists.rows)
    start = np.cumsum(count) - count
    coefficients, local = polynomials(mean2d, conic, alpha, lists, side, dtype)
    paint = np.concatenate([color[lists.row], np.zeros((1, 3))]).astype(dtype)
    clamps = len(local) and local[:, 2].max() > settings.alpha_max
    T = np.ones((len(count), side * side), dtype)
    image = np.zeros((len(count), side * side, 3), dtype)
    stopped = np.zeros(T.shape, bool)
    chunks, tiles, needed = [], np.flatnonzero(count), PAIR_BYTES * len(lists.row)
    for rank in range(0, int(count.max(initial=0)), RANKS):
        tiles = tiles[count[tiles] > rank]
        if settings.stop and occlusion and rank:
            tiles = tiles[T[tiles].max(axis=1) >= settings.stop]
        if not len(tiles):
            break
        ranks = np.arange(rank, min(rank + RANKS, count[tiles].max()))[:, None]
        pairs = np.where(ranks < count[tiles], start[tiles] + ranks, len(lists.row))
        # A and weights are kept for the backward pass, which needs at most as much again.
        needed += 4 * pairs.size * side**2 * dtype.itemsize
        require_memory(needed, f"{len(lists.row)} pairs of Gaussians and tiles")
        A, slope = alphas(coefficients[pairs.ravel()], settings, clamps)
        A = weights = A.reshape(*pairs.shape, -1)
        if occlusion:
            weights, T[tiles] = front_to_back(A, T[tiles], settings, stopped, tiles)
        image[tiles] += weights.transpose(1, 2, 0) @ paint[pairs].transpose(1, 0, 2)
        chunks.append(Chunk(tiles, pairs, A, weights, slope))
    if background.any():  # black adds nothing
        image = image + T[:, :, None] * background.astype(dtype)
    saved = (chunks, lists, local, T, paint, conic, background, occlusion, settings)
    return tuple(to_image(a, lists, side)[:height, :width] for a in (image, T)), saved


def backward(saved, image_bar):
    """Gradients of mean2d, conic, alpha, color and background.

    Pairs that are not listed, or lie behind an opaque tile, contribute nothing.
    """
    chunks, lists, local, T, paint, conic, background, occlusion, settings = saved
    g = to_tiles(np.asarray(image_bar, settings.dtype), lists, settings.tile)
    behind = np.zeros(g.shape[:2], g.dtype)
    if occlusion and background.any():
        behind = g @ background.astype(settings.dtype)
    basis = monomials(settings.tile, settings.dtype).T
    moments = np.zeros((len(paint), 6), settings.dtype)  # the last row collects the padding
    paint_bar = np.zeros((len(paint), 3), settings.dtype)
    for tiles, pairs, A, weights, slope in reversed(chunks):
        g_tiles, rows = g[tiles], pairs.ravel()
        painted = weights.transpose(1, 0, 2) @ g_tiles
        paint_bar[rows] = painted.transpose(1, 0, 2).reshape(-1, 3)
        V = np.empty_like(A)  # what a pixel gains per unit of a splat's weight
        colors = paint[pairs].transpose(1, 0, 2)
        np.matmul(colors, g_tiles.transpose(0, 2, 1), out=V.transpose(1, 0, 2))
        if occlusion:
            seen = behind[tiles]  # the value seen through rank j; nothing is divided by 1 - alpha
            for j in reversed(range(len(A))):
                V[j] -= seen
                seen += A[j] * V[j]
            behind[tiles] = seen
        V *= weights  # gradient of log alpha
        if slope is not None:
            V *= slope.reshape(V.shape)
        moments[rows] = V.reshape(-1, V.shape[2]) @ basis
    per_pair = [*from_moments(moments[:-1], local, conic[lists.row]), *paint_bar[:-1].T]
    per_pair = np.stack(per_pair, axis=1, dtype=float)
    M = len(lists.row)
    members = csr_array((np.ones(M), lists.row, np.arange(M + 1)), shape=(M, len(conic)))
    total = members.T @ per_pair  # all pairs of a Gaussian
    return {
        "mean2d": total[:, :2],
        "conic": total[:, 2:5],
        "alpha": total[:, 5],
        "color": total[:, 6:],
        "background": np.einsum("gp,gpc->c", T, g) if occlusion else g.sum(axis=(0, 1)),
    }


def polynomials(mean2d, conic, alpha, lists, side, dtype):
    """The six coefficients of every pair [M + 1, 6], the last row padding, and what backward needs.

    The latter is [M, 3]: the offset e_x, e_y of the tile's middle from the splat's mean, and
    opacity.
    """
    tile_xy = np.stack([lists.tile % lists.columns, lists.tile // lists.columns], axis=1)
    e_x, e_y = (tile_xy * side + (side - 1) / 2 - mean2d[lists.row]).T
    a, b, c = conic[lists.row].T
    opacity = alpha[lists.row]
    g_x, g_y = a * e_x + b * e_y, b * e_x + c * e_y
    some = opacity > 0  # log 0 is -inf and would be NaN in the product
    constant = np.log(np.where(some, opacity, 1)) - (e_x * g_x + e_y * g_y) / 2
    coefficients = np.empty((len(e_x) + 1, 6), dtype)
    coefficients[:-1] = np.stack([constant, -g_x, -g_y, -a / 2, -b, -c / 2], axis=1)
    coefficients[:-1][~some] = NOTHING
    coefficients[-1] = NOTHING
    return coefficients, np.stack([e_x, e_y, opacity], axis=1)


@lru_cache(maxsize=8)
def monomials(side, dtype):
    """The matrix [6, P] of 1, u, v, u**2, u v, v**2 at a tile's pixels."""
    offset = np.arange(side) - (side - 1) / 2
    v, u = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]).astype(dtype)


def alphas(coefficients, settings, clamps):
    """Alphas [K G, P] of a chunk and, if any can be clamped, the slope of the clamp.

    The published kernel differentiates as if there were no clamp. Above it, the slope of log alpha
    is then alpha / alpha_max.
    """
    A = coefficients @ monomials(settings.tile, settings.dtype)
    np.exp(A, out=A)
    slope = None
    if clamps:
        slope = A <= settings.alpha_max
        if settings.clamp_passes_gradient:
            slope = np.maximum(A / settings.alpha_max, 1)
        np.minimum(A, settings.alpha_max, out=A)
    if settings.mask:
        A[A < settings.mask] = 0
    return A, slope


def front_to_back(A, T, settings, stopped, tiles):
    """Weights alpha T [K, G, P] of a chunk and the transmittance behind it [G, P].

    With `stop_by_pixel`, the splat that would pass the stop and all splats behind it are cut from
    A, and `stopped` remembers the pixels.
    """
    weights = np.empty_like(A)
    now = stopped[tiles]
    for j in range(len(A)):
        np.multiply(T, A[j], out=weights[j])
        if settings.stop_by_pixel:
            now |= T - weights[j] < settings.stop
            A[j][now] = 0
            weights[j][now] = 0
        T = np.subtract(T, weights[j])
    stopped[tiles] = now
    return weights, T


def from_moments(moments, local, conic):
    """Gradients of mean2d (2), conic (3) and alpha of every pair, from its six moments."""
    m_0, m_u, m_v, m_uu, m_uv, m_vv = moments.T.astype(float)
    e_x, e_y, opacity = local.T
    a, b, c = conic.T
    m_x, m_y = m_u + e_x * m_0, m_v + e_y * m_0  # about the splat's mean, not the tile's middle
    return (
        a * m_x + b * m_y,
        b * m_x + c * m_y,
        -0.5 * (m_uu + e_x * (m_u + m_x)),
        -(m_uv + e_x * m_v + e_y * m_x),
        -0.5 * (m_vv + e_y * (m_v + m_y)),
        m_0 / np.where(opacity == 0, 1, opacity),
    )


def to_image(tiles, lists, side):
    """Put tiles [G, P, ...] together to the image that all tiles cover."""
    grid = tiles.reshape(lists.rows, lists.columns, side, side, *tiles.shape[2:]).swapaxes(1, 2)
    return grid.reshape(lists.rows * side, lists.columns * side, *tiles.shape[2:])


def to_tiles(image, lists, side):
    """Cut an image [H, W, 3] into tiles [G, P, 3], with zeros beyond its edge."""
    height, width, _ = image.shape
    padded = np.zeros((lists.rows * side, lists.columns * side, 3), image.dtype)
    padded[:height, :width] = image
    grid = padded.reshape(lists.rows, side, lists.columns, side, 3)
    return grid.swapaxes(1, 2).reshape(-1, side * side, 3)
