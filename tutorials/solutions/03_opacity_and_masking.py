# %% [markdown]
# # Solutions to Eq. (3), masking and the network

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import masking, opacity

# %% [markdown]
# **03.1** The slope of $\tanh$ is $1 - 0.6^2 = 0.64$, so $\bar\psi = 2\cdot 0.64$.

# %%
lessons.check_number("03.1", 2 * (1 - 0.6**2), 1.28)


# %% [markdown]
# **03.2** Put the inputs side by side, apply the layers with a ReLU after every layer except the
# last, then take the $\tanh$.


# %%
def my_mlp(x, weights, biases):
    """Return the inputs of all layers as a list, and the output."""
    inputs = [x]
    for W, b in zip(weights[:-1], biases[:-1]):
        inputs.append(np.maximum(inputs[-1] @ W + b, 0))
    return inputs, inputs[-1] @ weights[-1] + biases[-1]


def my_opacity(f_a, delta_vc, d_vc, weights, biases):
    x = np.concatenate([f_a, delta_vc, d_vc], axis=1)
    _, psi = my_mlp(x, weights, biases)
    return np.tanh(psi)


lessons.check_forward("03.2", my_opacity, "opacity")


# %% [markdown]
# **03.3** Go from the last layer to the first. In each layer compute the two gradients, then pass
# the cotangent back through the weights and through the ReLU in front of the layer.


# %%
def my_mlp_backward(inputs, cotangents):
    inputs_of_layers, _ = my_mlp(**inputs)
    bar = cotangents["y_bar"]
    weights_bar = []
    biases_bar = []
    for i in reversed(range(len(inputs_of_layers))):
        weights_bar.insert(0, inputs_of_layers[i].T @ bar)
        biases_bar.insert(0, bar.sum(axis=0))
        bar = bar @ inputs["weights"][i].T
        if i > 0:
            bar = bar * (inputs_of_layers[i] > 0)
    return {"x": bar, "weights": weights_bar, "biases": biases_bar}


lessons.check_backward("03.3", my_mlp_backward, "mlp")


# %% [markdown]
# **03.4** Start from zeros in the shape of each input, and write the cotangents to the places of
# the kept Gaussians. A Boolean index visits these places in the order of the list.


# %%
def my_masking_backward(inputs, cotangents):
    kept = inputs["mask"] & (inputs["alpha"] >= inputs["tau_alpha"])
    gradients = {}
    for name in ("x", "s", "r", "alpha", "color"):
        gradients[name] = np.zeros_like(inputs[name])
        gradients[name][kept] = cotangents[name + "_bar"]
    return gradients


lessons.check_backward("03.4", my_masking_backward, "masking")

# %% [markdown]
# **Predict, then run.** The gradient is zero: a Gaussian that is not in the list has no cotangent,
# and `masking` fills its place with zeros. This anchor's feature learns nothing from the picture.
# The anchor may come back all the same, because the network is shared: below, a step of descent for
# the children of another anchor also changes the opacities of the anchor that is not drawn.

# %%
feature, last = np.array([[1.0, 0.5], [0.4, 1.0]]), np.array([[0.5, 0.2], [-0.6, -0.3]])
no_view = np.zeros((2, 0))
alpha, network = opacity.forward(feature, no_view, no_view, [last], [np.zeros(2)])
assert (alpha[0] > 0.01).all() and (alpha[1] < 0.01).all()
triples = np.ones((2, 2, 3))
mask = np.ones((2, 2), bool)
kept, saved = masking.forward(triples, triples, np.ones((2, 2, 4)), alpha, triples, mask, 0.01)
bars = [-np.ones_like(array) for array in kept[:5]]  # the picture wants the visible ones brighter
gradients = opacity.backward(network, masking.backward(saved, *bars)["alpha"])
assert gradients["f_a"][0].any() and not gradients["f_a"][1].any()
stepped = [last - gradients["weights"][0]], [-gradients["biases"][0]]
after, _ = opacity.forward(feature, no_view, no_view, *stepped)
assert (after[1] > 0.01).all()
