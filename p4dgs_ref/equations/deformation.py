"""Eq. (5): how far every canonical Gaussian has moved, stretched and turned at time t.

    (delta_x, delta_s, delta_r) = psi_d(concat(E(x), E(t)))

P-4DGS, section 3.2 (temporal prediction). psi_d has two hidden layers and three linear heads (Q1).
All rows share t, so the product of E(t) with its part of the first weight is computed once and
added to the bias; the three heads are computed side by side as one last layer.
"""

import numpy as np

from . import mlp, positional_encoding


def forward(
    x,  # [N, 3]  canonical centres (scene units)
    t,  # []  normalised time, converted to the precision of x
    weights,  # psi_d, 3 (1 + 2 L_x) + 1 + 2 L_t -> 3 | 3 | 4, hidden layers, then the heads
    biases,
    L_x,  # []  frequencies of E(x) (Q2)
    L_t,  # []  frequencies of E(t)
):
    """Return delta_x [N, 3], delta_s [N, 3], delta_r [N, 4] and what `backward` needs.

    An effect that the scene does not list has a head of width 0 and an output [N, 0].
    """
    E_x, saved_encoding = positional_encoding.forward(x, L_x)
    E_t, _ = positional_encoding.forward(np.full((1, 1), t, dtype=x.dtype), L_t)
    layers = [*weights[:-3], np.concatenate(weights[-3:], axis=1)]
    layer_biases = [*biases[:-3], np.concatenate(biases[-3:])]
    layers[0], from_t = np.split(layers[0], [E_x.shape[1]])
    layer_biases[0] = layer_biases[0] + (E_t @ from_t)[0]
    y, saved_mlp = mlp.forward(E_x, layers, layer_biases)
    cuts = np.cumsum([W.shape[1] for W in weights[-3:-1]])  # where one head's columns end
    return tuple(np.split(y, cuts, axis=1)), (saved_encoding, E_t, saved_mlp, cuts)


def backward(saved, delta_x_bar, delta_s_bar, delta_r_bar, needs_x=True):
    """Return the gradients of x, weights and biases; t is data.

    `needs_x=False` leaves x out: the pipeline lets no gradient flow from E(x) back into x (Q10).
    """
    saved_encoding, E_t, saved_mlp, cuts = saved
    y_bar = np.concatenate([delta_x_bar, delta_s_bar, delta_r_bar], axis=1)
    gradients = mlp.backward(saved_mlp, y_bar, needs_x)
    weights_bar, biases_bar = gradients["weights"], gradients["biases"]
    from_t_bar = np.outer(E_t, biases_bar[0])  # every row saw the same E(t)
    weights_bar[0] = np.concatenate([weights_bar[0], from_t_bar])
    weights_bar[-1:] = np.split(weights_bar[-1], cuts, axis=1)
    biases_bar[-1:] = np.split(biases_bar[-1], cuts)
    if needs_x:
        gradients["x"] = positional_encoding.backward(saved_encoding, gradients["x"])["p"]
    return gradients
