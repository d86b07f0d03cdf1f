# %% [markdown]
# # Solutions to hard cases

# %%
import numpy as np
from scipy.special import expit

from p4dgs_ref.school import lessons

# %% [markdown]
# **24.1** $1 + \tanh u = 2/(1 + e^{-2u})$. For $u = -19$ this is $2e^{-38}$, and what is left out is smaller than $e^{-76}$.

# %%
lessons.number("24.1", 2 * np.exp(-38.0), 2 * expit(-38.0))


# %% [markdown]
# **24.2** A share of zero contributes no bits: such terms are left out instead of computing $0\cdot\log 0$.


# %%
def my_hash_rate(grids):
    n = sum(grid.size for grid in grids)
    n_pos = sum(int((grid >= 0).sum()) for grid in grids)
    R_hash = sum(-count * np.log2(count / n) for count in (n_pos, n - n_pos) if 0 < count < n)
    return np.float64(R_hash), n_pos, n - n_pos


lessons.forward("24.2", my_hash_rate, "hash_rate")


# %% [markdown]
# **24.3** With $n = \sqrt{\|y\|^2 + 10^{-24}}$: $dr = dy/n - y\,(y\cdot dy)/n^3$, so $\bar y = (\bar r - r\,(r\cdot\bar r))/n$.
# At $y = 0$ it is $10^{12}\,\bar r$. Squares of $10^{25}$ leave `float32`, so the largest entry is divided out first.


# %%
def my_quaternion_backward(inputs, cotangents):
    r_bar = cotangents["r_bar"]
    y = inputs["y"].reshape(r_bar.shape)
    largest = np.maximum(np.abs(y).max(axis=2, keepdims=True), 1e-12)
    n = largest * np.sqrt(((y / largest) ** 2).sum(axis=2, keepdims=True) + (1e-12 / largest) ** 2)
    r = y / n
    y_bar = (r_bar - r * (r * r_bar).sum(axis=2, keepdims=True)) / n
    return {"y": y_bar.reshape(inputs["y"].shape)}


lessons.backward("24.3", my_quaternion_backward, "unit_quaternion")
