# %% [markdown]
# # Solutions to the five questions about bits

# %%
import math

import numpy as np
from scipy.special import ndtr

from p4dgs_ref.equations import likelihood
from p4dgs_ref.school import lessons

# %% [markdown]
# **22.1** The density is $1/(\sigma\sqrt{2\pi})$, about $20$; the mass is that times $q$ but for the bin's bend, about $0.02$.

# %%
sigma, q = 0.02, 0.001
mass = 1 - 2 * ndtr(-q / (2 * sigma))
density = 1 / (sigma * math.sqrt(2 * math.pi))
lessons.number(
    "22.1", [density, mass], [1 / (0.02 * math.sqrt(2 * math.pi)), ndtr(0.025) - ndtr(-0.025)]
)


# %% [markdown]
# **22.2** Columns are groups f, s, l, O; each takes the step of its group. Offsets of masked children are not counted in the
# bits, but the number of parameters counts them.


# %%
def columns_of(values, d, k):
    """(A, 4) -> (A, n): one column a group, repeated over its numbers."""
    return np.repeat(values, (d, 3, 3, 3 * k), axis=1)


def counted(mask, d):
    """(A, n): 1 where a number is paid for."""
    return np.concatenate([np.ones((len(mask), d + 6)), np.repeat(mask, 3, axis=1)], axis=1)


def my_rate(noisy, mu, sigma, q, mask, grids, d, k):
    bits = likelihood.forward(noisy, mu, sigma, columns_of(q, d, k))[0].bits
    signs = np.concatenate([grid.ravel() for grid in grids]) >= 0
    shares = np.array([signs.mean(), 1 - signs.mean()])
    R_hash = -signs.size * (shares * np.log2(np.where(shares > 0, shares, 1))).sum()
    total = (bits * counted(mask, d)).sum() + R_hash
    return {"bits": total, "L_rate": total / noisy.size}


lessons.forward("22.2", my_rate, "rate_stage")


# %% [markdown]
# **22.3** Every bit counts in both outputs, in the second divided by the number of parameters. A step that serves a whole
# group collects the gradients of its columns, as what is used often always does.


# %%
def my_rate_backward(inputs, cotangents):
    noisy, mu, sigma, q, mask, d, k = (
        inputs[name] for name in ("noisy", "mu", "sigma", "q", "mask", "d", "k")
    )
    bits_bar = (cotangents["bits_bar"] + cotangents["L_rate_bar"] / noisy.size) * counted(mask, d)
    bars = likelihood.backward(
        likelihood.forward(noisy, mu, sigma, columns_of(q, d, k))[1], bits_bar
    )
    starts = [0, d, d + 3, d + 6]
    return {"mu": bars["mu"], "q": np.add.reduceat(bars["q"], starts, axis=1)}


lessons.backward("22.3", my_rate_backward, "rate_stage", "mu", "q")
