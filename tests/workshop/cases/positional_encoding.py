"""Cases of the positional encoding in Eq. (5)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(6)
    p = rng.normal(size=(5, 2))
    return [
        Case("ordinary", dict(p=p, L=4)),
        Case("paper_width", dict(p=rng.uniform(-1.3, 1.3, size=(7, 3)), L=10), ("extreme",)),
        Case("one_time", dict(p=np.array([[0.375]]), L=6), ("single",)),
        Case("no_rows", dict(p=p[:0], L=4), ("empty",)),
        Case("no_waves", dict(p=p, L=0), ("off",), expected={"E": p}),
        Case(
            "by_hand",
            dict(p=np.array([[0.0, np.pi / 2]]), L=2),
            ("zero",),
            cotangents={"E_bar": np.array([[1.0, 2, 3, 5, 7, 11, 13, 17, 19, 23]])},
            expected={
                "E": np.array([[0, np.pi / 2, 0, 1, 1, 0, 0, 0, 1, -1]]),
                "p_bar": np.array([[1.0 + 3 + 2 * 13, 2 - 11 - 2 * 17]]),
            },
        ),
    ]
