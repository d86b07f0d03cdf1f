"""Cases of Eq. (12)."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_network

from . import Case


def cases():
    rng = np.random.default_rng(17)
    weights, biases = random_network(rng, 5, 7, 22)
    inputs = dict(h=rng.normal(size=(6, 5)), weights=weights, biases=biases, widths=(2, 3, 3, 3))
    unequal = random_network(np.random.default_rng(18), 2, 12)
    return [
        Case("ordinary", inputs),
        Case(
            "unequal_groups",
            dict(h=inputs["h"][:4, :2], weights=unequal[0], biases=unequal[1], widths=(2, 1, 3)),
        ),
        Case("no_anchor", {**inputs, "h": inputs["h"][:0]}, ("empty",)),
        # by hand: groups of 1 and 2, output (mu_0, raw_0, mu_1, mu_2, raw_1, raw_2); raw on, beyond
        # and inside its clamp
        Case(
            "clamped",
            dict(
                h=np.zeros((1, 1)),
                weights=[np.zeros((1, 6))],
                widths=(1, 2),
                biases=[np.array([1.0, -14.0, 2.0, 3.0, 7.0, 0.0])],
            ),
            ("clamped", "single"),
            smooth=False,
            cotangents={
                "mu_bar": np.array([[2.0, 3.0, 5.0]]),
                "sigma_bar": np.array([[7.0, 11.0, 13.0]]),
            },
            expected={
                "mu": np.array([[1.0, 2.0, 3.0]]),
                "sigma": np.array([[np.exp(-14), np.exp(6), 1.0]]),
                "biases_bar": [np.array([2.0, 7 * np.exp(-14), 3.0, 5.0, 0.0, 13.0])],
            },
        ),
    ]
