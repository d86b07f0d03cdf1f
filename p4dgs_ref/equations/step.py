"""Eq. (8): the quantisation steps of every anchor, predicted from its hash feature.

    q = Q_0 * (1 + tanh(psi_q(h)))

P-4DGS, section 3.3 (adaptive quantisation). Computed as 2 Q_0 sigmoid(2 psi_q), which is the same
number but keeps its digits where tanh is close to -1. It is never below 2**-10 Q_0, so that f / q
stays finite (Q7).
"""

import numpy as np

from . import mlp
from .numerics import sigmoid, sigmoid_slope

SMALLEST = 2.0**-10  # of Q_0


def forward(
    h,  # [A, I]  hash feature of each anchor
    weights,  # psi_q, I -> G
    biases,
    Q_0,  # [G]  base step of each attribute group f, s, l, O (units of the attribute)
):
    """Return the steps q [A, G] and what `backward` needs.

    On the floor the gradient is zero.
    """
    psi_q, saved_mlp = mlp.forward(h, weights, biases)
    share = 2 * sigmoid(2 * psi_q)
    q = Q_0 * np.maximum(share, SMALLEST)
    slope = np.where(share > SMALLEST, 4 * Q_0 * sigmoid_slope(2 * psi_q), 0)
    return q, (slope, saved_mlp)


def backward(saved, q_bar):
    """Return the gradients of h, weights and biases; Q_0 is data."""
    slope, saved_mlp = saved
    gradients = mlp.backward(saved_mlp, q_bar * slope)
    return {"h": gradients.pop("x"), **gradients}
