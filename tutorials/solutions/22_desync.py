# %% [markdown]
# # Solutions to desync

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.codec import context
from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.equations import prior
from p4dgs_ref.oracle import streams

# %% [markdown]
# **22.1** We have $1001 = 62\cdot 16 + 9$. With nine slots for $A$, slot $9$ is the first one of
# $B$; with ten slots it still belongs to $A$. The next state is $62 f + 9 - c$ with the $f$ and
# $c$ of the symbol that owns the slot.

# %%
nine = 62 * 7 + 9 - 9
ten = 62 * 10 + 9 - 0
lessons.check_number("22.1", [nine, ten], [434, 629])


# %% [markdown]
# **22.2** A hidden layer divides by $2^s$, rounding half up by means of a floor, and sets
# negative values to zero. The last layer returns its sums unchanged.


# %%
def my_network(x, layers):
    for layer in layers[:-1]:
        unit = 2**layer.s
        y = x @ layer.W + layer.b
        rounded = np.floor((y + unit // 2) / unit)
        x = np.maximum(rounded, 0)
    last = layers[-1]
    return x @ last.W + last.b


rows = {row["name"]: row for row in streams.read_rows()["good"]}
full_row = rows["full"]
stored = {}
for array in full_row["arrays"]:
    stored[array["name"]] = streams.read_expected(full_row, array)
stream = (streams.STREAMS / "full.p4dgs").read_bytes()
full = quantised_of(read_container(stream)).model
layers = context.integer_layers(*full.networks["psi_p"])
h = stored["h"].astype(float)
y = context.run_network(h, layers)
lessons.check_number("22.2", my_network(h, layers), y, digits=15)


# %% [markdown]
# **22.3** The constant $94548$ is $\log_2 e$ in units of $2^{-16}$. A shift to the right is a
# floor, for negative numbers too.


# %%
def my_sigma_units(raw, log2_D, p):
    log2_sigma = (94548 * raw + 2**15) >> 16
    log2_Q_0 = (p - 39) << 16
    of_steps = log2_sigma - log2_D - log2_Q_0
    units = (of_steps + 2**11) >> 12
    return np.clip(units, -128, 319)


widths = full.design.widths
of_sigma = y[:, prior.layout(widths)[1]]
raw = context.rescale(of_sigma, layers[-1].bits, 16, 2**24)
raw = np.clip(raw, -14 << 16, 6 << 16)
fraction, p = np.frexp(full.design.Q_0)
mantissa = np.floor(fraction * 2**24).astype(int)
D = mantissa * stored["q_units"]
log2_D = np.repeat(context.log2(D), widths, axis=1)
exponents = np.repeat(p.astype(int), widths)
mine = my_sigma_units(raw, log2_D, exponents)
lessons.check_number("22.3", mine, stored["sigma_units"], digits=15)

# %% [markdown]
# **Predict, then run.** float32 has 24 bits, so from $2^{24}$ on it skips odd integers. The sums
# of `full` exceed $2^{34}$, and already in the first layer many of them are wrong. A double is
# exact up to $2^{53}$.

# %%
assert np.float32(2**24) + np.float32(1) == 2**24
single = h.astype(np.float32) @ layers[0].W.astype(np.float32)
assert np.abs(y).max() > 2**34
assert (single != h @ layers[0].W).mean() > 0.3
