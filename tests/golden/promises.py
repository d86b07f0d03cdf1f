"""What every equation promises: how large its errors may be, and for which inputs.

Errors are counted in eps S. S is the size of the terms of a number y: the largest of |y|, of the
change of y per delta when every input changes by +-delta of itself, and of terms that cancel by a
law (`terms`). A sum of terms of size S cannot be more accurate than eps S, however small the sum
is. eps is that of the precision of the inputs, 2^-52 or 2^-23. Values and gradients have the same
promise. The bounds are powers of two, at least twice the worst error that the search has found.
"""

from typing import NamedTuple

import numpy as np

# Smaller numbers count as 0, because factors underflow on the way to them.
LEAST = {np.float64: 1e-290, np.float32: 1e-25}


class Promise(NamedTuple):
    """Bounds in eps S for float64 and float32, the inputs for which they hold, the reason."""

    double: float
    single: float
    domain: str
    reason: str


WIDE = "sizes from 1e-30 to 1e30 (float32: 1e-9 to 1e9), zeros of either sign"
NETWORK = "inputs from 1e-4 to 1e4, weights from 1e-3 to 1e2, zeros among both"
SUMS = "each number is a sum of a few products"
LAYERS = "sums over the layers before, each rounded"
FADING = LAYERS + "; an exponential of up to -700 multiplies their error"

PROMISES = {
    "offsets": Promise(4, 4, WIDE + ", subnormal numbers", SUMS),
    "view": Promise(
        32,
        32,
        "sizes from 1e-200 to 1e200 (float32: 1e-25 to 1e25), coincident points",
        "two roots, a quotient, a projection",
    ),
    "opacity": Promise(256, 64, NETWORK, FADING),
    "masking": Promise(1, 1, "every finite number", "nothing is computed"),
    "color": Promise(256, 64, NETWORK, FADING),
    "rotation": Promise(64, 64, NETWORK, LAYERS + ", then a norm"),
    "scale": Promise(256, 64, NETWORK + "; s_a from 1e-12 to 1e12 (float32: 1e-4 to 1e4)", FADING),
    "positional_encoding": Promise(
        32,
        32,
        "|p| 2^(L-1) up to 5e17 (float32: 5e9), L up to 20",
        "a sine in its own precision; a sum of 2 L slopes",
    ),
    "deformation": Promise(64, 64, NETWORK, LAYERS),
    "deformed": Promise(
        32,
        32,
        WIDE + "; quaternions from 1e-100 to 1e100 (float32: 1e-12 to 1e12)",
        "a norm and a projection",
    ),
    "noise": Promise(
        8, 8, "sizes from 1e-100 to 1e100 (float32: 1e-18 to 1e18), subnormal f", SUMS
    ),
    "step": Promise(64, 64, NETWORK, LAYERS),
    "hash_grid": Promise(
        32,
        32,
        "boxes from flat to 1e3, anchors inside, on faces and outside, parameters of any size",
        "2^D products",
    ),
    "rounding": Promise(
        2,
        2,
        "|f/q| to 1e9, multiples of q/2 and up to four ulp beside them",
        "symbols are exact; one product",
    ),
    "likelihood": Promise(
        4504,
        17,
        "|f_noisy - mu| to 1000 sigma, 1e-12 <= q/sigma <= 1e6",
        "1e-12 and 2e-6 in all, its series and switches included",
    ),
    "prior": Promise(64, 64, NETWORK, LAYERS),
    "anchor_rate": Promise(4, 4, "bits from 0 to 1e30, any mask", "a sum in float64"),
    "hash_rate": Promise(4, 4, "every finite number", "one logarithm each"),
    "total_loss": Promise(4, 4, "sizes from 1e-9 to 1e9", SUMS),
    "render_loss": Promise(
        2048, 32, "intensities from 0 to 1, images equal, flat, black or white", "as ssim"
    ),
    "rate_loss": Promise(4, 4, "bits from 0 to 1e12, no numbers or 1e9 of them", SUMS),
    "mlp": Promise(64, 64, "inputs as wide as float32 allows, weights from 1e-3 to 1e2", LAYERS),
    "ssim": Promise(
        2048,
        32,
        "intensities from 0 to 1, images equal, flat, black or white",
        "beside black, 1 - luminance is C1 / D1: down to 1e-4",
    ),
    "covariance": Promise(
        16,
        16,
        "unit r; s from 1e-60 to 1e60 (float32: 1e-8 to 1e8), of either sign",
        "entries of R to eps, whatever they are",
    ),
    "projection": Promise(
        64,
        16,
        "x and T to 1e4, Sigma of semi-axes from 1e-3 to 1e3 and singular ones, focal "
        "lengths from 1 to 1e4",
        "what cancels along a ray and in a needle is counted in S (`terms.projection`)",
    ),
    "compositing": Promise(
        256,
        256,
        "means to 1e3 pixels off (float32: 1e2), conics of 1e-6 to 3 per square "
        "pixel, alpha to 1, equal depths",
        "the quadratic form of a needle cancels along it",
    ),
}
