"""psi_d as D3DGS builds it: Eq. (5) with a network for the time and a skip.

    (delta_x, delta_s, delta_r) = psi_d(concat(E(x), psi_t(E(t))))

Yang et al. 2024 (D3DGS). With three hidden layers this is the reading of the paper whose size comes
nearest to its table (Q1); the presets use `deformation`. The skip gives concat(E(x), psi_t(E(t)))
once more to the layer after the middle one. `skip_layer` finds it from the weights' shapes.
"""

import numpy as np

from p4dgs_ref.equations import mlp, positional_encoding


def deformation_layers(L_x, L_t, widths, heads, time_net=(), skip=False):
    """The shapes of psi_d, which ends with its heads, and of psi_t where there is a time net."""
    time = (1 + 2 * L_t, *time_net)
    inputs = 3 * (1 + 2 * L_x) + time[-1]
    trunk = [*zip((inputs, *widths), widths)]
    if skip:
        after = len(trunk) // 2 + 1
        rows, columns = trunk[after]
        trunk[after] = inputs + rows, columns
    layers = {"psi_d": trunk + [(widths[-1], head) for head in heads]}
    if time_net:
        layers["psi_t"] = [*zip(time[:-1], time[1:])]
    return layers


def forward(
    x,  # [N, 3]  canonical centres (scene units)
    t,  # []  normalised time, converted to the precision of x
    weights,  # psi_d, hidden layers, then the three heads
    biases,
    time_weights,  # psi_t, 1 + 2 L_t -> its output; empty lists where E(t) itself is the input
    time_biases,
    L_x,  # []  frequencies of E(x) (Q2)
    L_t,  # []  frequencies of E(t)
):
    """Return delta_x [N, 3], delta_s [N, 3], delta_r [N, 4] and what `backward` needs."""
    E_x, _ = positional_encoding.forward(x, L_x)
    seen_time, _ = positional_encoding.forward(np.full((1, 1), t, dtype=x.dtype), L_t)
    saved_time = saved_before = hidden = None
    if time_weights:
        seen_time, saved_time = mlp.forward(seen_time, time_weights, time_biases)
    every_row = np.broadcast_to(seen_time, (len(x), seen_time.shape[1]))
    inputs = entering = np.concatenate([E_x, every_row], axis=1)
    skip = skip_layer(weights)
    if skip:
        before, saved_before = mlp.forward(inputs, weights[:skip], biases[:skip])
        hidden = np.maximum(before, 0)
        entering = np.concatenate([inputs, hidden], axis=1)
    heads, head_biases = np.concatenate(weights[-3:], axis=1), np.concatenate(biases[-3:])
    y, saved_after = mlp.forward(
        entering, [*weights[skip:-3], heads], [*biases[skip:-3], head_biases]
    )
    cuts = np.cumsum([W.shape[1] for W in weights[-3:-1]])  # where one head's columns end
    saved = saved_time, saved_before, hidden, saved_after, cuts
    return tuple(np.split(y, cuts, axis=1)), (*saved, E_x.shape[1], inputs.shape[1])


def skip_layer(weights):
    """The hidden layer that takes the inputs once more, or 0 where there is none."""
    hidden = weights[:-3]
    wider = [i for i in range(1, len(hidden)) if len(hidden[i]) > hidden[i - 1].shape[1]]
    return wider[0] if wider else 0


def backward(saved, delta_x_bar, delta_s_bar, delta_r_bar):
    """Gradients of weights, biases, time_weights and time_biases; t is data.

    So is x, because the pipeline lets no gradient flow from E(x) back into x (Q10).
    """
    saved_time, saved_before, hidden, saved_after, cuts, width_x, width = saved
    y_bar = np.concatenate([delta_x_bar, delta_s_bar, delta_r_bar], axis=1)
    after = mlp.backward(saved_after, y_bar)
    weights_bar, biases_bar = after["weights"], after["biases"]
    weights_bar[-1:] = np.split(weights_bar[-1], cuts, axis=1)
    biases_bar[-1:] = np.split(biases_bar[-1], cuts)
    inputs_bar = after["x"][:, :width]
    if saved_before:
        before = mlp.backward(saved_before, after["x"][:, width:] * (hidden > 0))
        inputs_bar = inputs_bar + before["x"]
        weights_bar, biases_bar = before["weights"] + weights_bar, before["biases"] + biases_bar
    time = {"weights": [], "biases": []}
    if saved_time:
        seen_time_bar = inputs_bar[:, width_x:].sum(axis=0, keepdims=True)  # every row saw it
        time = mlp.backward(saved_time, seen_time_bar, needs_x=False)
    return {
        "weights": weights_bar,
        "biases": biases_bar,
        "time_weights": time["weights"],
        "time_biases": time["biases"],
    }
