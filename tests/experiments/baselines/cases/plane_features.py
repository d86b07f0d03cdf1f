"""Cases of H1: two levels with other lengths of every axis, and points at and beyond the faces."""

import numpy as np

from tests.golden.cases import Case

AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
LO, HI = np.array([-1.0, -2, 0]), np.array([3.0, 1, 5])


def planes(rng, levels, F):
    """Random planes, with the nodes along x, y, z and t of every level."""
    return [rng.normal(size=(n[i], n[j], F)) + 1 for n in levels for i, j in AXES]


def linear_planes():
    """Planes of one level with F = 1 whose features are linear in each coordinate.

    A bilinear reading is then exact: the feature is x y t of the box's fractions and the time.
    """
    n = (3, 4, 2, 5)
    fractions = [np.linspace(0, 1, count) for count in n]
    ones = [np.ones((n[i], n[j], 1)) for i, j in AXES]
    ones[0] = np.multiply.outer(fractions[0], fractions[1])[:, :, None]  # xy
    ones[5] = np.ones((n[2], 1, 1)) * fractions[3][None, :, None]  # zt
    return ones


def cases():
    rng = np.random.default_rng(23)
    x = LO + (HI - LO) * rng.uniform(0.02, 0.98, (7, 3))
    # So few numbers that 60-digit arithmetic differentiates all of them.
    two, one = planes(rng, ((2, 3, 4, 5), (3, 2, 3, 3)), 2), planes(rng, [(2, 2, 3, 2)], 1)
    inputs = dict(x=x, t=0.43, lo=LO, hi=HI, planes=one)
    yield Case("ordinary", {**inputs, "planes": two})
    yield Case("no_gaussians", {**inputs, "x": x[:0]}, ("empty",))
    yield Case("first_and_last_time", {**inputs, "t": 1.0}, ("outside", "single"))
    beyond = x + np.array([[0, 0, 0], [9, 0, 0], [0, -9, 0], [9, 9, 9], [-9, 0, 9]] + [[0] * 3] * 2)
    yield Case("outside", {**inputs, "x": beyond, "t": -0.5}, ("outside", "clamped"))
    # A factor is zero: the product divided by it is 0/0.
    yield Case("zeros", {**inputs, "planes": [0 * one[0], *one[1:]]}, ("zero",))
    middle = np.array([[1.0, -0.5, 2.5]])  # fractions 1/2, 1/2, 1/2
    yield Case(
        "by_hand",
        dict(x=middle, t=0.25, lo=LO, hi=HI, planes=linear_planes()),
        ("kink", "single"),  # x is on the middle node of three, where both cells have one slope
        cotangents={"features_bar": np.array([[24.0]])},
        expected={
            "features": np.array([[0.0625]]),
            "x_bar": 24 * 0.25 * np.array([[0.5 / 4, 0.5 / 3, 0]]),
        },
    )
    yield Case(
        "on_a_kink",
        dict(
            x=np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]),
            t=0.0,
            lo=np.zeros(3),
            hi=np.full(3, 2.0),
            planes=[np.array([1.0, 2, 7])[:, None, None] * np.ones((1, 3, 1))]
            + [np.ones((3, 3, 1))] * 5,
        ),
        ("kink", "outside"),  # the faces, an inner node, and beyond
        smooth=False,
        cotangents={"features_bar": np.array([[1.0], [2], [3], [4]])},
        expected={
            "features": np.array([[1.0], [2], [7], [7]]),
            "x_bar": np.array([[0.0, 0, 0], [10, 0, 0], [0, 0, 0], [0, 0, 0]]),
        },
    )
    ramp = np.array([1.0, 2, 7])[None, :, None] * np.ones((3, 1, 1))
    yield Case(
        "flat_box",
        dict(
            x=np.array([[0.5, 1, 0.5], [0.5, 2, 0.5]]),
            t=0.5,
            lo=np.array([0.0, 1, 0]),
            hi=np.array([2.0, 1, 2]),
            planes=[ramp] + [np.ones((3, 3, 1))] * 5,
        ),
        ("zero", "outside"),
        smooth=False,
        cotangents={"features_bar": np.array([[1.0], [2]])},
        expected={"features": np.array([[1.0], [7]]), "x_bar": np.zeros((2, 3))},
    )
