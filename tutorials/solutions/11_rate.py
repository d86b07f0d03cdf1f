# %% [markdown]
# # Solutions to Eq. (13), Eq. (14) and Eq. (17)

# %%
import numpy as np

from p4dgs_ref.school import lessons

# %% [markdown]
# **11.1** A sum hands its cotangent to every term; what is masked is no term.


# %%
def my_anchor_backward(inputs, cotangents):
    bars = {
        name: np.full(inputs[name].shape, cotangents["R_anchor_bar"])
        for name in ("bits_f", "bits_O", "bits_l", "bits_s")
    }
    bars["bits_O"] = np.where(inputs["mask"][:, :, None], bars["bits_O"], 0)
    return bars


lessons.backward("11.1", my_anchor_backward, "anchor_rate")


# %% [markdown]
# **11.2** $\frac{dR}{dN_+} = \log_2\frac{N_-}{N_+}$, half of it per sign, straight through where $|\theta| \le 1$.


# %%
def my_hash_backward(inputs, cotangents):
    grids = inputs["grids"]
    n_pos = sum(np.count_nonzero(g >= 0) for g in grids)
    n_neg = sum(g.size for g in grids) - n_pos
    slope = 0.5 * np.log2(n_neg / n_pos) * cotangents["R_hash_bar"] if n_pos and n_neg else 0.0
    return {"grids": [np.where(np.abs(g) <= 1, slope, 0.0) for g in grids]}


lessons.backward("11.2", my_hash_backward, "hash_rate")


# %% [markdown]
# **11.3** A model without parameters has nothing to code.


# %%
def my_rate(R_anchor, R_hash, n_parameters):
    bits = R_anchor + R_hash
    return bits, bits / n_parameters if n_parameters else 0.0


lessons.forward("11.3", my_rate, "rate_loss")
