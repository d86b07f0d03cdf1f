"""Cases of Eq. (4)."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_anchor_network

from . import Case, without_view


def cases():
    rng = np.random.default_rng(9)
    inputs = dict(
        s_a=rng.lognormal(size=(6, 3)), **random_anchor_network(rng, A=6, d=2, k=5, outputs=3)
    )
    yield Case("ordinary", inputs)
    yield Case("no_view", without_view(inputs), ("off",))
    yield Case(
        "no_anchor", {n: a if isinstance(a, list) else a[:0] for n, a in inputs.items()}, ("empty",)
    )
    yield Case("negative", {**inputs, "s_a": -inputs["s_a"]}, ("negative",))
    yield Case(
        "flat", {**inputs, "s_a": 0 * inputs["s_a"]}, ("zero",), expected={"s": np.zeros((6, 5, 3))}
    )
    weights = [*inputs["weights"][:-1], 0 * inputs["weights"][-1]]
    for name, psi, exact in (("needle", -40.0, np.exp(-40.0)), ("full", 800.0, 1.0)):
        yield Case(
            name,
            {**inputs, "weights": weights, "biases": [*inputs["biases"][:-1], np.full(15, psi)]},
            ("saturated",),
            expected={"s": np.repeat(inputs["s_a"][:, None] * exact, 5, axis=1)},
        )
