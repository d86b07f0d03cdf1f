# %% [markdown]
# # Solutions to Eq. (13), Eq. (14) and Eq. (17)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import anchor_rate, hash_rate, likelihood, rate_loss

# %% [markdown]
# **11.1** An anchor has $4 + 6 + 15 = 25$ numbers, and 22 of them stay. $\mathcal{L}_{rate}$ is
# divided by all 2,500 parameters (choice `Q12`), so it falls from 3 to 2.64, and the slope of a
# number that stays is $\frac{1}{2500} = 0.0004$ before and after: masking one child changes the
# price of no other number.

# %%
sizes = {"bits_f": (100, 4), "bits_s": (100, 3), "bits_l": (100, 3), "bits_O": (100, 5, 3)}
three = {name: np.full(shape, 3.0) for name, shape in sizes.items()}
losses, slopes = [], []
for kept in (5, 4):
    R_anchor, saved = anchor_rate.forward(**three, mask=np.tile(np.arange(5) < kept, (100, 1)))
    (_, L_rate), rate_saved = rate_loss.forward(R_anchor, 0.0, 100 * (4 + 6 + 15))
    top = rate_loss.backward(rate_saved, bits_bar=0.0, L_rate_bar=1.0)
    losses.append(L_rate)
    slopes.append(anchor_rate.backward(saved, top["R_anchor"])["bits_f"][0, 0])
lessons.check_number("11.1", [3, 2.64, 0.0004, 0.0004], [*losses, *slopes])


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
# second. If levels differ, their signs then cost less, but the file holds one more count.

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
# **11.4** The columns are the groups f, s, l, O, and each column uses the step of its group. The
# offsets of masked children have no bits, but the count of all numbers includes them.


# %%
def my_rate(noisy, mu, sigma, q, mask, grids, d, k):
    widths = d, 3, 3, 3 * k
    bits, _ = likelihood.forward(noisy, mu, sigma, np.repeat(q, widths, axis=1))
    R_anchor = bits[:, : d + 6].sum() + bits[:, d + 6 :][np.repeat(mask, 3, axis=1)].sum()
    positive = np.concatenate([grid.ravel() for grid in grids]) >= 0
    counts = np.array([positive.sum(), (~positive).sum()])
    counts = counts[counts > 0]
    total = R_anchor - (counts * np.log2(counts / positive.size)).sum()
    return {"bits": total, "L_rate": total / noisy.size}


lessons.check_forward("11.4", my_rate, "rate_stage")

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
