# %% [markdown]
# # Solutions to rate against distortion

# %%
import numpy as np

from p4dgs_ref.school import lessons

# %% [markdown]
# **27.1** $6\lambda + 0.01 = 3\lambda + 0.05$: the price is the error that is gained over the bits that are spent, the slope
# of the line through both points. Where a curve's slope is $-\lambda$, there training stops.

# %%
price = (0.05 - 0.01) / (6 - 3)
assert np.isclose(6 * price + 0.01, 3 * price + 0.05)
lessons.number("27.1", price, 0.04 / 3)

# %% [markdown]
# **27.2** $\sqrt{6\lambda/(w\ln 2)}$. What the picture minds four times as much gets half the step. Searching the
# cost itself gives the same.

# %%
best = lambda w: np.sqrt(6 * 0.001 / (w * np.log(2)))
assert np.isclose(best(8), best(2) / 2)
steps = np.linspace(0.06, 0.07, 100_001)
lessons.number(
    "27.2", best(2), steps[(2 * steps**2 / 12 - 0.001 * np.log2(steps)).argmin()], digits=5
)

# %% [markdown]
# **27.3** Both rates enter both outputs in the same way, so they receive the same gradient. Without numbers, `L_rate` is the
# constant 0, and only `bits` sends something back.


# %%
def my_backward(inputs, cotangents):
    n = inputs["n_parameters"]
    bar = cotangents["bits_bar"] + (cotangents["L_rate_bar"] / n if n else 0)
    return {"R_anchor": np.asarray(bar), "R_hash": np.asarray(bar)}


lessons.backward("27.3", my_backward, "rate_loss")
