r"""Eq. (17): the rate, in bits and per coded number.

.. math:: \mathcal{L}_{rate} = R_{anchor} + R_{hash}
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    bits: np.ndarray  # () the paper's L_rate
    L_rate: np.ndarray  # () the same per parameter, what Eq. (15) is given


class Res(NamedTuple):
    n_parameters: float  # the untouched input


def forward(R_anchor, R_hash, n_parameters):
    """Add the two rates and put them on a scale that does not depend on the scene's size.

    Shapes     R_anchor, R_hash, n_parameters () -> bits (), L_rate ()
    Units      R_anchor, R_hash, bits: bits; L_rate: bits per parameter
    Domain     n_parameters = A (d + 6 + 3k), all anchors, masked offsets counted; 0 gives L_rate = 0
    Raises     nothing
    Gradient   R_anchor, R_hash; linear; n_parameters is data
    Choice     Q12: the division, as HAC does
    Reference  P-4DGS Eq. (17)
    """
    bits = np.asarray(R_anchor + R_hash)
    return Out(bits, np.asarray(bits / n_parameters if n_parameters else 0 * bits)), Res(
        n_parameters
    )


def backward(res, bits_bar=None, L_rate_bar=None):
    bar = 0.0 if bits_bar is None else bits_bar
    if L_rate_bar is not None and res.n_parameters:
        bar = bar + L_rate_bar / res.n_parameters
    return {"R_anchor": np.asarray(bar), "R_hash": np.asarray(bar)}


def cases():
    one = lambda x: np.asarray(x, float)
    yield Case("ordinary", dict(R_anchor=one(12345.6), R_hash=one(789.0), n_parameters=6800))
    yield Case(
        "nothing_to_code",
        dict(R_anchor=one(0), R_hash=one(0), n_parameters=0),
        ("empty",),
        expected={"bits": one(0), "L_rate": one(0)},
    )
    yield Case(
        "only_the_grid",
        dict(R_anchor=one(0), R_hash=one(5), n_parameters=0),
        ("empty", "masked"),
        expected={"bits": one(5), "L_rate": one(0)},
    )
    yield Case(
        "by_hand",
        dict(R_anchor=one(6), R_hash=one(2), n_parameters=4),
        ("zero",),
        cotangents={"bits_bar": one(0), "L_rate_bar": one(12)},
        expected={"bits": one(8), "L_rate": one(2), "R_anchor_bar": one(3), "R_hash_bar": one(3)},
    )


rate_loss = declare(
    "rate_loss",
    "17",
    "bits = R_anchor + R_hash, L_rate = bits / n_parameters",
    {"R_anchor": "", "R_hash": "", "n_parameters": "", "bits": "", "L_rate": ""},
    ("R_anchor", "R_hash"),
    forward,
    backward,
    cases,
)
