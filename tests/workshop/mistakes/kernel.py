"""Known mistakes of rasterisers under the published kernel's rule: lists, decisions, gradients."""

from functools import cache

import numpy as np

from tests.workshop.kernel import MASK, TILE
from tests.workshop.mistakes.kit import known, surgery
from tests.workshop.rewriting import rewritten

# id: what the port does, and the text of `tests.workshop.kernel` that it has otherwise
RULES = {
    "lists-ties-reversed": (
        "equal keys end in descending order of row",
        {"pairs.sort()": "pairs.sort(key=lambda pair: (*pair[:2], -pair[2]))"},
    ),
    "lists-not-sorted": (
        "the entries of a tile are not sorted by depth",
        {"int(bits[i])": "0"},
    ),
    "lists-inclusive": (
        "the rectangle has one tile more in x and y: its end is inclusive",
        {"np.clip(high, 0,": "np.clip(high + 1, 0,"},
    ),
    "lists-by-columns": (
        "tiles are numbered column by column",
        {"y * columns + x": "x * rows + y"},
    ),
    "lists-radius-rounded": (
        "the radius is rounded to the nearest pixel, not up",
        {"np.ceil(a.dtype.type(3)": "np.round(a.dtype.type(3)"},
    ),
    "lists-limits-exchanged": (
        "the first tile is clamped to the number of rows in x and to that of columns in y",
        {"np.clip(low, 0, (columns, rows))": "np.clip(low, 0, (rows, columns))"},
    ),
    "kernel-no-stop": (
        "a pixel never ends: there is no stop at T < 1e-4",
        {"open_ &= T * (1 - layer) >= STOP": "pass"},
    ),
    "kernel-stop-after-splat": (
        "the splat that would bring T below 1e-4 is still drawn before the pixel ends",
        {
            "open_ &= T * (1 - layer) >= STOP": "pass",
            "layer[~open_] = 0": ("layer[~open_], open_ = 0, open_ & (T * (1 - layer) >= STOP)"),
        },
    ),
    "kernel-not-masked": (
        "alphas below 1/255 are drawn",
        {"np.where(A < dtype.type(MASK), 0, A)": "A"},
    ),
    "kernel-exponent-not-clamped": (
        "a splat whose exponent is above 0 is drawn with more than its alpha",
        {"np.exp(np.minimum(": "np.exp((", "b * e_x * e_y, 0))": "b * e_x * e_y))"},
    ),
    "pixels-no-clamp": (
        "the A of a splat at a pixel is not clamped at 0.99",
        {"np.minimum(raw, dtype.type(ALPHA_MAX))": "raw"},
    ),
    "pixels-other-clamp": (
        "the A of a splat at a pixel is clamped at 0.999 instead of 0.99",
        {"np.minimum(raw, dtype.type(ALPHA_MAX))": "np.minimum(raw, dtype.type(0.999))"},
    ),
    "kernel-clamp-blocks-gradient": (
        "the clamp of alpha at 0.99 stops the gradient, as autodiff of a minimum does",
        {"* tile.falloff": "* tile.falloff * (tile.raw <= tile.A.dtype.type(ALPHA_MAX))"},
    ),
    "kernel-ties-reversed": (
        "equal depths are drawn in descending order of index",
        {"pairs.sort()": "pairs.sort(key=lambda pair: (*pair[:2], -pair[2]))"},
    ),
    "kernel-exact-ellipse": (
        "tiles are listed by the exact ellipse of alpha >= 1/255 instead of the square of 3 sigma",
        {
            "[of_tiles.row[start:end] for start, end in of_tiles.ranges]": (
                "[reaching(of_tiles.row[start:end], i, -(-width // TILE), mean2d, conic, alpha) "
                "for i, (start, end) in enumerate(of_tiles.ranges)]"
            )
        },
    ),
    "kernel-tiles-ignored": (
        "every pixel draws all visible splats: the lists of the tiles are ignored",
        {
            "[of_tiles.row[start:end] for start, end in of_tiles.ranges]": (
                "len(of_tiles.ranges) * [np.argsort(np.where(visible, depth, np.inf), "
                "kind='stable')[: visible.sum()]]"
            )
        },
    ),
    "kernel-no-background": (
        "the kernel leaves the background out",
        {
            " + T[:, None] * background)": ")",
            'g @ inputs["background"] + h': "h.copy()",
            "(T[:, :, None] * image_bar).sum(axis=(0, 1))": "0 * inputs['background']",
        },
    ),
    "kernel-background-detached": (
        "alpha receives no gradient through the kernel's T_N of the background",
        {'g @ inputs["background"] + h': "h.copy()"},
    ),
    "kernel-last-from-zero": (
        "`last` counts from 0: the first splat of the list is 0",
        {"np.arange(1, len(rows) + 1)": "np.arange(len(rows))"},
    ),
    "kernel-last-counts-drawn": (
        "`last` counts the splats that were drawn, not their places in the list of the tile",
        {"(A > 0) * np.arange(1, len(rows) + 1)[:, None]": "np.cumsum(A > 0, axis=0)"},
    ),
}


def reaching(rows, number, columns, mean2d, conic, alpha):
    """The rows of a tile's list that are not masked in all of its pixels."""
    y, x = divmod(number, columns)
    corner = np.array([x, y]) * TILE - mean2d[rows]
    u, v = (corner[:, axis, None, None] + pixels for axis, pixels in ((0, ACROSS), (1, DOWN)))
    a, b, c = conic[rows].T[:, :, None, None]
    opacity = alpha[rows, None, None] * np.exp(-0.5 * (a * u * u + c * v * v) - b * u * v)
    return rows[(opacity >= MASK).any(axis=(1, 2))]


SUBJECT_OF = {"lists": "tile_lists", "kernel": "kernel", "pixels": "kernel_pixels"}
DOWN, ACROSS = np.mgrid[:TILE, :TILE]


@cache
def ruled(id):
    """The names of `tests.workshop.kernel` under the rule of a mistake."""
    return rewritten("tests.workshop.kernel", RULES[id][1], reaching=reaching)


def by_rule(id, description):
    place = id.partition("-")[0]

    def run(given, cotangents):
        outputs, pullback = ruled(id)[f"{place}_vjp"](**given)
        return outputs, pullback(**cotangents)

    return surgery(SUBJECT_OF[place], id, description, run)


def in_ndc(bars, given):
    half = np.array([given["width"], given["height"]], bars["mean2d"].dtype) / 2
    return {**bars, "mean2d": bars["mean2d"] * half}


MISTAKES = [
    *(by_rule(id, description) for id, (description, _) in RULES.items()),
    known(
        "kernel",
        "kernel-half-off-diagonal",
        "the gradient of the conic's b is that of one off-diagonal entry: half",
        inputs_bar={"conic": lambda bar, _: bar * np.array([1, 0.5, 1], bar.dtype)},
    ),
    known(
        "kernel",
        "kernel-ndc-gradient",
        "the gradient of mean2d is in NDC units: W/2 and H/2 times that per pixel",
        inputs_bar=in_ndc,
    ),
]
