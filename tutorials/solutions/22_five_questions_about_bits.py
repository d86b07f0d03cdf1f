# %% [markdown]
# # Solutions to the five questions about bits

# %%
import math

import numpy as np
from scipy.special import ndtr

from p4dgs_ref import lessons
from p4dgs_ref.equations import likelihood

# %% [markdown]
# **22.1** The density is $1/(\sigma\sqrt{2\pi})$, about $20$. The bin is narrow, so the mass is
# nearly the density times $q$, about $0.02$.

# %%
sigma, q = 0.02, 0.001
density = 1 / (sigma * math.sqrt(2 * math.pi))
mass = 1 - 2 * ndtr(-q / (2 * sigma))
want = [19.9471140, ndtr(0.025) - ndtr(-0.025)]
lessons.check_number("22.1", [density, mass], want)


# %% [markdown]
# **22.2** The columns are the groups f, s, l, O, and each column uses the step of its group. The
# offsets of masked children have no bits, but the number of parameters counts them.


# %%
def columns_of(values, d, k):
    """(A, 4) -> (A, n): the value of a group for each of its numbers."""
    return np.repeat(values, (d, 3, 3, 3 * k), axis=1)


def counted(mask, d):
    """(A, n): 1 where a number costs bits."""
    always = np.ones((len(mask), d + 6))
    offsets = np.repeat(mask, 3, axis=1)
    return np.concatenate([always, offsets], axis=1)


def my_rate(noisy, mu, sigma, q, mask, grids, d, k):
    bits, _ = likelihood.forward(noisy, mu, sigma, columns_of(q, d, k))
    R_anchor = (bits * counted(mask, d)).sum()
    entries = np.concatenate([grid.ravel() for grid in grids])
    n = entries.size
    n_pos = (entries >= 0).sum()
    R_hash = 0
    for count in (n_pos, n - n_pos):
        if count:
            R_hash -= count * np.log2(count / n)
    total = R_anchor + R_hash
    return {"bits": total, "L_rate": total / noisy.size}


lessons.check_forward("22.2", my_rate, "rate_stage")


# %% [markdown]
# **22.3** Every bit counts in both outputs, and in the second one it is divided by the number of
# parameters. A step that serves a whole group collects the gradients of its columns, because a
# quantity that is used several times always receives the sum.


# %%
def my_rate_backward(inputs, cotangents):
    d, k, noisy = inputs["d"], inputs["k"], inputs["noisy"]
    per_bit = cotangents["bits_bar"] + cotangents["L_rate_bar"] / noisy.size
    bits_bar = per_bit * counted(inputs["mask"], d)
    columns = columns_of(inputs["q"], d, k)
    _, saved = likelihood.forward(noisy, inputs["mu"], inputs["sigma"], columns)
    bars = likelihood.backward(saved, bits_bar)
    starts = [0, d, d + 3, d + 6]
    return {
        "mu": bars["mu"],
        "q": np.add.reduceat(bars["q"], starts, axis=1),
    }


lessons.check_backward("22.3", my_rate_backward, "rate_stage", "mu", "q")

# %% [markdown]
# **Predict, then run.** 2048. From there on, numbers in float16 are 2 apart, and $2048 + 1$ is
# rounded back to 2048. Sums of many small numbers need more digits than the numbers.

# %%
running = np.add.accumulate(np.ones(10_000, np.float16))
assert running[-1] == 2048
assert np.ones(10_000, np.float32).sum() == 10_000
