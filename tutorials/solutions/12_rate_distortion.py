# %% [markdown]
# # Solutions to Eq. (15)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import likelihood

# %% [markdown]
# **12.1** The loss is $10^{-3}\cdot 2.4 + 0.07$. Its cotangent goes to $\mathcal{L}_{render}$ with
# the factor one, and to $\mathcal{L}_{rate}$ with the factor $\lambda_{rate}$.

# %%
case = lessons.golden("total_loss/ordinary")
bar = case["out_bar.L_total"]
names = ("out.L_total", "in_bar.L_render", "in_bar.L_rate")
lessons.check_number("12.1", [0.0724, bar, 1e-3 * bar], [case[name] for name in names])

# %% [markdown]
# **12.2** From $6\lambda + 0.01 = 3\lambda + 0.05$, the price is the reduction of the error
# divided by the additional bits. It is the negative slope of the line through both points.
# Training ends where the slope of its curve is $-\lambda$.

# %%
price = (0.05 - 0.01) / (6 - 3)
assert np.isclose(6 * price + 0.01, 3 * price + 0.05)
lessons.check_number("12.2", price, 0.04 / 3)


# %% [markdown]
# **12.3** The best step is $\sqrt{6\lambda/(w\ln 2)}$. If the picture is four times as sensitive,
# the step is half as large. A direct search for the minimum of the cost gives the same step.


# %%
def best_step(w):
    return np.sqrt(6 * 0.001 / (w * np.log(2)))


steps = np.linspace(0.06, 0.07, 100_001)
cost = 2 * steps**2 / 12 - 0.001 * np.log2(steps)
assert np.isclose(steps[cost.argmin()], best_step(2), rtol=1e-5)
lessons.check_number("12.3", best_step(2), best_step(8) * 2)


# %% [markdown]
# **12.4** Every bit counts in both outputs, and in the second one it is divided by the number of
# all numbers. A masked offset has no bits and therefore no gradient. A step that serves a whole
# group collects the gradients of its columns, because a quantity that is used several times always
# receives the sum.


# %%
def my_rate_backward(inputs, cotangents):
    d, k, noisy = inputs["d"], inputs["k"], inputs["noisy"]
    widths = d, 3, 3, 3 * k
    per_bit = cotangents["bits_bar"] + cotangents["L_rate_bar"] / noisy.size
    counted = np.ones(noisy.shape)
    counted[:, d + 6 :] = np.repeat(inputs["mask"], 3, axis=1)
    columns = np.repeat(inputs["q"], widths, axis=1)
    _, saved = likelihood.forward(noisy, inputs["mu"], inputs["sigma"], columns)
    bars = likelihood.backward(saved, per_bit * counted)
    starts = [0, d, d + 3, d + 6]
    return {"mu": bars["mu"], "q": np.add.reduceat(bars["q"], starts, axis=1)}


lessons.check_backward("12.4", my_rate_backward, "rate_stage", "mu", "q")

# %% [markdown]
# **Predict, then run.** The step is proportional to $\sqrt\lambda$, so it doubles. A number then
# takes one bit less, and its squared error $q^2/12$ grows four times.

# %%
dearer_steps = 2 * steps
dearer_cost = 2 * dearer_steps**2 / 12 - 0.004 * np.log2(dearer_steps)
cheap, dear = steps[cost.argmin()], dearer_steps[dearer_cost.argmin()]
assert np.isclose(dear / cheap, 2)
assert np.isclose(np.log2(dear / cheap), 1) and np.isclose((dear / cheap) ** 2, 4)
