# %% [markdown]
# # Solutions to Eq. (11) and Eq. (12)

# %%
import math

import numpy as np
from scipy.special import erfcx, log_ndtr

from p4dgs_ref import lessons
from p4dgs_ref.equations import likelihood
from p4dgs_ref.lessons import close

# %% [markdown]
# **10.1** The density is $1/(\sigma\sqrt{2\pi})$, about 20. The bin is narrow, so its area is
# nearly the density times $q$, about 0.02.

# %%
density = 1 / (0.02 * math.sqrt(2 * math.pi))
bits, _ = likelihood.forward(*(np.array([[value]]) for value in (0.0, 0.0, 0.02, 0.001)))
lessons.check_number("10.1", [density, 2 ** -bits[0, 0]], [19.9471140, math.erf(0.025 / 2**0.5)])

# %% [markdown]
# **10.2** The mirrored bin has $p = \Phi(-low) - \Phi(-high) = \Phi(-low)\,(1 - r)$, where $r$ is
# the ratio of the two tails. `log_ndtr` gives the logarithms of both tails, for every bin here.
# Only $\log(1-r)$ needs care, and `log1p` computes it accurately.

# %%
case = lessons.golden("gaussian_bin/tails")
near = np.abs(case["in.z"]) <= 40
z, w = np.abs(case["in.z"][near]), case["in.w"][near]
tail = log_ndtr(-(z - w / 2))
beyond = log_ndtr(-(z + w / 2))
answer_2 = tail + np.log1p(-np.exp(beyond - tail))
lessons.check_number("10.2", answer_2, case["out.log_p"][near], digits=9)

# %% [markdown]
# With `erfcx`, which the project uses, the factor $e^{-low^2/2}$ goes directly into the logarithm.

# %%
low, high = z - w / 2, z + w / 2
root = math.sqrt(0.5)
g = 0.5 * (erfcx(low * root) - np.exp(-z * w) * erfcx(high * root))
assert close(np.log(g) - low**2 / 2, answer_2, 1e-11)


# %% [markdown]
# **10.3** On the bound $\sigma = q/4$, so $r$ gets no gradient, and $\psi_p$ does not learn that
# its $\sigma$ is too small. The gradient of $\sigma$ goes to $q$ instead, with the factor
# $\frac14$. The bits now depend only on $(f-\mu)/q$, which gives the same gradient of $q$ in
# another way: $\bar q = -\bar f\,(f-\mu)/q$.

# %%
sure = {name: np.array([[value]]) for name, value in (("r", math.log(0.02)), ("q", 0.2))}
f, mu = np.array([[0.3]]), np.array([[0.1]])


def bits_with_floor(r, q):
    return likelihood.forward(f, mu, np.maximum(np.exp(r), q / 4), q)


_, saved = bits_with_floor(**sure)
bars = likelihood.backward(saved, np.ones((1, 1)))
on_floor = np.exp(sure["r"]) < sure["q"] / 4
gradients = {
    "r": bars["sigma"] * np.exp(sure["r"]) * ~on_floor,
    "q": bars["q"] + bars["sigma"] / 4 * on_floor,
}
_ = lessons.adjoint(np.random.default_rng(10), bits_with_floor, sure, np.ones((1, 1)), gradients)
by_scale = -bars["f_noisy"] * (f - mu) / sure["q"]
answer_3 = [gradients["r"][0, 0], gradients["q"][0, 0]]
lessons.check_number("10.3", answer_3, [0, by_scale[0, 0]])


# %% [markdown]
# **10.4** There are two slopes and four inputs, and $\sigma$ receives a term from each slope.


# %%
def slopes_of_log_p(z, w):
    """Return the slopes of log p in z and in w, accurate in all regimes."""
    _, saved = likelihood.forward(z, np.zeros_like(z), np.ones_like(z), w)
    gradients = likelihood.backward(saved, np.full_like(z, -math.log(2)))  # from bits to log p
    return gradients["f_noisy"], gradients["q"]


def my_likelihood_backward(inputs, cotangents):
    f, mu, sigma, q = (inputs[name] for name in ("f_noisy", "mu", "sigma", "q"))
    z, w = (f - mu) / sigma, q / sigma
    slope_z, slope_w = slopes_of_log_p(z, w)
    factor = cotangents["bits_bar"] / (sigma * math.log(2))
    return {
        "f_noisy": -factor * slope_z,
        "mu": factor * slope_z,
        "q": -factor * slope_w,
        "sigma": factor * (z * slope_z + w * slope_w),
    }


lessons.check_backward("10.4", my_likelihood_backward, "likelihood")

# %% [markdown]
# **Predict, then run.** Eq. (11) contains only quotients, so the bits stay the same. A change of
# $\mu$ by one unit is now a thousand times smaller, and so is the gradient. A density instead of a
# probability would change by $\log_2 1000$, about ten bits per number.

# %%
given = [np.array([[value]]) for value in (0.3, 0.1, 0.2, 0.05)]  # f, mu, sigma, q
bits, gradients = [], []
for factor in (1, 1000):
    of_unit, saved = likelihood.forward(*(factor * array for array in given))
    bits.append(of_unit)
    gradients.append(likelihood.backward(saved, np.ones((1, 1)))["mu"])
assert close(bits[0], bits[1])
assert close(gradients[0], 1000 * gradients[1])
