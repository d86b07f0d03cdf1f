"""Eq. (3) by analogy: the colours of every anchor's k Gaussians.

    color_i = sigmoid(psi_c(f_a, delta_vc, d_vc)_i)        i = 0 ... k-1

P-4DGS, section 3.2: "the color c and rotation r attributes are predicted analogously". The sigmoid
is the activation of its parent, Scaffold-GS (Q4).
"""

from . import anchor_network
from .numerics import sigmoid, sigmoid_slope


def forward(
    f_a,  # [A, d]  feature of each anchor
    delta_vc,  # [A, 1]  distance to the camera; [A, 0] if the scene has no view effects
    d_vc,  # [A, 3]  viewing direction; [A, 0] likewise
    weights,  # psi_c, d + 4 -> 3k
    biases,
):
    """Return color [A, k, 3], red, green and blue in [0, 1], and what `backward` needs."""
    psi_c, saved_network = anchor_network.forward(f_a, delta_vc, d_vc, weights, biases, width=3)
    return sigmoid(psi_c), (psi_c, saved_network)


def backward(saved, color_bar):
    """Return the gradients of f_a, delta_vc, d_vc, weights and biases."""
    psi_c, saved_network = saved
    return anchor_network.backward(saved_network, color_bar * sigmoid_slope(psi_c))
