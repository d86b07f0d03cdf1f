# %% [markdown]
# # Solutions to Eq. (3), masking and the network

# %%
import numpy as np

from p4dgs_ref.school import lessons

# %% [markdown]
# **03.1** The slope is $1 - 0.6^2 = 0.64$.

# %%
lessons.number("03.1", 2 * (1 - 0.6**2), 1.28)


# %% [markdown]
# **03.2** Side by side, layer by layer, a ReLU after every layer but the last, then $\tanh$.


# %%
def my_mlp(x, weights, biases):
    """What enters each layer, and the output."""
    inputs = [x]
    for W, b in zip(weights[:-1], biases[:-1]):
        inputs.append(np.maximum(inputs[-1] @ W + b, 0))
    return inputs, inputs[-1] @ weights[-1] + biases[-1]


def my_opacity(f_a, delta_vc, d_vc, weights, biases):
    return np.tanh(my_mlp(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)[1])


lessons.forward("03.2", my_opacity, "opacity")


# %% [markdown]
# **03.3** From the last layer to the first: the two gradients of the layer, then through its weights and the ReLU before it.


# %%
def my_mlp_backward(inputs, cotangents):
    entered, _ = my_mlp(**inputs)
    bar, weights_bar, biases_bar = cotangents["y_bar"], [], []
    for x, W in zip(reversed(entered), reversed(inputs["weights"])):
        weights_bar.insert(0, x.T @ bar)
        biases_bar.insert(0, bar.sum(axis=0))
        bar = bar @ W.T
        if x is not entered[0]:
            bar = bar * (x > 0)
    return {"x": bar, "weights": weights_bar, "biases": biases_bar}


lessons.backward("03.3", my_mlp_backward, "mlp")


# %% [markdown]
# **03.4** Zeros in the shape of the inputs, and the cotangents where the kept ones stand; a Boolean index keeps the order.


# %%
def my_masking_backward(inputs, cotangents):
    kept = inputs["mask"] & (inputs["alpha"] >= inputs["tau_alpha"])
    gradients = {}
    for name in ("alpha", "x", "color", "s", "r"):
        gradients[name] = np.zeros_like(inputs[name])
        gradients[name][kept] = cotangents[name + "_bar"]
    return gradients


lessons.backward("03.4", my_masking_backward, "masking")
