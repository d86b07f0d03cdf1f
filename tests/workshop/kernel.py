"""Vectors of level L2 for the rule of the published kernel (Kerbl et al. 2023), Q21's `kernel`.

`lists` and `composite` are written from the rule, tile by tile, and share no code with the
renderers of the package, which tests compare with them. Every operation has the precision of its
inputs.

    radius   ceil(3 sqrt(largest eigenvalue of cov2d)); the difference of the eigenvalues' square
             roots is taken from max(0.1, (a - c)^2 / 4 + b^2)
    tiles    from trunc((mean - radius) / 16) to trunc((mean + radius + 15) / 16), exclusive, both
             clamped to the image's tiles, on both axes
    key      tile number in the upper 32 bits, the bits of the depth as float32 in the lower ones;
             the sort is stable, so that equal keys stay in the order of their rows
    pixel    front to back: A = min(0.99, alpha exp(power)); skipped where A < 1/255; where
             T (1 - A) < 1e-4 the pixel ends before this splat is drawn
    last     place of the pixel's last drawn splat in the list of its tile, from 1; 0 without one
    backward the clamp passes the gradient, and what was skipped or cut has none
"""

from typing import NamedTuple

import numpy as np

from p4dgs_ref.oracle.compare import cast
from p4dgs_ref.oracle.published import flatten
from p4dgs_ref.splatting import fast
from p4dgs_ref.splatting.settings import KERNEL
from tests.workshop import stages
from tests.workshop.flat import camera_of
from tests.workshop.subjects import as_published, no_pullback

TILE, MASK, STOP, ALPHA_MAX = 16, 1 / 255, 1e-4, 0.99
CONSTANTS = {"tile": TILE, "mask": MASK, "stop": STOP, "alpha_max": ALPHA_MAX}
SPLATS = ("mean2d", "conic", "alpha", "color")


class Lists(NamedTuple):
    """The outputs of `tile_lists`."""

    radius: np.ndarray  # [N]  pixels; 0 where no tile is met
    rect: np.ndarray  # [N, 4]  first tile x, y, and the tile after the last, x, y
    tile: np.ndarray  # [K]
    row: np.ndarray  # [K]
    key: np.ndarray  # [K]
    ranges: np.ndarray  # [G, 2]  start and end of every tile's list


def lists(mean2d, cov2d, depth, visible, height, width):
    """Return the Lists of some splats."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    a, b, c = cov2d.T
    middle = (a + c) / 2
    spread = np.sqrt(np.maximum(0.1, middle**2 - (a * c - b * b)).astype(a.dtype))
    radius = np.ceil(a.dtype.type(3) * np.sqrt(middle + spread))
    low = np.trunc((mean2d - radius[:, None]) / TILE).astype(int)
    high = np.trunc((mean2d + radius[:, None] + (TILE - 1)) / TILE).astype(int)
    first, beyond = np.clip(low, 0, (columns, rows)), np.clip(high, 0, (columns, rows))
    beyond[~visible] = first[~visible]
    empty = (beyond <= first).any(axis=1)
    rect = np.where(empty[:, None], 0, np.concatenate([first, beyond], axis=1))
    pairs = []
    bits = depth.astype(np.float32).view(np.uint32).astype(np.int64)
    for i, (x_0, y_0, x_1, y_1) in enumerate(rect.tolist()):
        for y in range(y_0, y_1):
            for x in range(x_0, x_1):
                pairs.append((y * columns + x, int(bits[i]), i))
    pairs.sort()
    tile, _, row = np.array(pairs, np.int64).reshape(-1, 3).T
    edges = np.searchsorted(tile, np.arange(columns * rows + 1))
    return Lists(
        np.where(empty, 0, radius).astype(np.int32),
        rect.astype(np.int32),
        tile.astype(np.int32),
        row.astype(np.int32),
        tile << 32 | bits[row],
        np.stack([edges[:-1], edges[1:]], axis=1).astype(np.int32),
    )


class Tile(NamedTuple):
    """What one tile saves for `backward`: M splats at P pixels."""

    rows: np.ndarray  # [M]
    pixels: tuple  # slices of the image
    e_x: np.ndarray  # [1, P] minus [M, 1]
    e_y: np.ndarray
    falloff: np.ndarray  # [M, P]
    raw: np.ndarray  # [M, P]  opacities before clamp, mask and stop
    A: np.ndarray  # [M, P]  0 where nothing is drawn
    before: np.ndarray  # [M, P]  T in front of each splat


def composite(
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
):
    """Return image, transmittance and last, and the tiles."""
    dtype = mean2d.dtype
    image, T_all = np.empty((height, width, 3), dtype), np.empty((height, width), dtype)
    last, tiles = np.zeros((height, width), np.int32), []
    of_tiles = lists(mean2d, cov2d, depth, visible, height, width)
    places = [of_tiles.row[start:end] for start, end in of_tiles.ranges]
    for number, rows in enumerate(places):
        y, x = divmod(number, -(-width // TILE))
        area = slice(y * TILE, (y + 1) * TILE), slice(x * TILE, (x + 1) * TILE)
        v, u = (grid[area].ravel().astype(dtype) for grid in np.indices((height, width)))
        e_x, e_y = u - mean2d[rows, :1], v - mean2d[rows, 1:]
        a, b, c = conic[rows].T[:, :, None]
        falloff = np.exp(np.minimum(-0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y, 0))
        raw = alpha[rows, None] * falloff
        A = np.minimum(raw, dtype.type(ALPHA_MAX))
        A = np.where(A < dtype.type(MASK), 0, A).astype(dtype)
        T, open_ = np.ones(len(u), dtype), np.ones(len(u), bool)
        before = np.empty_like(A)
        for i, layer in enumerate(A):
            open_ &= T * (1 - layer) >= STOP
            layer[~open_] = 0
            before[i] = T
            T = T * (1 - layer)
        weights = A * before
        shape = last[area].shape
        image[area] = (weights.T @ color[rows] + T[:, None] * background).reshape(*shape, 3)
        T_all[area] = T.reshape(shape)
        drawn = (A > 0) * np.arange(1, len(rows) + 1)[:, None]
        last[area] = drawn.max(axis=0, initial=0).reshape(shape)
        tiles.append(Tile(rows, area, e_x, e_y, falloff, raw, A, before))
    return (image, T_all, last), tiles


def along_the_pixels(tile, inputs, image_bar, transmittance_bar):
    """Return the gradients of A and of T in front of each splat [M, P], 0 where none is drawn."""
    g, h = image_bar[tile.pixels].reshape(-1, 3), transmittance_bar[tile.pixels].ravel()
    A_bar, behind = inputs["color"][tile.rows] @ g.T, g @ inputs["background"] + h
    T_bar = np.empty_like(A_bar)
    for i in reversed(range(len(A_bar))):
        A_bar[i] -= behind
        behind = behind + tile.A[i] * A_bar[i]
        T_bar[i] = behind
    return A_bar * tile.before * (tile.A > 0), T_bar * (tile.A > 0)


def gradients(tiles, T, inputs, image_bar, transmittance_bar):
    """Return the gradients of mean2d, conic, alpha, color and background."""
    bars = {name: np.zeros_like(inputs[name]) for name in SPLATS}
    for tile in tiles:
        rows, g = tile.rows, image_bar[tile.pixels].reshape(-1, 3)
        a, b, c = inputs["conic"][rows].T[:, :, None]
        np.add.at(bars["color"], rows, (tile.A * tile.before) @ g)
        V = along_the_pixels(tile, inputs, image_bar, transmittance_bar)[0] * tile.falloff
        np.add.at(bars["alpha"], rows, V.sum(axis=1))
        V *= inputs["alpha"][rows, None]  # from here on the gradient of the exponent
        e_x, e_y = tile.e_x, tile.e_y
        along = (V * (a * e_x + b * e_y)).sum(axis=1), (V * (b * e_x + c * e_y)).sum(axis=1)
        np.add.at(bars["mean2d"], rows, np.stack(along, axis=1))
        form = -(V * e_x**2) / 2, -(V * e_x * e_y), -(V * e_y**2) / 2
        np.add.at(bars["conic"], rows, np.stack([part.sum(axis=1) for part in form], axis=1))
    return {**bars, "background": (T[:, :, None] * image_bar).sum(axis=(0, 1))}


# --- the subjects -------------------------------------------------------------------------------
def lists_vjp(mean2d, cov2d, depth, visible, height, width):
    """Splats -> which tiles each of them meets, and the sorted lists of all tiles."""
    return lists(mean2d, cov2d, depth, visible, height, width)._asdict(), no_pullback


def kernel_vjp(**inputs):
    """Splats -> image, by the rule of the published kernel."""
    (image, T, last), tiles = composite(**inputs)

    def pullback(image_bar, transmittance_bar):
        return gradients(tiles, T, inputs, image_bar, transmittance_bar)

    return {"image": image, "transmittance": T, "last": last}, pullback


def pixels_vjp(pixels, image_bar, **inputs):
    """Splats, gradient of the image -> what every splat is at some pixels, and its gradients."""
    (_, T, _), tiles = composite(**inputs)
    layers = np.zeros((4, len(inputs["alpha"]), *T.shape), T.dtype)
    for tile in tiles:
        values = tile.A, tile.before * (tile.A > 0)
        values += along_the_pixels(tile, inputs, image_bar, np.zeros_like(T))
        area = layers[(..., *tile.pixels)]
        area[:, tile.rows] = np.reshape(values, (4, -1, *area.shape[2:]))
    return dict(zip(("A", "T", "A_bar", "T_bar"), layers[(..., *pixels.T[::-1])])), no_pullback


def definite(inputs):
    """Return the inputs without splats whose exponent can be positive.

    The package computes conics in float64, in which rounding makes no such splats, and its
    renderers do not look for them.
    """
    a, b, c = inputs["conic"].T
    return {**inputs, "visible": inputs["visible"] & (a * c > b * b)}


def by_monomials(inputs, cotangents):
    """The answer of the package's `fast`, a right renderer that loses digits by its polynomials."""
    (image, T, last), _ = composite(**inputs)
    wide = cast(definite(inputs), np.float64)
    settings = KERNEL._replace(dtype=image.dtype.name)
    (image, T), saved = fast.forward(**wide, settings=settings)
    bars = fast.backward(saved, cotangents["image_bar"])
    outputs = {"image": image, "transmittance": T, "last": last}
    return {**flatten(outputs, "out."), **flatten(bars, "in_bar.")}


def splats_of(x, s, r, camera):
    """Return the splats of some Gaussians as inputs of `composite`, and their pullback."""
    splats, pullback = stages.projected(x, s, r, camera, KERNEL)
    return dict(splats, height=camera.height, width=camera.width), pullback


def stage_vjp(x, s, r, alpha, color, W, T, focal, center, size, background):
    """Gaussians at t -> image, by the rule of the published kernel."""
    splats, splats_pullback = splats_of(x, s, r, camera_of(W, T, focal, center, size))
    looks = dict(alpha=alpha, color=color, background=background)
    outputs, kernel_pullback = kernel_vjp(**splats, **looks)
    of_lists = {name: splats[name] for name in LISTED}

    def pullback(image_bar, transmittance_bar):
        bars = kernel_pullback(image_bar, transmittance_bar)
        places = splats_pullback(bars.pop("mean2d"), bars.pop("conic"))
        looks_bars = {name: bar.astype(x.dtype, copy=False) for name, bar in bars.items()}
        return {**looks_bars, **places}

    return {"radius": lists(**of_lists).radius, **outputs}, pullback


LISTED = ("mean2d", "cov2d", "depth", "visible", "height", "width")


SUBJECTS = (
    as_published("tile_lists", lists_vjp, single=True),
    as_published("kernel_pixels", pixels_vjp, single=True, steady=("depth",)),
    as_published("kernel", kernel_vjp, single=True, steady=("depth",), twins=(by_monomials,)),
    as_published("kernel_many", kernel_vjp, single=True, steady=("depth",), twins=(by_monomials,)),
    as_published("kernel_stage", stage_vjp, single=True),
)
