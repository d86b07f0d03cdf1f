"""Cases of H3."""

import numpy as np

from tests.golden.cases import Case


def cases():
    rng = np.random.default_rng(25)
    shapes = [(2, 3), (2, 4), (3, 4), (2, 5), (3, 5), (4, 5), (3, 2), (3, 4), (2, 4)] + [(2, 3)] * 3
    ordinary = [rng.normal(size=(*shape, 2)) + 1 for shape in shapes]
    yield Case("ordinary", dict(planes=ordinary))
    pair, one = np.array([[[3.0], [5.0]]]), np.array([[[3.0]]])
    short = [pair, one, one] + [np.array([[[1.5], [4.0]]])] * 3
    no_slopes = [np.zeros_like(plane) for plane in short]
    yield Case(
        "too_short",
        dict(planes=short),
        ("single",),
        cotangents={"L_space_bar": np.array(1.0), "L_time_bar": np.array(1.0)},
        expected={
            "L_space": np.array(4.0),
            "L_time": np.array(0.0),
            "L_one": np.array(3 * 1.75),
            "planes_bar": [np.array([[[-4.0], [4.0]]]), *no_slopes[1:]],
        },
    )
    i, j = np.indices((4, 5))
    ramp, ones = (3.0 * i - 2 * j)[:, :, None], np.ones((4, 5, 1))
    square, blank = (1.0 + j * j)[:, :, None], np.zeros((4, 5, 1))
    yield Case(
        "by_hand",  # a ramp has the slopes 3 and -2; j^2 has the second difference 2
        dict(planes=[ramp, ones, ones, square, ones, ones]),
        ("kink",),
        smooth=False,  # some numbers are 1, where |P - 1| has a kink
        cotangents={"L_one_bar": np.array(20.0)},
        expected={
            "L_space": np.array(13.0),
            "L_time": np.array(4.0),
            "L_one": np.array(6.0),
            "planes_bar": [blank, blank, blank, np.sign(square - 1), blank, blank],
        },
    )
