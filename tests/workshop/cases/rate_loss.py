"""Cases of Eq. (17)."""

from . import Case, one


def cases():
    return [
        Case("ordinary", dict(R_anchor=one(12345.6), R_hash=one(789.0), n_parameters=6800)),
        Case(
            "nothing_to_code",
            dict(R_anchor=one(0), R_hash=one(0), n_parameters=0),
            ("empty",),
            expected={"bits": one(0), "L_rate": one(0)},
        ),
        Case(
            "only_the_grid",
            dict(R_anchor=one(0), R_hash=one(5), n_parameters=0),
            ("empty", "masked"),
            expected={"bits": one(5), "L_rate": one(0)},
        ),
        Case(
            "by_hand",
            dict(R_anchor=one(6), R_hash=one(2), n_parameters=4),
            ("zero",),
            cotangents={"bits_bar": one(0), "L_rate_bar": one(12)},
            expected={
                "bits": one(8),
                "L_rate": one(2),
                "R_anchor_bar": one(3),
                "R_hash_bar": one(3),
            },
        ),
    ]
