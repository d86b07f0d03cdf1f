"""Random inputs of typical size: for what the laboratory measures, for tutorials and for tests."""

import numpy as np


def random_network(rng, *widths):
    """Return weights and biases of an MLP whose activations are of order one."""
    pairs = list(zip(widths[:-1], widths[1:]))
    weights = [rng.normal(size=pair) / np.sqrt(max(pair[0], 1)) for pair in pairs]
    return weights, [rng.normal(size=n) * 0.3 for _, n in pairs]


def random_field(rng, L_x, L_t, *hidden, heads=(3, 3, 4)):
    """Return inputs of the deformation network: hidden layers and three heads, L_x, L_t."""
    weights, biases = random_network(rng, 3 * (1 + 2 * L_x) + 1 + 2 * L_t, *hidden, sum(heads))
    cuts = np.cumsum(heads[:2])
    weights[-1:] = np.split(weights[-1], cuts, axis=1)
    biases[-1:] = np.split(biases[-1], cuts)
    return dict(weights=weights, biases=biases, L_x=L_x, L_t=L_t)


def random_anchor_network(rng, A=5, d=2, k=4, outputs=1, hidden=(7, 6)):
    """Return inputs of an anchor network (Eqs. 3 and 4): features, view, weights and biases."""
    d_vc = rng.normal(size=(A, 3))
    weights, biases = random_network(rng, d + 4, *hidden, k * outputs)
    return dict(
        f_a=rng.normal(size=(A, d)),
        delta_vc=rng.uniform(1, 5, size=(A, 1)),
        d_vc=d_vc / np.linalg.norm(d_vc, axis=1, keepdims=True),
        weights=weights,
        biases=biases,
    )
