"""Cases of Eq. (3)."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_anchor_network

from . import Case, without_view


def cases():
    inputs = random_anchor_network(np.random.default_rng(3))
    biases = [*inputs["biases"][:-1], np.array([40.0, -40.0, 0.0, 400.0])]
    weights = [*inputs["weights"][:-1], 0 * inputs["weights"][-1]]
    return [
        Case("ordinary", inputs),
        Case("no_view", without_view(inputs), ("off",)),
        Case(
            "saturated",
            {**inputs, "weights": weights, "biases": biases},
            ("saturated",),
            expected={"alpha": np.tile([1.0, -1.0, 0.0, 1.0], (5, 1))},
        ),
    ]
