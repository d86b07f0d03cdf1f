"""Fast compositing: lists by tile, exp of many tiles, two array operations for each depth rank.

Inside a tile the logarithm of a splat's alpha is a polynomial of the pixel's offset (u, v) from the
tile's middle,

    log alpha = k_0 + k_1 u + k_2 v + k_3 u**2 + k_4 u v + k_5 v**2,

and the six monomials are the same for every tile. The alphas of several splats in many tiles are
therefore one product with a constant matrix and one exp. A loop over depth ranks (first splat of
every tile, second splat of every tile, ...) then composites these tiles at once. In the backward
pass the transposed product returns the six moments of the gradient, from which the gradients of
mean, conic and opacity follow in closed form. The cost follows the listed pairs, not N H W. Tiles
are taken in groups, and without gradients the memory follows a group, not the image.

The lists by tile are those of Kerbl et al. 2023 (3DGS), the arrangement by ranks is this project's.
`settings` says which pairs are listed and when a tile stops (Q21).

Axis letters: K ranks of a chunk, G tiles, P pixels of a tile, M listed pairs.
"""

from functools import lru_cache

import numpy as np
from scipy.sparse import csr_array

from .tiles import bin_splats

RANKS = 32  # depth ranks that are evaluated together; 16 to 32 cost about the same
GROUP = 2**14  # pixels of the tiles that are evaluated together
CACHED = 2**16  # alphas that are composited as soon as they are computed, while in the cache
NOTHING = -1e4  # logarithm of an opacity of 0: its exp is zero in every dtype


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

    With `keep=False` the last is None, and a chunk is forgotten as soon as it is composited.
    """
    dtype, side = np.dtype(settings.dtype), settings.tile
    looks = mean2d, cov2d, conic, alpha, depth, visible
    lists = bin_splats(*looks, width, height, settings, occlusion)
    count = np.bincount(lists.tile, minlength=lists.columns * lists.rows)
    start = np.cumsum(count) - count
    splats = columns_of(mean2d, conic, alpha)
    row_of = np.append(lists.row, len(alpha))  # the splat of every pair; the last is the padding
    middles = middles_of(lists, side)
    paint = np.concatenate([color, np.zeros((1, 3))]).astype(dtype)
    clamps = alpha.max(initial=0) > settings.alpha_max
    T = np.ones((len(count), side * side), dtype)
    image = np.zeros((len(count), 3, side * side), dtype)
    stopped = np.zeros(T.shape, bool)
    # A chunk: up to RANKS successive splats of those tiles of a group that still let light through.
    chunks = []
    for tiles in groups_of_tiles(count, side):
        for rank in range(0, int(count[tiles[0]]), RANKS):
            tiles = tiles[count[tiles] > rank]
            if settings.stop and occlusion and rank:
                tiles = tiles[T[tiles].max(axis=1) >= settings.stop]
            if not len(tiles):
                break
            ranks = np.arange(rank, min(rank + RANKS, count[tiles].max()))[:, None]
            # [K, G] the row of every pair; M, the padding, where a tile's list has ended
            pairs = np.where(ranks < count[tiles], start[tiles] + ranks, len(lists.row))
            rows = row_of[pairs]
            coefficients = polynomials(splats, rows, middles[:, tiles], dtype)
            light, dark = T[tiles], stopped[tiles]
            A, weights, slope = composite(
                coefficients, light, dark, settings, occlusion, clamps, keep
            )
            T[tiles], stopped[tiles] = light, dark
            image[tiles] += paint.take(rows, axis=0).transpose(1, 2, 0) @ weights.transpose(1, 0, 2)
            if keep:
                chunks.append((tiles, pairs, A, weights, slope))
    if background.any():  # black adds nothing
        image += T[:, None] * background.astype(dtype)[:, None]
    saved = (chunks, T, background, occlusion, lists, row_of, splats, middles, paint, settings)
    image, transmittance = (to_image(a, lists, side)[:height, :width] for a in (image, T[:, None]))
    return (image, transmittance[:, :, 0]), saved if keep else None


def backward(saved, image_bar):
    """Gradients of mean2d, conic, alpha, color and background.

    Pairs that are not listed, or lie behind an opaque tile, contribute nothing.
    """
    chunks, T, background, occlusion, lists, row_of, splats, middles, paint, settings = saved
    g = to_tiles(np.asarray(image_bar, settings.dtype), lists, settings.tile)
    behind = np.zeros_like(T)
    if occlusion and background.any():
        behind = background.astype(settings.dtype) @ g
    basis = monomials(settings.tile, settings.dtype).T
    per_pair = np.zeros((len(row_of), 9))  # the last row collects the padding
    for tiles, pairs, A, weights, slope in reversed(chunks):
        g_tiles, rows = g[tiles], row_of[pairs]
        paint_bar = weights.transpose(1, 0, 2) @ g_tiles.transpose(0, 2, 1)
        V = np.empty_like(A)  # what a pixel gains per unit of a splat's weight
        colors = paint.take(rows, axis=0).transpose(1, 0, 2)
        np.matmul(colors, g_tiles, out=V.transpose(1, 0, 2))
        if occlusion:
            seen = behind[tiles]  # the value seen through a rank; nothing is divided by 1 - alpha
            blocked = np.empty_like(seen)
            for a, v in zip(A[::-1], V[::-1]):
                v -= seen
                seen += np.multiply(a, v, out=blocked)
            behind[tiles] = seen
        V *= weights  # gradient of log alpha
        if slope is not None:
            V *= slope
        moments = V.reshape(-1, V.shape[2]) @ basis
        per_pair[pairs, :6] = from_moments(moments, splats, rows, middles[:, tiles])
        per_pair[pairs, 6:] = paint_bar.transpose(1, 0, 2)
    M, N = len(lists.row), len(paint) - 1
    members = csr_array((np.ones(M), lists.row, np.arange(M + 1)), shape=(M, N))
    total = members.T @ per_pair[:-1]  # all pairs of a Gaussian
    return {
        "mean2d": total[:, :2],
        "conic": total[:, 2:5],
        "alpha": total[:, 5],
        "color": total[:, 6:],
        "background": np.einsum("gp,gcp->c", T, g) if occlusion else g.sum(axis=(0, 2)),
    }


def groups_of_tiles(count, side):
    """The tiles with splats, in groups, longest lists first, so that equal lists stand together."""
    tiles = np.argsort(-count, kind="stable")[: np.count_nonzero(count)]
    size = max(1, GROUP // side**2)
    return [tiles[first : first + size] for first in range(0, len(tiles), size)]


def middles_of(lists, side):
    """The coordinates x and y [2, tiles] of every tile's middle."""
    tile = np.arange(lists.columns * lists.rows)
    return np.stack([tile % lists.columns, tile // lists.columns]) * side + (side - 1) / 2


def columns_of(mean2d, conic, alpha):
    """x, y, minus the conic (a, b, c), log alpha and alpha of every splat [7, N + 1].

    The last column is padding. Alphas of 0, whose logarithm would be NaN in the product, are 1 in
    the last row, because backward divides by it.
    """
    some = alpha > 0
    opacity = np.where(some, alpha, 1)
    columns = np.zeros((7, len(alpha) + 1))
    columns[:, :-1] = (
        *mean2d.T,
        *(-conic.T * some),
        np.where(some, np.log(opacity), NOTHING),
        opacity,
    )
    columns[5:, -1] = NOTHING, 1
    return columns


def polynomials(splats, rows, middles, dtype):
    """The coefficients [6, K, G] of splats `rows` [K, G] in tiles with these middles [2, G]."""
    x, y, a, b, c, log_alpha = (column[rows] for column in splats[:6])
    e_x, e_y = middles[0] - x, middles[1] - y
    k_1, k_2 = a * e_x + b * e_y, b * e_x + c * e_y
    k_0 = log_alpha + (e_x * k_1 + e_y * k_2) / 2
    return np.stack((k_0, k_1, k_2, a / 2, b, c / 2), dtype=dtype, casting="same_kind")


@lru_cache(maxsize=8)
def monomials(side, dtype):
    """The matrix [6, P] of 1, u, v, u**2, u v, v**2 at a tile's pixels."""
    offset = np.arange(side) - (side - 1) / 2
    v, u = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]).astype(dtype)


def composite(coefficients, T, stopped, settings, occlusion, clamps, keep):
    """Alphas, weights and slope [K, G, P] of a chunk; T and stopped [G, P] are moved behind it.

    The slope is that of log alpha through its clamp; it is None where no alpha is clamped. A few
    ranks are evaluated and composited at a time, so that they are still in the cache. The weights
    take the place of A where no gradients are wanted.
    """
    A = np.empty((coefficients.shape[1], *T.shape), T.dtype)
    weights = np.empty_like(A) if keep and occlusion else A
    slope = None
    if keep and clamps:
        slope = np.empty_like(A, T.dtype if settings.clamp_passes_gradient else bool)
    ranks = max(1, CACHED // T.size)
    for first in range(0, len(A), ranks):
        some = slice(first, first + ranks)
        alphas(coefficients[:, some], settings, A[some])
        if slope is not None:
            slope[some] = slope_of_clamp(A[some], settings)
        if clamps:
            np.minimum(A[some], settings.alpha_max, out=A[some])
        if settings.mask:
            A[some][A[some] < settings.mask] = 0
        if occlusion:
            front_to_back(A[some], weights[some], T, stopped, settings)
    return A, weights, slope


def alphas(coefficients, settings, out):
    """Write the exp of the polynomials, alphas before their clamp, to `out` [K, G, P]."""
    _, K, G = coefficients.shape
    basis = monomials(settings.tile, settings.dtype)
    np.matmul(coefficients.reshape(6, K * G).T, basis, out=out.reshape(K * G, -1))
    np.exp(out, out=out)


def slope_of_clamp(A, settings):
    """The slope of log alpha through its clamp.

    The published kernel differentiates as if there were no clamp. Above it, the slope of log alpha
    is then alpha / alpha_max.
    """
    if settings.clamp_passes_gradient:
        return np.maximum(A / settings.alpha_max, 1)
    return A <= settings.alpha_max


def front_to_back(A, weights, T, stopped, settings):
    """Write alpha T to `weights` [K, G, P], which may be A, and take it from T [G, P].

    With `stop_by_pixel`, the splat that would pass the stop and all splats behind it are cut from
    A, and `stopped` remembers the pixels.
    """
    for alpha, weight in zip(A, weights):
        np.multiply(T, alpha, out=weight)
        if settings.stop_by_pixel:
            stopped |= T - weight < settings.stop
            alpha[stopped] = 0
            weight[stopped] = 0
        np.subtract(T, weight, out=T)


def from_moments(moments, splats, rows, middles):
    """Gradients [K, G, 6] of mean2d (2), conic (3) and alpha of every pair, from six moments."""
    columns = moments.T.astype(float, order="C")
    m_0, m_u, m_v, m_uu, m_uv, m_vv = columns.reshape(6, *rows.shape)
    x, y, a, b, c, _, opacity = (column[rows] for column in splats)
    e_x, e_y = middles[0] - x, middles[1] - y
    m_x, m_y = m_u + e_x * m_0, m_v + e_y * m_0  # about the splat's mean, not the tile's middle
    gradients = (
        -(a * m_x + b * m_y),
        -(b * m_x + c * m_y),
        -0.5 * (m_uu + e_x * (m_u + m_x)),
        -(m_uv + e_x * m_v + e_y * m_x),
        -0.5 * (m_vv + e_y * (m_v + m_y)),
        m_0 / opacity,
    )
    return np.stack(gradients, axis=2)


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
