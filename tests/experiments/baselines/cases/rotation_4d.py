"""Cases of G1."""

import numpy as np

from tests.golden.cases import Case


def cases():
    rng = np.random.default_rng(31)
    inputs = dict(raw_l=rng.normal(size=(5, 4)), raw_r=3 * rng.normal(size=(5, 4)))
    yield Case("ordinary", inputs)
    yield Case("no_gaussians", {name: a[:0] for name, a in inputs.items()}, ("empty",))
    one = np.array([[1.0, 0, 0, 0]])
    yield Case(
        "identity",
        dict(raw_l=2 * one, raw_r=0.5 * one),
        ("normalise", "single"),
        expected={"R": np.eye(4)[None]},
    )
    # The third of a turn about (1, 1, 1) sends x to y, y to z and z to x.
    third = np.array([[1.0, 1, 1, 1]])
    yield Case(
        "space_alone",
        dict(raw_l=third, raw_r=2 * third),
        ("single",),
        expected={"R": np.array([[[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]])},
    )
    yield Case(
        "left_by_i",  # i (t + xi + yj + zk) = -x + ti - zj + yk
        dict(raw_l=np.array([[0.0, 1, 0, 0]]), raw_r=one),
        ("single", "zero"),
        expected={"R": np.array([[[0.0, 0, 0, 1], [0, 0, -1, 0], [0, 1, 0, 0], [-1, 0, 0, 0]]])},
    )
    yield Case(
        "right_by_minus_i",  # (t + xi + yj + zk) conj(i) = x - ti - zj + yk
        dict(raw_l=one, raw_r=np.array([[0.0, 1, 0, 0]])),
        ("single", "zero"),
        expected={"R": np.array([[[0.0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]]])},
    )
    yield Case(
        "extreme_lengths",
        dict(raw_l=1e-9 * inputs["raw_l"], raw_r=1e9 * inputs["raw_r"]),
        ("extreme", "normalise"),
    )
    yield Case(
        "no_rotation",
        dict(raw_l=np.zeros((1, 4)), raw_r=one),
        ("normalise", "zero"),
        smooth=False,
        cotangents={"R_bar": np.eye(4)[None]},
        expected={
            "R": np.zeros((1, 4, 4)),
            "raw_l_bar": np.array([[4e12, 0, 0, 0]]),
            "raw_r_bar": np.zeros((1, 4)),
        },
    )
