"""H2: from the features of a Gaussian at time t to its movement, stretching and turning.

    h = relu(phi(features))
    (delta_x, delta_log_s, delta_raw_r) = (phi_x(h), phi_s(h), phi_r(h))

Wu et al. 2024 (4DGaussians). phi merges the features of all levels. phi_x, phi_s and phi_r are the
heads, of two layers each. The deltas are added to the stored numbers, before D1. The authors have
heads for opacity and colour, too, which are off in their settings for D-NeRF; they are left out.
"""

import numpy as np

from p4dgs_ref.equations import mlp

HEADS = (3, 3, 4)  # columns of phi_x, phi_s and phi_r


def forward(
    features,  # [N, K]  of H1
    weights,  # psi, K -> 4; the layers of phi, then two each of phi_x, phi_s and phi_r
    biases,
):
    """Return delta_x [N, 3], delta_log_s [N, 3], delta_raw_r [N, 4] and what `backward` needs."""
    trunk = len(weights) - 2 * len(HEADS)
    before, saved_trunk = mlp.forward(features, weights[:trunk], biases[:trunk])
    h = np.maximum(before, 0)
    heads = [
        mlp.forward(h, weights[i : i + 2], biases[i : i + 2]) for i in range(trunk, len(weights), 2)
    ]
    deltas, saved_heads = zip(*heads)
    return deltas, (saved_trunk, before, saved_heads)


def backward(saved, delta_x_bar, delta_log_s_bar, delta_raw_r_bar):
    """Gradients of features, weights and biases; a ReLU has slope 0 at 0, as in `mlp`."""
    saved_trunk, before, saved_heads = saved
    bars = delta_x_bar, delta_log_s_bar, delta_raw_r_bar
    heads = [mlp.backward(saved_head, bar) for saved_head, bar in zip(saved_heads, bars)]
    h_bar = sum(head["x"] for head in heads)
    trunk = mlp.backward(saved_trunk, h_bar * (before > 0))
    return {
        "features": trunk["x"],
        "weights": [W for network in (trunk, *heads) for W in network["weights"]],
        "biases": [b for network in (trunk, *heads) for b in network["biases"]],
    }
