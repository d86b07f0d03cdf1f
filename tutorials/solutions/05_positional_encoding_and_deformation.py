# %% [markdown]
# # Solutions to Eq. (5)

# %%
import numpy as np

from p4dgs_ref.equations import positional_encoding
from p4dgs_ref.school import lessons

# %% [markdown]
# **05.1** At zero every cosine is one and every sine zero: $1 + 1 + 2 = 4$.

# %%
_, res = positional_encoding.forward(np.zeros((1, 1)), 2)
lessons.number("05.1", 4, positional_encoding.backward(res, np.ones((1, 5)))["p"][0, 0])


# %% [markdown]
# **05.2** A loop over frequencies; columns of sines, then of cosines, $D$ wide each.


# %%
def my_encoding_backward(inputs, cotangents):
    p, L, E_bar = inputs["p"], inputs["L"], cotangents["E_bar"]
    D = p.shape[1]
    p_bar = E_bar[:, :D].copy()
    for j in range(L):
        s_bar, c_bar = (
            E_bar[:, D * (1 + 2 * j) : D * (2 + 2 * j)],
            E_bar[:, D * (2 + 2 * j) : D * (3 + 2 * j)],
        )
        p_bar += 2**j * (np.cos(2**j * p) * s_bar - np.sin(2**j * p) * c_bar)
    return {"p": p_bar}


lessons.backward("05.2", my_encoding_backward, "positional_encoding")


# %% [markdown]
# **05.3** As printed: every row with its copy of $\mathcal{E}(t)$, the trunk with ReLUs, then three linear heads.


# %%
def my_encoding(p, L):
    return np.concatenate(
        [p, *(wave(2**j * p) for j in range(L) for wave in (np.sin, np.cos))], axis=1
    )


def my_deformation(x, t, weights, biases, L_x, L_t):
    times = np.full((len(x), 1), t)
    hidden = np.concatenate([my_encoding(x, L_x), my_encoding(times, L_t)], axis=1)
    for W, b in zip(weights[:-3], biases[:-3]):
        hidden = np.maximum(hidden @ W + b, 0)
    return tuple(hidden @ W + b for W, b in zip(weights[-3:], biases[-3:]))


lessons.forward("05.3", my_deformation, "deformation")
