r"""Eq. (13): the bits of all anchors.

.. math:: R_{anchor} = \sum_a \left(-\log_2 p(\tilde f_a) - \log_2 p(\tilde O_a) - \log_2 p(\tilde l_a)
    - \log_2 p(\tilde s_a)\right)
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    R_anchor: np.ndarray  # () bits


class Res(NamedTuple):
    mask: np.ndarray  # (A, k)  the untouched input
    d: int  # width of the feature
    dtype: np.dtype


def forward(bits_f, bits_O, bits_l, bits_s, mask):
    """Sum the bits of Eq. (11) over attributes and anchors.

    Shapes     bits_f (A, d), bits_O (A, k, 3), bits_l, bits_s (A, 3), mask (A, k) bool -> R_anchor ()
    Units      bits
    Domain     bits >= 0; any A, k, d, also zero
    Raises     nothing
    Gradient   the four bits; 0 for masked offsets; linear
    Choice     Q15: masked offsets cost nothing; Q14: positions are not in this sum, though they are in the file
    Reference  P-4DGS Eq. (13)
    """
    kept = np.where(mask[:, :, None], bits_O, 0)
    # summed in float64: 1e8 float32 terms would lose the last ones
    total = sum(bits.sum(dtype=np.float64) for bits in (bits_f, kept, bits_l, bits_s))
    return Out(np.asarray(total, bits_f.dtype)), Res(mask, bits_f.shape[1], bits_f.dtype)


def backward(res, R_anchor_bar):
    shapes = {
        "bits_f": (len(res.mask), res.d),
        "bits_O": (*res.mask.shape, 3),
        "bits_l": (len(res.mask), 3),
        "bits_s": (len(res.mask), 3),
    }
    bars = {name: np.full(shape, R_anchor_bar, res.dtype) for name, shape in shapes.items()}
    bars["bits_O"][~res.mask] = 0
    return bars


def cases():
    rng = np.random.default_rng(18)
    A, k, d = 6, 5, 4
    bits = dict(
        bits_f=rng.gamma(2, size=(A, d)),
        bits_O=rng.gamma(2, size=(A, k, 3)),
        bits_l=rng.gamma(2, size=(A, 3)),
        bits_s=rng.gamma(2, size=(A, 3)),
    )
    yield Case("ordinary", dict(**bits, mask=rng.random((A, k)) < 0.7))
    yield Case(
        "all_masked",
        dict(**bits, mask=np.zeros((A, k), bool)),
        ("masked",),
        expected={
            "R_anchor": np.float64(
                bits["bits_f"].sum() + bits["bits_l"].sum() + bits["bits_s"].sum()
            )
        },
    )
    yield Case(
        "infinite_behind_the_mask",
        dict(**{**bits, "bits_O": np.full((A, k, 3), np.inf)}, mask=np.zeros((A, k), bool)),
        ("masked", "extreme"),
        smooth=False,
        expected={
            "R_anchor": np.float64(
                bits["bits_f"].sum() + bits["bits_l"].sum() + bits["bits_s"].sum()
            )
        },
    )
    yield Case(
        "no_anchor",
        dict(**{n: b[:0] for n, b in bits.items()}, mask=np.zeros((0, k), bool)),
        ("empty",),
        expected={"R_anchor": np.float64(0)},
    )


anchor_rate = declare(
    "anchor_rate",
    "13",
    "R_anchor = sum of the bits of f, O, l, s over all anchors",
    {
        "bits_f": "A d",
        "bits_O": "A k 3",
        "bits_l": "A 3",
        "bits_s": "A 3",
        "mask": "A k",
        "R_anchor": "",
    },
    ("bits_f", "bits_O", "bits_l", "bits_s"),
    forward,
    backward,
    cases,
)
