"""Known mistakes of rasterisers under the published kernel's rule: lists, decisions, gradients."""

import numpy as np

from tests.golden.kernel import Rule, kernel_vjp, lists_vjp
from tests.golden.mistakes.kit import known, surgery


def ruled(vjp, **changes):
    """`run` of a port that follows another rule."""

    def run(given, cotangents):
        outputs, pullback = vjp(**given, rule=Rule(**changes))
        return outputs, pullback(**cotangents)

    return run


def of_lists(id, description, **changes):
    return surgery("tile_lists", id, description, ruled(lists_vjp, **changes))


def of_kernel(id, description, **changes):
    return surgery("kernel", id, description, ruled(kernel_vjp, **changes))


def in_ndc(bars, given):
    half = np.array([given["width"], given["height"]], bars["mean2d"].dtype) / 2
    return {**bars, "mean2d": bars["mean2d"] * half}


LISTS = [
    of_lists(
        "lists-ties-reversed", "equal keys end in descending order of row", ties_reversed=True
    ),
    of_lists("lists-not-sorted", "the entries of a tile are not sorted by depth", sorted=False),
    of_lists(
        "lists-inclusive",
        "the rectangle has one tile more in x and y: its end is inclusive",
        inclusive=True,
    ),
    of_lists("lists-by-columns", "tiles are numbered column by column", by_columns=True),
    of_lists(
        "lists-radius-rounded",
        "the radius is rounded to the nearest pixel, not up",
        rounded_up=False,
    ),
]

KERNEL = [
    of_kernel("kernel-no-stop", "a pixel never ends: there is no stop at T < 1e-4", stops=False),
    of_kernel(
        "kernel-stop-after-splat",
        "the splat that would bring T below 1e-4 is still drawn before the pixel ends",
        draws_before_it_stops=True,
    ),
    of_kernel("kernel-not-masked", "alphas below 1/255 are drawn", masked=False),
    of_kernel(
        "kernel-clamp-blocks-gradient",
        "the clamp of alpha at 0.99 stops the gradient, as autodiff of a minimum does",
        clamp_passes=False,
    ),
    of_kernel(
        "kernel-ties-reversed",
        "equal depths are drawn in descending order of index",
        ties_reversed=True,
    ),
    of_kernel(
        "kernel-exact-ellipse",
        "tiles are listed by the exact ellipse of alpha >= 1/255 instead of the square of 3 sigma",
        ellipse=True,
    ),
    of_kernel(
        "kernel-last-counts-drawn",
        "`last` counts the splats that were drawn, not their places in the list of the tile",
        counts_drawn=True,
    ),
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

MISTAKES = [*LISTS, *KERNEL]
