"""Cases of Eq. (1)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(1)
    x_a, O_a, l_a = rng.normal(size=(5, 3)), rng.normal(size=(5, 4, 3)), rng.lognormal(size=(5, 3))
    return [
        Case("ordinary", dict(x_a=x_a, O_a=O_a, l_a=l_a)),
        Case(
            "zero_reach",
            dict(x_a=x_a, O_a=O_a, l_a=0 * l_a),
            ("zero",),
            expected={"x": np.repeat(x_a[:, None], 4, axis=1)},
        ),
        Case("one_child", dict(x_a=x_a, O_a=O_a[:, :1], l_a=-l_a), ("single", "negative")),
        Case(
            "by_hand",
            dict(
                x_a=np.array([[1.0, 0, 0]]),
                O_a=np.array([[[1.0, 0, 0], [0, 0, -1.0]]]),
                l_a=np.array([[0.5, 0.5, 2.0]]),
            ),
            ("single",),
            cotangents={"x_bar": np.array([[[0, 0, 0], [0, 0, 3.0]]])},
            expected={
                "x": np.array([[[1.5, 0, 0], [1, 0, -2.0]]]),
                "l_a_bar": np.array([[0, 0, -3.0]]),
            },
        ),
    ]
