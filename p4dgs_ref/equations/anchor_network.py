"""The part that Eqs. (3) and (4) share: a network that predicts one attribute of all children.

    psi(f_a, delta_vc, d_vc)        psi is psi_alpha, psi_c, psi_r or psi_s

P-4DGS, section 3.2 (spatial prediction). Four separate networks with the input in this order (Q3);
in HAC the order is f_a, d_vc, delta_vc.
"""

import numpy as np

from . import mlp


def forward(
    f_a,  # [A, d]  feature of each anchor
    delta_vc,  # [A, 1]  distance to the camera; [A, 0] if the scene has no view effects
    d_vc,  # [A, 3]  viewing direction; [A, 0] likewise
    weights,  # psi, d + 4 -> k width
    biases,
    width,  # []  outputs per child
):
    """Return the outputs psi [A, k, width], child by child, and what `backward` needs."""
    x = np.concatenate([f_a, delta_vc, d_vc], axis=1)
    y, saved_mlp = mlp.forward(x, weights, biases)
    A, columns = y.shape
    psi = y.reshape(A, columns // width, width)
    return psi, (saved_mlp, f_a.shape[1])


def backward(saved, psi_bar):
    """Return the gradients of f_a, delta_vc, d_vc, weights and biases."""
    saved_mlp, d = saved
    A, k, width = psi_bar.shape
    gradients = mlp.backward(saved_mlp, psi_bar.reshape(A, k * width))
    x_bar = gradients.pop("x")
    return {
        "f_a": x_bar[:, :d],
        "delta_vc": x_bar[:, d : d + 1],
        "d_vc": x_bar[:, d + 1 :],
        **gradients,
    }
