"""Eq. (4): the scales of every anchor's k Gaussians, as fractions of the anchor's own scale.

    s_i = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc)_i)        i = 0 ... k-1

P-4DGS, section 3.2 (spatial prediction).
"""

from . import anchor_network
from .numerics import sigmoid, sigmoid_slope


def forward(
    s_a,  # [A, 3]  scale of each anchor (scene units); linear, not its logarithm (Q5)
    f_a,  # [A, d]  feature of each anchor
    delta_vc,  # [A, 1]  distance to the camera; [A, 0] if the scene has no view effects
    d_vc,  # [A, 3]  viewing direction; [A, 0] likewise
    weights,  # psi_s, d + 4 -> 3k
    biases,
):
    """Return the standard deviations s [A, k, 3] of the Gaussians and what `backward` needs."""
    psi_s, saved_network = anchor_network.forward(f_a, delta_vc, d_vc, weights, biases, width=3)
    s = s_a[:, None, :] * sigmoid(psi_s)
    return s, (s_a, psi_s, saved_network)


def backward(saved, s_bar):
    """Return the gradients of s_a, f_a, delta_vc, d_vc, weights and biases."""
    s_a, psi_s, saved_network = saved
    s_a_bar = (s_bar * sigmoid(psi_s)).sum(axis=1)  # one anchor scales all its children: sum over k
    psi_s_bar = s_bar * s_a[:, None, :] * sigmoid_slope(psi_s)
    return {"s_a": s_a_bar, **anchor_network.backward(saved_network, psi_s_bar)}
