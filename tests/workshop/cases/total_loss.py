"""Cases of Eq. (15)."""

from . import Case, one


def cases():
    return [
        Case("ordinary", dict(L_render=one(0.07), L_rate=one(2.4), lambda_rate=1e-3)),
        Case(
            "no_rate",
            dict(L_render=one(0.07), L_rate=one(2.4), lambda_rate=0.0),
            ("zero",),
            cotangents={"L_total_bar": one(5)},
            expected={"L_total": one(0.07), "L_rate_bar": one(0), "L_render_bar": one(5)},
        ),
        Case(
            "rate_alone",
            dict(L_render=one(0), L_rate=one(2.0), lambda_rate=1e6),
            ("extreme",),
            expected={"L_total": one(2e6)},
        ),
    ]
