"""Cases of Eq. (13)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(18)
    A, k, d = 6, 5, 4
    bits = dict(
        bits_f=rng.gamma(2, size=(A, d)),
        bits_O=rng.gamma(2, size=(A, k, 3)),
        bits_l=rng.gamma(2, size=(A, 3)),
        bits_s=rng.gamma(2, size=(A, 3)),
    )
    return [
        Case("ordinary", dict(**bits, mask=rng.random((A, k)) < 0.7)),
        Case(
            "all_masked",
            dict(**bits, mask=np.zeros((A, k), bool)),
            ("masked",),
            expected={
                "R_anchor": np.float64(
                    bits["bits_f"].sum() + bits["bits_l"].sum() + bits["bits_s"].sum()
                )
            },
        ),
        Case(
            "infinite_behind_the_mask",
            dict(**{**bits, "bits_O": np.full((A, k, 3), np.inf)}, mask=np.zeros((A, k), bool)),
            ("masked", "extreme"),
            smooth=False,
            expected={
                "R_anchor": np.float64(
                    bits["bits_f"].sum() + bits["bits_l"].sum() + bits["bits_s"].sum()
                )
            },
        ),
        Case(
            "no_anchor",
            dict(**{n: b[:0] for n, b in bits.items()}, mask=np.zeros((0, k), bool)),
            ("empty",),
            expected={"R_anchor": np.float64(0)},
        ),
    ]
