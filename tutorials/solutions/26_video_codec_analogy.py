# %% [markdown]
# # Solutions to the video codec

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import mlp, positional_encoding

# %% [markdown]
# **26.1** Intra takes $30\cdot 5000\cdot 8$ bits in each second. The inter file takes
# $10000\cdot 8$ bits for two seconds, however many frames are shown.

# %%
intra = 30 * 5000 * 8 / 1000
inter = 10_000 * 8 / 1000 / 2
lessons.check_number("26.1", [1200, 40], [intra, inter])

# %% [markdown]
# **26.2** Shift the whole reference by each candidate and sum the errors of each block; this
# gives one row of eight sums for each shift. That the frame is brighter by one everywhere does
# not disturb the search, because it adds about the same error for all shifts.

# %%
rng = np.random.default_rng(8)
reference = rng.integers(0, 256, 64)
frame = np.ones(64, int)
vectors = np.zeros(8, int)
for i in range(8):
    block = slice(8 * i, 8 * i + 8)
    vectors[i] = rng.integers(-8, 9) if i else 0
    frame[block] += np.roll(reference, vectors[i])[block]
candidates = np.arange(-8, 9)
errors = []
for v in candidates:
    difference = np.abs(np.roll(reference, v) - frame)
    errors.append(difference.reshape(8, 8).sum(axis=1))
best = np.argmin(errors, axis=0)
lessons.check_number("26.2", candidates[best], vectors)


# %% [markdown]
# **26.3** The heads side by side form one last layer, so the three cotangents side by side are
# its cotangent. E(t) is the same for all rows; it is repeated here, and `mlp.backward` sums over
# the rows. Of the gradient of the network's input, only the columns of E(x) are passed on.


# %%
def my_backward(inputs, cotangents):
    x, weights, biases = inputs["x"], inputs["weights"], inputs["biases"]
    E_x, saved_x = positional_encoding.forward(x, inputs["L_x"])
    times = np.full((len(x), 1), inputs["t"], x.dtype)
    E_t, _ = positional_encoding.forward(times, inputs["L_t"])
    last_layer = np.concatenate(weights[-3:], axis=1)
    last_bias = np.concatenate(biases[-3:])
    _, saved = mlp.forward(
        np.concatenate([E_x, E_t], axis=1),
        [*weights[:-3], last_layer],
        [*biases[:-3], last_bias],
    )
    names = ("delta_x_bar", "delta_s_bar", "delta_r_bar")
    y_bar = np.concatenate([cotangents[name] for name in names], axis=1)
    bars = mlp.backward(saved, y_bar)
    E_x_bar = bars["x"][:, : E_x.shape[1]]
    x_bar = positional_encoding.backward(saved_x, E_x_bar)["p"]
    *weights_bar, last_layer_bar = bars["weights"]
    *biases_bar, last_bias_bar = bars["biases"]
    widths = [W.shape[1] for W in weights[-3:]]
    cuts = np.cumsum(widths)[:2]
    weights_bar += np.split(last_layer_bar, cuts, axis=1)
    biases_bar += np.split(last_bias_bar, cuts)
    return {
        "x": x_bar,
        "weights": weights_bar,
        "biases": biases_bar,
    }


lessons.check_backward("26.3", my_backward, "deformation")

# %% [markdown]
# **Predict, then run.** One more, $L_t + 1$. The old time $t$ is $2t'$ in the new unit, and
# $\sin(2^j\cdot 2t') = \sin(2^{j+1}t')$: each old wave is the next faster one now.

# %%
old_t = np.linspace(0, 1, 50)[:, None]
old, _ = positional_encoding.forward(old_t, 4)
new, _ = positional_encoding.forward(old_t / 2, 5)
assert np.allclose(new[:, 3:], old[:, 1:])
