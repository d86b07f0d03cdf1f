"""Fast compositing: lists by tile, one exp for many tiles, two array operations per depth rank.

Inside a tile the logarithm of a splat's alpha is a polynomial of the pixel's offset (u, v) from the
tile's middle,

    log alpha = k_0 + k_1 u + k_2 v + k_3 u**2 + k_4 u v + k_5 v**2,

and the six monomials are the same for every tile. The alphas of several splats in many tiles are
therefore one product with a constant matrix and one exp. A loop over depth ranks (first splat of
every tile, second splat of every tile, ...) then composites these tiles at once. In the backward
pass the transposed product returns the six moments of the gradient, from which the gradients of
mean, conic and opacity follow in closed form.

The time is proportional to the number of listed pairs, not to N H W. Tiles are taken in groups.
Without gradients, only one group's alphas are in memory. With gradients, the alphas of all groups
are kept, and their weights only if there is a single group.

The lists by tile are those of Kerbl et al. 2023 (3DGS); the arrangement by ranks is this project's.
`settings` says which pairs are listed and when a tile stops (Q21).

Axis letters: K ranks of a chunk, G tiles, P pixels of a tile, M listed pairs.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .tiles import bin_splats

RANKS = 32  # depth ranks that are evaluated together; 16 to 32 cost about the same
GROUP = 2**14  # pixels of the tiles that are evaluated together
CACHED = 2**16  # alphas that are composited as soon as they are computed, while in the cache
PIECE = 2**14  # pairs whose gradients are computed together, which bounds the memory
LOG_OF_ZERO = -1e4  # stands for the logarithm of an opacity of 0: its exp is 0 in every dtype


class Halves(NamedTuple):
    """An image with too many pairs for one list: `backward` draws its two halves again."""

    cut: int  # the first row of pixels of the lower half
    inputs: list  # the arguments of `forward` for each half


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
    keep=True,  # False: no gradients are wanted
):
    """Return image [height, width, 3], transmittance [height, width] and what `backward` needs.

    With `keep=False` the last is None, and a chunk is forgotten as soon as it is composited. An
    image with more than MAX_PAIRS is drawn in two halves, one after the other, and these likewise,
    down to single rows of tiles.
    """
    dtype, side = np.dtype(settings.dtype), settings.tile
    lists = bin_splats(
        mean2d, cov2d, conic, alpha, depth, visible, width, height, settings, occlusion
    )
    if lists is None:
        others, cut = (cov2d, conic, alpha, color, depth, visible, background), height // side // 2
        cut = max(cut, 1) * side
        inputs = [
            (mean2d - (0, top), *others, rows, width, settings, occlusion)
            for top, rows in ((0, cut), (cut, height - cut))
        ]
        pictures = zip(*(forward(*half, keep=False)[0] for half in inputs))
        return tuple(map(np.concatenate, pictures)), Halves(cut, inputs) if keep else None
    count = np.bincount(lists.tile, minlength=lists.columns * lists.rows)
    start, M = np.cumsum(count) - count, len(lists.splat)
    splats = columns_of(mean2d, conic, alpha)
    coefficients = polynomials(at_pairs(splats, lists, side), dtype)
    pair_colors = np.concatenate([color[lists.splat], np.zeros((1, 3))]).astype(dtype)
    clamps = alpha.max(initial=0) > settings.alpha_max
    T = np.ones((len(count), side * side), dtype)
    image = np.zeros((len(count), 3, side * side), dtype)
    stopped = np.zeros(T.shape, bool)
    # A chunk: up to RANKS successive splats of those tiles of a group that still let light through.
    chunks, groups = [], groups_of_tiles(count, side)
    for tiles in groups:
        for rank in range(0, int(count[tiles[0]]), RANKS):
            tiles = tiles[count[tiles] > rank]
            if settings.stop and occlusion and rank:
                tiles = tiles[T[tiles].max(axis=1) >= settings.stop]
            if not len(tiles):
                break
            ranks = np.arange(rank, min(rank + RANKS, count[tiles].max()))[:, None]
            # [K, G] the row of every pair; M, the padding, where a tile's list has ended
            pairs = np.where(ranks < count[tiles], start[tiles] + ranks, M)
            before, light, dark = T[tiles], T[tiles], stopped[tiles]
            A, weights, clamped = composite(
                coefficients.take(pairs, axis=0), light, dark, settings, occlusion, clamps, keep
            )
            T[tiles], stopped[tiles] = light, dark
            colors = pair_colors.take(pairs, axis=0).transpose(1, 2, 0)
            image[tiles] += colors @ weights.transpose(1, 0, 2)
            if keep:
                # Weights take half of the memory: for large images backward recomputes them.
                kept = weights if len(groups) == 1 or not occlusion else None
                chunks.append((tiles, pairs, A, kept, before, clamped))
    if background.any():  # black adds nothing
        image += T[:, None] * background.astype(dtype)[:, None]
    saved = (chunks, T, background, occlusion, lists, splats, pair_colors, settings)
    image, transmittance = (to_image(a, lists, side)[:height, :width] for a in (image, T[:, None]))
    return (image, transmittance[:, :, 0]), saved if keep else None


def backward(saved, image_bar):
    """Return the gradients of mean2d, conic, alpha, color and background.

    Pairs that are not listed, or lie behind an opaque tile, contribute nothing.
    """
    if isinstance(saved, Halves):
        parts = zip(saved.inputs, np.split(image_bar, [saved.cut]))
        upper, lower = (backward(forward(*half)[1], half_bar) for half, half_bar in parts)
        return {name: bar + lower[name] for name, bar in upper.items()}
    chunks, T, background, occlusion, lists, splats, pair_colors, settings = saved
    g = to_tiles(np.asarray(image_bar, settings.dtype), lists, settings.tile)
    behind = np.zeros_like(T)
    if occlusion and background.any():
        behind = background.astype(settings.dtype) @ g
    basis = monomials(settings.tile, settings.dtype).T
    per_pair = np.zeros((len(pair_colors), 9), settings.dtype)  # the last row collects the padding
    for tiles, pairs, A, weights, before, clamped in reversed(chunks):
        if weights is None:
            weights = np.empty_like(A)
            front_to_back(A, weights, before.copy(), np.zeros(before.shape, bool), settings)
        # In the forward image += weight color, so a color gets the weights, and a weight the color.
        g_tiles, sums = g[tiles], np.empty((*pairs.shape, 9), A.dtype)
        np.matmul(
            weights.transpose(1, 0, 2),
            g_tiles.transpose(0, 2, 1),
            out=sums[:, :, 6:].transpose(1, 0, 2),  # gradients of the colors
        )
        V = np.empty_like(A)  # what a pixel gains per unit of a splat's weight
        colors = pair_colors.take(pairs, axis=0).transpose(1, 0, 2)
        np.matmul(colors, g_tiles, out=V.transpose(1, 0, 2))
        if occlusion:
            # In the forward T *= 1 - alpha, so alpha also takes away what is behind its rank.
            through = behind[tiles]  # the value behind a rank; nothing is divided by 1 - alpha
            blocked = np.empty_like(through)
            for a, v in zip(A[::-1], V[::-1]):
                v -= through
                through += np.multiply(a, v, out=blocked)
            behind[tiles] = through
        V *= weights  # in the forward weight = alpha T, so this is the gradient of log alpha
        for where, slope in clamped:
            V.reshape(-1)[where] *= slope
        # In the forward log alpha = coefficients @ monomials, so coefficients get their moments.
        np.matmul(V.reshape(-1, len(basis)), basis, out=sums.reshape(-1, 9)[:, :6])
        per_pair[pairs] = sums
    columns = per_pair[:-1].T.astype(float, order="C")
    for first in range(0, len(lists.splat), PIECE):
        piece = slice(first, first + PIECE)
        columns[:6, piece] = from_moments(
            columns[:6, piece], at_pairs(splats, lists, settings.tile, piece)
        )
    # Sums over all pairs of a Gaussian.
    N = splats.shape[1]
    total = np.stack([np.bincount(lists.splat, pairs, N) for pairs in columns], axis=1)
    return {
        "mean2d": total[:, :2],
        "conic": total[:, 2:5],
        "alpha": total[:, 5],
        "color": total[:, 6:],
        "background": np.einsum("gp,gcp->c", T, g) if occlusion else g.sum(axis=(0, 2)),
    }


def groups_of_tiles(count, side):
    """Return the tiles that have splats, in groups, longest lists first: equal lengths together."""
    tiles = np.argsort(-count, kind="stable")[: np.count_nonzero(count)]
    size = max(1, GROUP // side**2)
    return [tiles[first : first + size] for first in range(0, len(tiles), size)]


def columns_of(mean2d, conic, alpha):
    """Return x, y, minus the conic (a, b, c), log alpha and alpha of every splat [7, N].

    An alpha of 0 gets a conic of 0 and LOG_OF_ZERO, because infinity would give NaN in a product,
    and 1 in the last row, because backward divides by it.
    """
    some = alpha > 0
    opacity = np.where(some, alpha, 1)
    log_alpha = np.where(some, np.log(opacity), LOG_OF_ZERO)
    return np.stack([*mean2d.T, *(-conic.T * some), log_alpha, opacity])


def at_pairs(splats, lists, side, piece=slice(None)):
    """Return `columns_of` for every pair, x and y counted from the splat to the tile's middle."""
    columns, tile = splats.take(lists.splat[piece], axis=1), lists.tile[piece]
    places = np.stack([tile % lists.columns, tile // lists.columns])
    columns[:2] = places * side + (side - 1) / 2 - columns[:2]
    return columns


def polynomials(placed, dtype):
    """Return the coefficients [M + 1, 6] of all pairs; in the last row, the padding, alpha is 0."""
    e_x, e_y, a, b, c, log_alpha, _ = placed
    k_1, k_2 = a * e_x + b * e_y, b * e_x + c * e_y
    k_0 = log_alpha + (e_x * k_1 + e_y * k_2) / 2
    coefficients = np.zeros((len(a) + 1, 6), dtype)
    coefficients[:-1] = np.stack((k_0, k_1, k_2, a / 2, b, c / 2), axis=1)
    coefficients[-1, 0] = LOG_OF_ZERO
    return coefficients


@lru_cache(maxsize=8)
def monomials(side, dtype):
    """Return the matrix [6, P] of 1, u, v, u**2, u v, v**2 at a tile's pixels."""
    offset = np.arange(side) - (side - 1) / 2
    v, u = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]).astype(dtype)


def composite(coefficients, T, stopped, settings, occlusion, clamps, keep):
    """Return alphas and weights [K, G, P] of a chunk; update T and stopped [G, P] in place.

    Also returns where alphas were clamped, as pairs of indices of the flat chunk and the slope of
    log alpha there. A few ranks are evaluated and composited at a time, so that they are still in
    the cache. The weights take the place of A if no gradients are wanted.
    """
    A = np.empty((len(coefficients), *T.shape), T.dtype)
    weights = np.empty_like(A) if keep and occlusion else A
    basis, clamped = monomials(settings.tile, settings.dtype), []
    ranks = max(1, CACHED // T.size)
    for first in range(0, len(A), ranks):
        some = slice(first, first + ranks)
        alphas = A[some]
        np.matmul(coefficients[some].reshape(-1, 6), basis, out=alphas.reshape(-1, len(basis.T)))
        np.exp(alphas, out=alphas)
        if clamps:
            where, slope = clamp(alphas.reshape(-1), settings)
            clamped.append((where + first * T.size, slope))
        if settings.mask:
            alphas[alphas < settings.mask] = 0
        if occlusion:
            front_to_back(alphas, weights[some], T, stopped, settings)
    return A, weights, clamped


def clamp(A, settings):
    """Clamp alphas [n] in place; return which were larger, and the slope of log alpha there.

    The published kernel differentiates as if there were no clamp. Above it, the slope of log alpha
    is then alpha / alpha_max.
    """
    where = np.flatnonzero(A > settings.alpha_max)
    slope = A[where] / settings.alpha_max if settings.clamp_passes_gradient else 0.0
    A[where] = settings.alpha_max
    return where, slope


def front_to_back(A, weights, T, stopped, settings):
    """Write alpha T to `weights` [K, G, P], which may be A, and subtract it from T [G, P].

    With `stop_by_pixel`, the splat that would pass the stop and all splats behind it are cut from
    A, and `stopped` remembers the pixels.
    """
    for alpha, weight in zip(A, weights):
        np.multiply(T, alpha, weight)
        if settings.stop_by_pixel:
            stopped |= T - weight < settings.stop
            alpha[stopped] = 0
            weight[stopped] = 0
        T -= weight


def from_moments(moments, placed):
    """Return the gradients of mean2d, conic, alpha [6, M] of every pair from its six moments."""
    m_0, m_u, m_v, m_uu, m_uv, m_vv = moments
    e_x, e_y, a, b, c, _, opacity = placed
    m_x, m_y = m_u + e_x * m_0, m_v + e_y * m_0  # about the splat's mean, not the tile's middle
    return (
        -(a * m_x + b * m_y),
        -(b * m_x + c * m_y),
        -0.5 * (m_uu + e_x * (m_u + m_x)),
        -(m_uv + e_x * m_v + e_y * m_x),
        -0.5 * (m_vv + e_y * (m_v + m_y)),
        m_0 / opacity,
    )


def to_image(tiles, lists, side):
    """Put tiles [tiles, C, P] together to the image [H, W, C] that all tiles cover."""
    grid = tiles.reshape(lists.rows, lists.columns, -1, side, side).transpose(0, 3, 1, 4, 2)
    return grid.reshape(lists.rows * side, lists.columns * side, -1)


def to_tiles(image, lists, side):
    """Cut an image [H, W, 3] into tiles [tiles, 3, P], with zeros beyond its edge."""
    height, width, _ = image.shape
    padded = np.zeros((lists.rows * side, lists.columns * side, 3), image.dtype)
    padded[:height, :width] = image
    grid = padded.reshape(lists.rows, side, lists.columns, side, 3).transpose(0, 2, 4, 1, 3)
    return grid.reshape(-1, 3, side * side)
