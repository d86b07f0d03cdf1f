# %% [markdown]
# # Solutions to Eq. (11) and Eq. (12)

# %%
import math

import numpy as np
from scipy.special import erfcx, log_ndtr

from p4dgs_ref.equations import gaussian_bin, mlp, prior
from p4dgs_ref.school import lessons

# %% [markdown]
# **10.1** Seen from the left, $p = \Phi(-low) - \Phi(-high) = \Phi(-low)\,(1 - r)$ with the ratio of two tails $r$. Taking both
# tails as logarithms (`log_ndtr`) serves every bin here; only $\log(1-r)$ wants care, hence `log1p`.

# %%
case = lessons.golden("gaussian_bin/tails")
near = np.abs(case["in.z"]) <= 40
z, w = np.abs(case["in.z"][near]), case["in.w"][near]
tail, beyond = log_ndtr(-(z - w / 2)), log_ndtr(-(z + w / 2))
answer_1 = tail + np.log1p(-np.exp(beyond - tail))
lessons.number("10.1", answer_1, case["out.log_p"][near], digits=9)

# %% [markdown]
# The same by `erfcx`, as the project does it: the factor $e^{-low^2/2}$ goes straight into the logarithm.

# %%
low, high, root = z - w / 2, z + w / 2, math.sqrt(0.5)
g = 0.5 * (erfcx(low * root) - np.exp(-z * w) * erfcx(high * root))
assert np.allclose(np.log(g) - low**2 / 2, answer_1, rtol=1e-11)


# %% [markdown]
# **10.2** Means go back as they came, raw deviations through $e^{raw}$ and its clamp.


# %%
def my_prior_backward(inputs, cotangents):
    y, res = mlp.forward(inputs["h"], inputs["weights"], inputs["biases"])
    mu, raw = prior.layout(inputs["widths"])
    free = (y.y[:, raw] >= prior.RAW_MIN) & (y.y[:, raw] <= prior.RAW_MAX)
    y_bar = np.zeros_like(y.y)
    y_bar[:, mu] = cotangents["mu_bar"]
    y_bar[:, raw] = cotangents["sigma_bar"] * np.exp(y.y[:, raw]) * free
    bars = mlp.backward(res, y_bar)
    return {"h": bars["x"], "weights": bars["weights"], "biases": bars["biases"]}


lessons.backward("10.2", my_prior_backward, "prior")


# %% [markdown]
# **10.3** Two slopes, four inputs; $\sigma$ collects from both.


# %%
def my_likelihood_backward(inputs, cotangents):
    f, mu, sigma, q = (inputs[name] for name in ("f_noisy", "mu", "sigma", "q"))
    b = gaussian_bin.stable(f, mu, sigma, q)
    bar = -cotangents["bits_bar"] / (sigma * math.log(2))
    return {
        "f_noisy": bar * b.slope_z,
        "mu": -bar * b.slope_z,
        "q": bar * b.slope_w,
        "sigma": -bar * (b.z * b.slope_z + b.w * b.slope_w),
    }


lessons.backward("10.3", my_likelihood_backward, "likelihood")
