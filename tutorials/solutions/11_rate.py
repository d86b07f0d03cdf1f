# %% [markdown]
# # Solutions to Eq. (13), Eq. (14) and Eq. (17)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import hash_rate

# %% [markdown]
# **11.1** A sum gives its cotangent to every term. A masked offset is not a term of the sum.


# %%
def my_anchor_backward(inputs, cotangents):
    R_anchor_bar = cotangents["R_anchor_bar"]
    gradients = {
        name: np.full(inputs[name].shape, R_anchor_bar)
        for name in ("bits_f", "bits_s", "bits_l", "bits_O")
    }
    gradients["bits_O"][~inputs["mask"]] = 0
    return gradients


lessons.check_backward("11.1", my_anchor_backward, "anchor_rate")


# %% [markdown]
# **11.2** The slope is $\frac{dR}{dN_+} = \log_2\frac{N_-}{N_+}$. Half of it belongs to each sign,
# and it goes straight through where $|\theta| \le 1$.


# %%
def my_hash_backward(inputs, cotangents):
    grids = inputs["grids"]
    n_pos = sum(np.count_nonzero(grid >= 0) for grid in grids)
    n_neg = sum(np.count_nonzero(grid < 0) for grid in grids)
    slope = 0.0
    if n_pos > 0 and n_neg > 0:
        slope = 0.5 * np.log2(n_neg / n_pos) * cotangents["R_hash_bar"]
    return {"grids": [np.where(np.abs(grid) <= 1, slope, 0.0) for grid in grids]}


lessons.check_backward("11.2", my_hash_backward, "hash_rate")


# %% [markdown]
# **11.3** Together there are $8$ of $16$ positive signs, so the slope
# $\frac12\log_2\frac{N_-}{N_+}$ is 0 everywhere. With its own $p_+$, each level is pushed towards
# the sign that it has more often: $\frac12\log_2\frac62 = 0.79$ in the first, and $-0.79$ in the
# second. Signs of levels that differ then cost less, and the file holds one more count.

# %%
levels = [np.repeat([[0.5], [-0.5]], (n_pos, 8 - n_pos), axis=0) for n_pos in (2, 6)]


def slopes_of(grids):
    _, saved = hash_rate.forward(grids)
    return [grid[0, 0] for grid in hash_rate.backward(saved, 1.0)["grids"]]


def bits(n_pos, n):
    return -n_pos * np.log2(n_pos / n) - (n - n_pos) * np.log2(1 - n_pos / n)


answer_3 = [slopes_of(levels), [*slopes_of(levels[:1]), *slopes_of(levels[1:])]]
h = 1e-6
for count, n, slope in ((8, 16, answer_3[0][0]), (2, 8, answer_3[1][0]), (6, 8, answer_3[1][1])):
    difference = (bits(count + h, n) - bits(count - h, n)) / (2 * h)
    assert np.isclose(slope, difference / 2, atol=1e-8)  # theta moves half as many signs
lessons.check_number("11.3", answer_3, [[0, 0], [np.log2(3) / 2, -np.log2(3) / 2]])

# %% [markdown]
# **Predict, then run.** $N_+$ and $N_-$ change places. The rate is the same, and its gradient has
# the opposite sign: it always pushes towards the more frequent sign.

# %%
grid = np.random.default_rng(11).normal(0.5, 1, (1000, 1))
rates, slopes = [], []
for sign in (1, -1):
    (R_hash, _, _), saved = hash_rate.forward([sign * grid])
    rates.append(R_hash)
    slopes.append(hash_rate.backward(saved, 1.0)["grids"][0])
assert np.isclose(rates[0], rates[1])
assert slopes[0].any() and np.allclose(slopes[0], -slopes[1])
