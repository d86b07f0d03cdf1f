# %% [markdown]
# # Solutions to hard cases

# %%
import numpy as np
from scipy.special import expit

from p4dgs_ref import lessons

# %% [markdown]
# **24.1** We have $1 + \tanh u = 2/(1 + e^{-2u})$. For $u = -19$ this is $2e^{-38}$, up to a term
# smaller than $2e^{-76}$.

# %%
lessons.check_number("24.1", 2 * np.exp(-38.0), 2 * expit(-38.0))


# %% [markdown]
# **24.2** A sign that does not occur contributes no bits. Its term is left out, so $0\cdot\log 0$
# is never computed.


# %%
def my_hash_rate(grids):
    n = sum(grid.size for grid in grids)
    n_pos = sum(int((grid >= 0).sum()) for grid in grids)
    n_neg = n - n_pos
    R_hash = np.float64(0)
    for count in (n_pos, n_neg):
        if 0 < count < n:
            R_hash -= count * np.log2(count / n)
    return R_hash, n_pos, n_neg


lessons.check_forward("24.2", my_hash_rate, "hash_rate")


# %% [markdown]
# **24.3** With $n = \sqrt{\|y\|^2 + 10^{-24}}$ we have $dr = dy/n - y\,(y\cdot dy)/n^3$, so
# $\bar y = (\bar r - r\,(r\cdot\bar r))/n$. At $y = 0$ this is $10^{12}\,\bar r$. The square of
# $10^{25}$ exceeds the range of `float32`, so the largest entry is divided out first.


# %%
def my_quaternion_backward(inputs, cotangents):
    r_bar = cotangents["r_bar"]
    y = inputs["y"].reshape(r_bar.shape)
    largest = np.abs(y).max(axis=2, keepdims=True)
    largest = np.maximum(largest, 1e-12)
    squares = ((y / largest) ** 2).sum(axis=2, keepdims=True)
    n = largest * np.sqrt(squares + (1e-12 / largest) ** 2)
    r = y / n
    along = (r * r_bar).sum(axis=2, keepdims=True)
    y_bar = (r_bar - r * along) / n
    return {"y": y_bar.reshape(inputs["y"].shape)}


lessons.check_backward("24.3", my_quaternion_backward, "unit_quaternion")

# %% [markdown]
# **Predict, then run.** Zero. A better formula keeps digits, but $6\cdot 10^{-17}$ lies below the
# smallest positive float16, $6\cdot 10^{-8}$. This is a matter of range, and only another type or
# a logarithm helps.

# %%
smallest = float(np.finfo(np.float16).smallest_subnormal)
assert 5e-8 < smallest < 7e-8
assert (np.float16(2 * np.exp(-38.0)), np.float16(np.log(2) - 38.0) < -37) == (0, True)
