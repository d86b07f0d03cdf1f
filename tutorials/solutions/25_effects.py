# %% [markdown]
# # Solutions to effects

# %%
import numpy as np
from scipy.special import expit

from p4dgs_ref import lessons
from p4dgs_ref.equations import mlp
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import PAPER_SYNTHETIC

# %% [markdown]
# **25.1** The head of $\Delta r$ disappears, which has $192\cdot 4$ weights and $4$ biases. The
# layers before it stay, because the other two heads use them.


# %%
def parameters_of_psi_d(effects):
    layers = design_of(PAPER_SYNTHETIC, effects).layers()["psi_d"]
    return sum(rows * columns + columns for rows, columns in layers)


without_rotation = [effect for effect in MODEL_EFFECTS if effect != "rotation"]
fewer = parameters_of_psi_d(MODEL_EFFECTS) - parameters_of_psi_d(without_rotation)
lessons.check_number("25.1", 192 * 4 + 4, fewer)


# %% [markdown]
# **25.2** A head of width zero returns an array of width zero. The code must look at the width
# twice: before it adds a change, and before it normalises $r$, because a quaternion that was not
# changed is not divided by its length again.


# %%
def encode(p, L):
    parts = [p]
    for j in range(L):
        parts += [np.sin(2.0**j * p), np.cos(2.0**j * p)]
    return np.concatenate(parts, axis=1)


def my_motion(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    E_t = encode(np.full((len(x), 1), t, x.dtype), L_t)
    y = np.concatenate([encode(x, L_x), E_t], axis=1)
    for W, b in zip(psi_d_weights[:-3], psi_d_biases[:-3]):
        y = np.maximum(y @ W + b, 0)
    moved = []
    heads = zip(psi_d_weights[-3:], psi_d_biases[-3:])
    for a, (W, b) in zip((x, s, r), heads):
        if W.shape[1]:
            a = a + y @ W + b
        moved.append(a)
    x_t, s_t, r_t = moved
    if psi_d_weights[-1].shape[1]:
        squared = (r_t**2).sum(axis=1, keepdims=True)
        r_t = r_t / np.sqrt(squared + 1e-24)
    return x_t, s_t, r_t


lessons.check_forward("25.2", my_motion, "temporal_prediction")


# %% [markdown]
# **25.3** The input of the network is the feature, the distance and the direction side by side.
# If the view is left out, its columns have the width zero, so the gradient is split at the widths
# of the inputs. The derivative of the sigmoid is $c\,(1 - c)$, where $1 - c$ is computed as a
# sigmoid of its own (`24_hard_cases`).


# %%
def my_color_backward(inputs, cotangents):
    names = ("f_a", "delta_vc", "d_vc")
    parts = [inputs[name] for name in names]
    side_by_side = np.concatenate(parts, axis=1)
    y, saved = mlp.forward(side_by_side, inputs["weights"], inputs["biases"])
    slope = expit(y) * expit(-y)
    y_bar = cotangents["color_bar"].reshape(y.shape) * slope
    bars = mlp.backward(saved, y_bar)
    widths = [part.shape[1] for part in parts]
    columns = np.split(bars["x"], np.cumsum(widths)[:2], axis=1)
    gradients = dict(zip(names, columns))
    gradients["weights"] = bars["weights"]
    gradients["biases"] = bars["biases"]
    return gradients


lessons.check_backward("25.3", my_color_backward, "color")

# %% [markdown]
# **Predict, then run.** None: without motion there is no $\psi_d$, in memory or in the file. The
# colour network reads the feature alone; distance and direction, four more inputs, are left out.

# %%
with_all, without = (design_of(PAPER_SYNTHETIC, of).layers() for of in (MODEL_EFFECTS, ()))
assert "psi_d" in with_all and "psi_d" not in without
assert with_all["psi_c"][0][0] - without["psi_c"][0][0] == 4
