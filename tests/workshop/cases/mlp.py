"""Cases of the multilayer perceptron."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_network

from . import Case


def cases():
    rng = np.random.default_rng(2)
    weights, biases = random_network(rng, 4, 6, 5, 2)
    one = [np.ones((1, 1))] * 2
    square = random_network(np.random.default_rng(3), 3, 3, 3, 2)
    return [
        Case("ordinary", dict(x=rng.normal(size=(7, 4)), weights=weights, biases=biases)),
        Case("no_rows", dict(x=np.zeros((0, 4)), weights=weights, biases=biases), ("empty",)),
        Case(
            "one_layer",
            dict(x=rng.normal(size=(7, 4)), weights=weights[:1], biases=biases[:1]),
            ("single",),
        ),
        Case(
            "square_layers",
            dict(x=rng.normal(size=(4, 3)), weights=square[0], biases=square[1]),
            ("ordinary",),
        ),
        Case(
            "at_the_kink",
            dict(x=np.array([[-1.0], [0.0], [2.0]]), weights=one, biases=[np.zeros(1)] * 2),
            ("kink",),
            smooth=False,
            cotangents={"y_bar": np.array([[5.0], [7.0], [11.0]])},
            expected={
                "y": np.array([[0.0], [0.0], [2.0]]),
                "x_bar": np.array([[0.0], [0.0], [11.0]]),
            },
        ),
    ]
