"""Eq. (3) by analogy: the rotations of every anchor's k Gaussians, as unit quaternions.

    r_i = psi_r(f_a, delta_vc, d_vc)_i / |psi_r(f_a, delta_vc, d_vc)_i|        i = 0 ... k-1

P-4DGS, section 3.2: "the color c and rotation r attributes are predicted analogously". Computed
with the norm sqrt(|psi_r|**2 + 1e-24), so that psi_r = 0 gives r = 0 and a finite slope (Q4).
"""

from . import anchor_network
from .numerics import normalise, normalise_backward


def forward(
    f_a,  # [A, d]  feature of each anchor
    delta_vc,  # [A, 1]  distance to the camera; [A, 0] if the scene has no view effects
    d_vc,  # [A, 3]  viewing direction; [A, 0] likewise
    weights,  # psi_r, d + 4 -> 4k
    biases,
):
    """Return the quaternions r [A, k, 4] in the order w, x, y, z and what `backward` needs."""
    psi_r, saved_network = anchor_network.forward(f_a, delta_vc, d_vc, weights, biases, width=4)
    r, norm = normalise(psi_r)
    return r, (r, norm, saved_network)


def backward(saved, r_bar):
    """Return the gradients of f_a, delta_vc, d_vc, weights and biases."""
    r, norm, saved_network = saved
    return anchor_network.backward(saved_network, normalise_backward(r, norm, r_bar))
