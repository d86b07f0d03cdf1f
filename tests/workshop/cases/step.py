"""Cases of Eq. (8)."""

import numpy as np

from p4dgs_ref.equations.step import SMALLEST
from p4dgs_ref.lab.random_inputs import random_network

from . import Case


def cases():
    rng = np.random.default_rng(13)
    weights, biases = random_network(rng, 5, 7, 4)
    inputs = dict(
        h=rng.normal(size=(6, 5)),
        weights=weights,
        biases=biases,
        Q_0=np.array([1.0, 0.001, 0.002, 0.2]),
    )
    yield Case("ordinary", inputs)
    yield Case("no_anchor", {**inputs, "h": inputs["h"][:0]}, ("empty",))
    flat = dict(h=np.zeros((1, 5)), weights=[np.zeros((5, 4))], Q_0=np.ones(4))
    # by hand: psi_q = 0 gives Q_0; tanh(1); on the floor; far below it
    yield Case(
        "saturated",
        {**flat, "biases": [np.array([0.0, 1.0, -10.0, -1e4])]},
        ("saturated", "clamped"),
        smooth=False,
        cotangents={"q_bar": np.array([[2.0, 3.0, 5.0, 7.0]])},
        expected={
            "q": np.array([[1.0, 1.7615941559557649, SMALLEST, SMALLEST]]),
            "biases_bar": [np.array([2.0, 3 * 0.41997434161402607, 0.0, 0.0])],
        },
    )
    # 1 - tanh^2 is 0 in floats from 19 on; the slope is 4 exp(-2u)
    yield Case(
        "large",
        {**flat, "biases": [np.array([20.0, 30, 400, 1e4])]},
        ("saturated", "extreme"),
        smooth=False,
        cotangents={"q_bar": np.array([[0.0, 5.0, 7.0, 11.0]])},
        expected={"q": np.full((1, 4), 2.0), "biases_bar": [np.array([0, 20 * np.exp(-60), 0, 0])]},
    )
