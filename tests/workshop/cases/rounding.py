"""Cases of Eq. (10)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(15)
    ties = np.array([[-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, -0.0]])
    even = np.array([[-2, -2, 0, 0, 2, 2, 0]])
    # A third beside a tie, of numbers that float32 holds; its quotient of them is that tie.
    thirds = np.array([[12582914.0, 12582916.0, -12582914.0, -12582916.0]])
    near = np.array([[np.nextafter(0.5, 0), 0.5, np.nextafter(0.5, 1), np.nextafter(1.5, 0)]])
    return [
        Case("ordinary", dict(f=rng.normal(size=(6, 5)) * 3, q=rng.lognormal(size=(6, 1)))),
        Case(
            "ties",
            dict(f=ties * 0.25, q=np.array([[0.25]])),
            ("tie", "single"),
            expected={"symbols": even, "f_hat": even * 0.25},
            tolerance=0,
        ),
        Case(
            "beside_ties",
            dict(f=near, q=np.ones((1, 1))),
            ("tie", "single"),
            expected={"symbols": np.array([[0, 0, 1, 1]])},
            tolerance=0,
        ),
        Case(
            "large",
            dict(f=np.array([[2.0**29, -(2.0**29)]]), q=np.array([[0.5]])),
            ("extreme", "single"),
            expected={"symbols": np.array([[2**30, -(2**30)]])},
            tolerance=0,
        ),
        Case(
            "float32_inputs",
            dict(f=thirds, q=np.array([[3.0]])),
            ("tie", "single"),
            expected={"symbols": np.array([[4194305, 4194305, -4194305, -4194305]])},
            tolerance=0,
        ),
        Case("no_anchor", dict(f=np.zeros((0, 5)), q=np.zeros((0, 1))), ("empty",)),
    ]
