# %% [markdown]
# # Solutions to effects

# %%
import numpy as np
from scipy.special import expit

from p4dgs_ref.equations import mlp
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.school import lessons
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import PAPER_SYNTHETIC

# %% [markdown]
# **25.1** The head of $\Delta r$: $192\cdot 4$ weights and $4$ biases. The trunk stays, the other two heads read it.

# %%
sizes = [
    sum(i * o + o for i, o in design_of(PAPER_SYNTHETIC, effects).layers()["psi_d"])
    for effects in (MODEL_EFFECTS, [e for e in MODEL_EFFECTS if e != "rotation"])
]
lessons.number("25.1", 192 * 4 + 4, sizes[0] - sizes[1])


# %% [markdown]
# **25.2** A head of zero width gives an array of zero width. Only two places ask: does anything come back, and was $r$ touched?
# An untouched quaternion is not divided by its length again.


# %%
def encode(p, L):
    waves = [wave(2.0**j * p) for j in range(L) for wave in (np.sin, np.cos)]
    return np.concatenate([p, *waves], axis=1)


def my_motion(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    E_t = encode(np.full((1, 1), t, x.dtype), L_t)
    y = np.concatenate([encode(x, L_x), np.repeat(E_t, len(x), axis=0)], axis=1)
    for W, b in zip(psi_d_weights[:-3], psi_d_biases[:-3]):
        y = np.maximum(y @ W + b, 0)
    deltas = [y @ W + b for W, b in zip(psi_d_weights[-3:], psi_d_biases[-3:])]
    x_t, s_t, r_t = (a + delta if delta.shape[1] else a for a, delta in zip((x, s, r), deltas))
    if deltas[2].shape[1]:
        r_t = r_t / np.sqrt((r_t**2).sum(axis=1, keepdims=True) + 1e-24)
    return x_t, s_t, r_t


lessons.forward("25.2", my_motion, "temporal_prediction")


# %% [markdown]
# **25.3** The network's input is f, distance and direction side by side; an absent view has columns of zero width, and the cuts
# are made at the widths that are there. The sigmoid's slope is $c\,(1 - c)$, with $1 - c$ as a sigmoid of its own
# (`24_hard_cases`).


# %%
def my_color_backward(inputs, cotangents):
    names = ("f_a", "delta_vc", "d_vc")
    y, res = mlp.forward(
        np.concatenate([inputs[name] for name in names], axis=1),
        inputs["weights"],
        inputs["biases"],
    )
    slope = expit(y.y) * expit(-y.y)
    bars = mlp.backward(res, cotangents["color_bar"].reshape(y.y.shape) * slope)
    cuts = np.cumsum([inputs[name].shape[1] for name in names])[:2]
    return {
        **dict(zip(names, np.split(bars["x"], cuts, axis=1))),
        "weights": bars["weights"],
        "biases": bars["biases"],
    }


lessons.backward("25.3", my_color_backward, "color")
