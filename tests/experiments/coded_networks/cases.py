"""Cases of B1, the bits of a coded weight."""

import math

import numpy as np

from tests.golden.cases import Case


def cases():
    rng = np.random.default_rng(41)

    def steps(k, b):
        k, b = np.broadcast_arrays(np.array(k, float), np.array(b, float))
        return dict(w=k * 0.25, step=np.full(k.shape, 0.25), b=b.copy())

    step, b = rng.lognormal(size=7), rng.lognormal(size=7)
    ordinary = dict(w=step * b * rng.laplace(size=7), step=step, b=b)
    yield Case("ordinary", ordinary)
    yield Case("no_weights", {name: a[:0] for name, a in ordinary.items()}, ("empty",))
    yield Case("rounded", steps([0, 1, -1, 2, -7, 40], 1.3), ("zero", "negative"))
    yield Case("tail", steps([50, -50, 1000, -3e4], [0.4, 0.4, 1, 3]), ("tail", "negative"))
    yield Case("narrow", steps([0, 0.25, -3, 1e6], [1e3, 1e5, 1e9, 1e12]), ("narrow", "zero"))
    yield Case(
        "wide",
        steps([0, 0.1, -0.2], 1 / 4096),
        ("wide",),
        expected={"bits": np.zeros(3), "w_bar": np.zeros(3)},
    )
    b = np.array([0.3, 4.0])
    yield Case(
        "edge",  # both forms of p meet here, with the same value and slope, but another curvature
        steps([0.5, -0.5], b),
        ("kink", "negative"),
        smooth=False,
        cotangents={"bits_bar": np.array([1.0, 3.0])},
        expected={
            "bits": 1 - np.log2(1 - np.exp(-1 / b)),
            "w_bar": np.array([4, -12]) / b / math.log(2),
            "step_bar": -np.array([2, 6]) / b / math.log(2),
        },
    )
    yield Case("beside_the_edge", steps([0.502, -0.498], [0.3, 0.02]), ("negative",))
    yield Case("tiny_steps", {**ordinary, "w": ordinary["w"] * 2.0**-30, "step": step * 2.0**-30})
    at_zero = -math.log2(1 - math.exp(-0.5 / 0.8))
    at_two = 1.5 / 0.8 / math.log(2) + 1 - math.log2(1 - math.exp(-1 / 0.8))
    yield Case(
        "by_hand",
        steps([0, 2], 0.8),
        ("zero",),
        cotangents={"bits_bar": np.array([5.0, 2.0])},
        expected={
            "bits": np.array([at_zero, at_two]),
            "w_bar": np.array([0, 2 / 0.8 / math.log(2) / 0.25]),
            "step_bar": np.array([0, -2 * 2 / 0.8 / math.log(2) / 0.25]),
        },
    )
