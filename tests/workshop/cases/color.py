"""Cases of the colours, by analogy with Eq. (3)."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_anchor_network

from . import Case, without_view


def cases():
    inputs = random_anchor_network(np.random.default_rng(7), A=6, d=2, k=5, outputs=3)
    yield Case("ordinary", inputs)
    yield Case("no_view", without_view(inputs), ("off",))
    yield Case(
        "one_anchor",
        {n: a if isinstance(a, list) else a[:1] for n, a in inputs.items()},
        ("single",),
    )
    yield Case(
        "no_anchor", {n: a if isinstance(a, list) else a[:0] for n, a in inputs.items()}, ("empty",)
    )
    # All logits are psi. The form 1 / (1 + exp(-psi)) overflows at -800, and
    # (1 + tanh(psi / 2)) / 2 is exactly zero at -40.
    weights = [*inputs["weights"][:-1], 0 * inputs["weights"][-1]]
    for name, psi, exact in (
        ("dark", -40.0, np.exp(-40.0)),
        ("black", -800.0, 0.0),
        ("white", 800.0, 1.0),
    ):
        yield Case(
            name,
            {**inputs, "weights": weights, "biases": [*inputs["biases"][:-1], np.full(15, psi)]},
            ("saturated",),
            expected={"color": np.full((6, 5, 3), exact)},
        )
