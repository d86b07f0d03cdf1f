# %% [markdown]
# # Solutions to the video codec

# %%
import numpy as np

from p4dgs_ref.equations import mlp, positional_encoding
from p4dgs_ref.school import lessons

# %% [markdown]
# **26.1** Intra: $30\cdot 5000\cdot 8$ bits each second. One file: $10000\cdot 8$ bits for two seconds, however many frames are
# shown.

# %%
lessons.number("26.1", [1200, 40], [30 * 5000 * 8 / 1000, 10_000 * 8 / 1000 / 2])

# %% [markdown]
# **26.2** Shift the whole reference by each candidate and compare block by block: all blocks at once, one row for each shift.
# The frame is brighter by one everywhere; the search does not mind, for all shifts pay for it alike.

# %%
reference = np.random.default_rng(8).integers(0, 256, 64)
shifts = np.array((0, 3, 3, -2, -2, 5, 0, -7))
frame = np.concatenate([np.roll(reference, v)[8 * i : 8 * i + 8] for i, v in enumerate(shifts)]) + 1
candidates = np.arange(-8, 9)
costs = np.stack(
    [np.abs(np.roll(reference, v) - frame).reshape(8, 8).sum(axis=1) for v in candidates]
)
found = candidates[costs.argmin(axis=0)]
assert np.array_equal(found, shifts)
lessons.number("26.2", found, shifts)


# %% [markdown]
# **26.3** The heads side by side are one last layer, so the three cotangents side by side are its cotangent. E(t) is one row for
# all: repeated here, and `mlp.backward` sums over the rows. Of the input's gradient only the columns of E(x) go on.


# %%
def my_backward(inputs, cotangents):
    x, weights, biases = inputs["x"], inputs["weights"], inputs["biases"]
    E_x, res_x = positional_encoding.forward(x, inputs["L_x"])
    E_t = positional_encoding.forward(np.full((1, 1), inputs["t"], x.dtype), inputs["L_t"])[0].E
    both = np.concatenate([E_x.E, np.repeat(E_t, len(x), axis=0)], axis=1)
    heads = np.concatenate(weights[-3:], axis=1), np.concatenate(biases[-3:])
    _, res = mlp.forward(both, [*weights[:-3], heads[0]], [*biases[:-3], heads[1]])
    bars = mlp.backward(
        res, np.concatenate([cotangents[f"delta_{name}_bar"] for name in "xsr"], axis=1)
    )
    cuts = np.cumsum([W.shape[1] for W in weights[-3:]])[:2]
    return {
        "x": positional_encoding.backward(res_x, bars["x"][:, : E_x.E.shape[1]])["p"],
        "weights": [*bars["weights"][:-1], *np.split(bars["weights"][-1], cuts, axis=1)],
        "biases": [*bars["biases"][:-1], *np.split(bars["biases"][-1], cuts)],
    }


lessons.backward("26.3", my_backward, "deformation")
