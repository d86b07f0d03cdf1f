"""Cases of the rotations, by analogy with Eq. (3)."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_anchor_network

from . import Case, without_view


def cases():
    inputs = random_anchor_network(np.random.default_rng(8), A=6, d=2, k=5, outputs=4)
    yield Case("ordinary", inputs)
    yield Case("no_view", without_view(inputs), ("off",))
    yield Case(
        "no_anchor", {n: a if isinstance(a, list) else a[:0] for n, a in inputs.items()}, ("empty",)
    )
    yield Case(
        "long",
        {**inputs, "weights": [*inputs["weights"][:-1], 1e30 * inputs["weights"][-1]]},
        ("normalise", "extreme"),
    )
    # psi_r is the bias alone. (1, 2, 2, 4) has length 5; at zero the slope is 1 / EPSILON.
    one = dict(
        f_a=np.ones((1, 1)),
        delta_vc=np.ones((1, 1)),
        d_vc=np.zeros((1, 3)),
        weights=[np.zeros((5, 4))],
    )
    yield Case(
        "by_hand",
        {**one, "biases": [np.array([1.0, 2, 2, 4])]},
        ("normalise", "single"),
        cotangents={"r_bar": np.array([[[50.0, 0, 0, 0]]])},
        expected={
            "r": np.array([[[0.2, 0.4, 0.4, 0.8]]]),
            "biases_bar": [np.array([9.6, -0.8, -0.8, -1.6])],
        },
    )
    yield Case(
        "zero_quaternion",
        {**one, "biases": [np.zeros(4)]},
        ("normalise", "zero"),
        smooth=False,
        cotangents={"r_bar": np.array([[[3.0, -5, 7, 11]]])},
        expected={"r": np.zeros((1, 1, 4)), "biases_bar": [np.array([3e12, -5e12, 7e12, 11e12])]},
    )
