"""Eq. (3): the opacities of every anchor's k Gaussians.

    alpha_i = tanh(psi_alpha(f_a, delta_vc, d_vc)_i)        i = 0 ... k-1

P-4DGS, section 3.2 (spatial prediction). The paper prints psi_alpha alone; the tanh is the
activation of its parent, Scaffold-GS (Q4).
"""

import numpy as np

from . import anchor_network
from .numerics import tanh_slope


def forward(
    f_a,  # [A, d]  feature of each anchor
    delta_vc,  # [A, 1]  distance to the camera; [A, 0] if the scene has no view effects
    d_vc,  # [A, 3]  viewing direction; [A, 0] likewise
    weights,  # psi_alpha, d + 4 -> k
    biases,
):
    """Return the opacities alpha [A, k] in [-1, 1] and what `backward` needs.

    Gaussians whose opacity is below tau_alpha are dropped afterwards, by `masking`.
    """
    psi_alpha, saved_network = anchor_network.forward(f_a, delta_vc, d_vc, weights, biases, width=1)
    alpha = np.tanh(psi_alpha[:, :, 0])
    return alpha, (psi_alpha, saved_network)


def backward(saved, alpha_bar):
    """Return the gradients of f_a, delta_vc, d_vc, weights and biases."""
    psi_alpha, saved_network = saved
    psi_alpha_bar = alpha_bar[:, :, None] * tanh_slope(psi_alpha)
    return anchor_network.backward(saved_network, psi_alpha_bar)
