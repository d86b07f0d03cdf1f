"""Cases of D3: with and without its time net and its skip."""

import numpy as np

from p4dgs_ref.lab.baselines.d3dgs_network import deformation_layers
from tests.golden.cases import Case

# So few that 60-digit arithmetic differentiates all numbers of the ordinary case.
L_X, L_T = 1, 2
HIDDEN = (4, 3, 5)


def inputs(time_net, skip, hidden=HIDDEN, seed=8):
    """Random inputs for five Gaussians."""
    rng = np.random.default_rng(seed)
    layers = deformation_layers(L_X, L_T, hidden, (3, 3, 4), time_net, skip)

    def drawn(name):
        shapes = layers.get(name, [])
        weights = [rng.normal(size=shape) / np.sqrt(shape[0]) for shape in shapes]
        return weights, [rng.normal(size=columns) for _, columns in shapes]

    weights, biases = drawn("psi_d")
    time_weights, time_biases = drawn("psi_t")
    return dict(
        x=rng.normal(size=(5, 3)),
        t=0.37,
        weights=weights,
        biases=biases,
        time_weights=time_weights,
        time_biases=time_biases,
        L_x=L_X,
        L_t=L_T,
    )


def cases():
    yield Case("ordinary", inputs((4, 2), True))
    yield Case("no_skip", inputs((4, 2), False, (3, 5, 4, 6)), ("off",))
    yield Case("no_time_net", inputs((), True, (3, 5, 4, 6)), ("off",))
    yield Case("square_layers", inputs((), False, (4, 4)), ("off",))
