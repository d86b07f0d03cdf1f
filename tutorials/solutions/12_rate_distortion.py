# %% [markdown]
# # Solutions to rate against distortion

# %%
import numpy as np

from p4dgs_ref import lessons

# %% [markdown]
# **12.1** From $6\lambda + 0.01 = 3\lambda + 0.05$, the price is the reduction of the error
# divided by the additional bits. It is the negative slope of the line through both points.
# Training ends where the slope of its curve is $-\lambda$.

# %%
price = (0.05 - 0.01) / (6 - 3)
assert np.isclose(6 * price + 0.01, 3 * price + 0.05)
lessons.check_number("12.1", price, 0.04 / 3)


# %% [markdown]
# **12.2** The best step is $\sqrt{6\lambda/(w\ln 2)}$. If the picture is four times as sensitive,
# the step is half as large. A direct search for the minimum of the cost gives the same step.


# %%
def best_step(w):
    return np.sqrt(6 * 0.001 / (w * np.log(2)))


steps = np.linspace(0.06, 0.07, 100_001)
cost = 2 * steps**2 / 12 - 0.001 * np.log2(steps)
assert np.isclose(steps[cost.argmin()], best_step(2), rtol=1e-5)
lessons.check_number("12.2", best_step(2), best_step(8) * 2)


# %% [markdown]
# **12.3** Both rates enter both outputs in the same way, so they receive the same gradient. If
# there are no numbers, `L_rate` is the constant 0, and only `bits` has a gradient.


# %%
def my_backward(inputs, cotangents):
    n = inputs["n_parameters"]
    bar = cotangents["bits_bar"]
    if n:
        bar = bar + cotangents["L_rate_bar"] / n
    return {"R_anchor": np.asarray(bar), "R_hash": np.asarray(bar)}


lessons.check_backward("12.3", my_backward, "rate_loss")

# %% [markdown]
# **Predict, then run.** The step is proportional to $\sqrt\lambda$, so it doubles. A number then
# takes one bit less, and its squared error $q^2/12$ grows four times.

# %%
cost = 2 * steps**2 / 12 - 0.001 * np.log2(steps)
dearer_steps = 2 * steps
dearer_cost = 2 * dearer_steps**2 / 12 - 0.004 * np.log2(dearer_steps)
cheap, dear = steps[cost.argmin()], dearer_steps[dearer_cost.argmin()]
assert np.isclose(dear / cheap, 2)
assert np.isclose(np.log2(dear / cheap), 1) and np.isclose((dear / cheap) ** 2, 4)
