"""Cases of Eq. (2)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(4)
    x_a, x_c = rng.normal(size=(5, 3)), rng.normal(size=3)
    yield Case("ordinary", dict(x_a=x_a, x_c=x_c))
    yield Case("one_anchor", dict(x_a=x_a[:1], x_c=x_c), ("single",))
    yield Case("no_anchor", dict(x_a=x_a[:0], x_c=x_c), ("empty",))
    tilted = np.array([[2.0, -3.0, 6.0], [-6.0, 2.0, 3.0]])  # both of length 7
    for name, size in (("far", 1e200), ("near", 1e-200)):
        yield Case(
            name,
            dict(x_a=size * tilted, x_c=np.zeros(3)),
            ("extreme",),
            expected={"delta_vc": np.full((2, 1), 7 * size), "d_vc": tilted / 7},
        )
    yield Case(
        "camera_in_anchor",
        dict(x_a=np.array([[1.0, 2, 3], [1, 2, 5]]), x_c=np.array([1.0, 2, 3])),
        ("zero", "kink"),
        smooth=False,
        cotangents={
            "delta_vc_bar": np.array([[2.0], [3]]),
            "d_vc_bar": np.array([[1.0, -1, 4], [6, -8, 5]]),
        },
        expected={
            "delta_vc": np.array([[0.0], [2]]),
            "d_vc": np.array([[0.0, 0, 0], [0, 0, 1]]),
            "x_a_bar": np.array([[0.0, 0, 0], [3, -4, 3]]),
        },
    )
