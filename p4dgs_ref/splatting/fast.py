r"""Fast compositing: tile lists, one exp for all tiles, and two array operations per depth rank.

Inside a tile the logarithm of a splat's alpha is a polynomial of the pixel's offset (u, v) to the tile's middle,

.. math:: \log\alpha = k_0 + k_1 u + k_2 v + k_3 u^2 + k_4 uv + k_5 v^2,

and the six monomials are the same for every tile: a chunk of lists becomes one product with a constant
matrix, one exp, and then a loop over depth ranks whose body works on all tiles at once.  The backward of that
product returns the six moments of the gradient, from which mean, conic and opacity follow in closed form.
The cost follows the listed pairs, not N H W.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from .compositing import Out
from .tiles import bin_splats

RANKS = 32  # depth ranks that are evaluated together; 16 to 32 cost about the same
NOTHING = (
    -1e4,
    0,
    0,
    0,
    0,
    0,
)  # coefficients of a pair with alpha 0: exp(-1e4) is zero in every dtype


class Chunk(NamedTuple):
    tiles: (
        np.ndarray
    )  # (G,)  tiles that still have a splat at this rank and still let light through
    pairs: np.ndarray  # (K, G) row of the pair, or the padding row
    A: np.ndarray  # (K, G, P) alphas
    w: np.ndarray  # (K, G, P) weights alpha T
    slope: object  # (K G, P) d log(clamped alpha) / d log alpha; None where nothing is clamped


class Res(NamedTuple):
    chunks: list
    lists: object  # tiles.Lists
    local: (
        np.ndarray
    )  # (M, 3) per pair: log alpha's offset to the tile's middle (e_x, e_y), and opacity
    T: np.ndarray  # (G, P) behind the last splat
    inputs: dict
    settings: object


@lru_cache(maxsize=8)
def monomials(side, dtype):
    """The matrix (6, P) of 1, u, v, u^2, uv, v^2 at a tile's pixels, offsets from the tile's middle."""
    offset = np.arange(side) - (side - 1) / 2
    v, u = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]).astype(dtype)


def forward(
    mean2d,
    cov2d,
    conic,
    alpha,
    color,
    depth,
    visible,
    background,
    height,
    width,
    settings,
    occlusion=True,
):
    """Composite splats over a background, to the accuracy that `settings` names.

    Shapes     as in `compositing`, and cov2d (N, 3) -> image (height, width, 3), transmittance (height, width)
    Units      as in `compositing`
    Domain     as in `compositing`; mean2d, cov2d, conic in float64, whatever settings.dtype is
    Raises     nothing
    Gradient   as in `compositing`; pairs that are not listed or lie behind an opaque tile contribute nothing
    Choice     Q21: footprint, cut, mask and stop come from `settings`; `fast` cuts lists without a pixel mask
    Reference  Kerbl et al. 2023 for lists by tile; the arrangement by ranks is this project's
    """
    dtype, side = np.dtype(settings.dtype), settings.tile
    lists = bin_splats(mean2d, cov2d, conic, alpha, depth, visible, width, height, settings)
    count = np.bincount(lists.tile, minlength=lists.columns * lists.rows)
    start = np.cumsum(count) - count
    coefficients, local = _coefficients(mean2d, conic, alpha, lists, side, dtype)
    paint = np.concatenate([color[lists.row], np.zeros((1, 3))]).astype(dtype)
    T = np.ones((len(count), side * side), dtype)
    C = np.zeros((len(count), side * side, 3), dtype)
    clamps = len(local) and local[:, 2].max() > settings.alpha_max
    done = np.zeros(T.shape, bool) if settings.stop_by_pixel else None
    chunks, tiles = [], np.flatnonzero(count)
    for rank in range(0, int(count.max(initial=0)), RANKS):
        tiles = tiles[count[tiles] > rank]
        if settings.stop and occlusion and rank:
            tiles = tiles[T[tiles].max(axis=1) >= settings.stop]
        if not len(tiles):
            break
        ranks = np.arange(rank, min(rank + RANKS, count[tiles].max()))[:, None]
        pairs = np.where(ranks < count[tiles], start[tiles] + ranks, len(lists.row))
        A, slope = _alphas(coefficients[pairs.ravel()], settings, clamps)
        A = A.reshape(*pairs.shape, -1)
        w, T[tiles] = _weights(A, T[tiles], settings, done, tiles) if occlusion else (A, T[tiles])
        C[tiles] += w.transpose(1, 2, 0) @ paint[pairs].transpose(1, 0, 2)
        chunks.append(Chunk(tiles, pairs, A, w, slope))
    image = (
        C + T[:, :, None] * background.astype(dtype) if background.any() else C
    )  # black adds nothing
    inputs = dict(
        conic=conic,
        paint=paint,
        background=background,
        size=(height, width),
        n=len(mean2d),
        occlusion=occlusion,
    )
    return (
        Out(_to_image(image, lists, side, height, width), _to_image(T, lists, side, height, width)),
        Res(chunks, lists, local, T, inputs, settings),
    )


def _coefficients(mean2d, conic, alpha, lists, side, dtype):
    """The six coefficients of every pair (M + 1, 6), the last row padding with alpha 0, and what backward needs."""
    middle = (
        np.stack([lists.tile % lists.columns, lists.tile // lists.columns], axis=1) * side
        + (side - 1) / 2
    )
    e_x, e_y = (middle - mean2d[lists.row]).T
    a, b, c = conic[lists.row].T
    opacity = alpha[lists.row]
    g_x, g_y = a * e_x + b * e_y, b * e_x + c * e_y
    some = opacity > 0  # log 0 = -inf would be nan in the product
    constant = np.log(np.where(some, opacity, 1)) - (e_x * g_x + e_y * g_y) / 2
    coefficients = np.empty((len(e_x) + 1, 6), dtype)
    coefficients[:-1] = np.stack([constant, -g_x, -g_y, -a / 2, -b, -c / 2], axis=1)
    coefficients[:-1][~some] = NOTHING
    coefficients[-1] = NOTHING
    return coefficients, np.stack([e_x, e_y, opacity], axis=1)


def _alphas(coefficients, settings, clamps):
    """Alphas (K G, P) of a chunk and, where any is clamped, the slope of the clamp.

    The published kernel differentiates as if there were no clamp: then log alpha's slope is alpha / alpha_max above it.
    """
    A = coefficients @ monomials(settings.tile, settings.dtype)
    np.exp(A, out=A)
    slope = None
    if clamps:
        passes = settings.clamp_passes_gradient
        slope = np.maximum(A / settings.alpha_max, 1) if passes else A <= settings.alpha_max
        np.minimum(A, settings.alpha_max, out=A)
    if settings.mask:
        A[A < settings.mask] = 0
    return A, slope


def _weights(A, T, settings, done, tiles):
    """Weights alpha T front to back (K, G, P) and the transmittance behind the chunk (G, P); A is cut in place."""
    w = np.empty_like(A)
    stopped = done[tiles] if settings.stop_by_pixel else None
    for j in range(len(A)):
        np.multiply(T, A[j], out=w[j])
        if settings.stop_by_pixel:  # the splat that would pass the stop is left out, and
            stopped |= T - w[j] < settings.stop  # so is everything behind it
            A[j][stopped] = 0
            w[j][stopped] = 0
        T = np.subtract(T, w[j])
    if settings.stop_by_pixel:
        done[tiles] = stopped
    return w, T


def _to_image(tiles, lists, side, height, width):
    """Put tiles (G, P[, C]) back into an image (H, W[, C])."""
    grid = tiles.reshape(lists.rows, lists.columns, side, side, *tiles.shape[2:]).swapaxes(1, 2)
    return grid.reshape(lists.rows * side, lists.columns * side, *tiles.shape[2:])[:height, :width]


def _to_tiles(image, lists, side):
    """Cut an image (H, W, 3) into tiles (G, P, 3), zeros beyond its edge."""
    height, width = image.shape[:2]
    padded = np.zeros((lists.rows * side, lists.columns * side, 3), image.dtype)
    padded[:height, :width] = image
    return (
        padded.reshape(lists.rows, side, lists.columns, side, 3)
        .swapaxes(1, 2)
        .reshape(-1, side * side, 3)
    )


def backward(res, image_bar):
    """Gradients of mean2d, conic, alpha, color (zeros for Gaussians that are in no list) and background."""
    settings, lists, inputs = res.settings, res.lists, res.inputs
    g = _to_tiles(np.asarray(image_bar, settings.dtype), lists, settings.tile)
    behind = np.zeros(g.shape[:2], g.dtype) if inputs["occlusion"] else None
    if inputs["occlusion"] and inputs["background"].any():
        behind = g @ inputs["background"].astype(settings.dtype)
    basis = monomials(settings.tile, settings.dtype).T
    moments = np.zeros(
        (len(inputs["paint"]), 9), settings.dtype
    )  # per pair; the last row collects the padding
    for tiles, pairs, A, w, slope in reversed(res.chunks):
        g_tiles = g[tiles]
        moments[pairs.ravel(), 6:] = (
            (w.transpose(1, 0, 2) @ g_tiles).transpose(1, 0, 2).reshape(-1, 3)
        )
        V = np.empty_like(A)  # what a pixel gains per unit of a splat's weight
        np.matmul(
            inputs["paint"][pairs].transpose(1, 0, 2),
            g_tiles.transpose(0, 2, 1),
            out=V.transpose(1, 0, 2),
        )
        if inputs["occlusion"]:
            seen = behind[tiles]  # value seen through rank j: no division by 1 - alpha
            for j in range(len(A) - 1, -1, -1):
                V[j] -= seen
                seen += A[j] * V[j]
            behind[tiles] = seen
        V *= w  # gradient of log alpha
        if slope is not None:
            V *= slope.reshape(V.shape)
        moments[pairs.ravel(), :6] = V.reshape(-1, V.shape[2]) @ basis
    background_bar = np.einsum("gp,gpc->c", res.T, g) if inputs["occlusion"] else g.sum(axis=(0, 1))
    return {**_to_gaussians(moments[:-1].astype(float), res), "background": background_bar}


def _to_gaussians(moments, res):
    """From the moments of every pair to the gradients of every Gaussian: closed form, then one sparse product."""
    (m_0, m_u, m_v, m_uu, m_uv, m_vv), (e_x, e_y, opacity) = moments[:, :6].T, res.local.T
    a, b, c = res.inputs["conic"][res.lists.row].T
    m_x, m_y = (
        m_u + e_x * m_0,
        m_v + e_y * m_0,
    )  # moments about the splat's mean instead of the tile's
    per = np.concatenate(
        [
            np.stack(
                [
                    a * m_x + b * m_y,
                    b * m_x + c * m_y,
                    -0.5 * (m_uu + e_x * (m_u + m_x)),
                    -(m_uv + e_x * m_v + e_y * m_x),
                    -0.5 * (m_vv + e_y * (m_v + m_y)),
                    m_0 / np.where(opacity == 0, 1, opacity),
                ],
                axis=1,
            ),
            moments[:, 6:],
        ],
        axis=1,
    )
    row, pairs = res.lists.row, len(res.lists.row)
    total = (
        csr_array((np.ones(pairs), row, np.arange(pairs + 1)), shape=(pairs, res.inputs["n"])).T
        @ per
    )
    return {
        "mean2d": total[:, :2],
        "conic": total[:, 2:5],
        "alpha": total[:, 5],
        "color": total[:, 6:],
    }
