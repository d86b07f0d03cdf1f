# %% [markdown]
# # Solutions to Eq. (7) and Eq. (10)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import noise, rounding

# %% [markdown]
# **07.1** The quotients are $2.5$, $1.5$, $-3.5$ and $-1.8$. The first three are ties and are
# rounded to the even neighbour. Rounding ties up, down or away from zero, or truncating, gives a
# different list.

# %%
four = np.array([[0.625, 0.375, -0.875, -0.45]])
quarter = np.array([[0.25]])
lessons.check_number("07.1", [2, 2, -4, -2], rounding.forward(four, quarter)[0][0][0])


# %% [markdown]
# **07.2** With the slope one of `rint`, $\bar f = 1$ and
# $\bar q = \sum (\mathrm{rint}(f/q) - f/q) = -0.6$. This is Eq. (7) with the rounding error as its
# noise $u$. Differences find another gradient: the symbols do not move, so $\bar f$ is 0 and
# $\bar q$ is the sum of the symbols, $-2$. With these slopes $f$ would never learn.

# %%
f = np.array([[0.6, 0.4, -0.9, -0.45]])
(symbols, _), _ = rounding.forward(f, quarter)
u = symbols - f / quarter
_, saved = noise.forward(f, u, quarter)
straight_through = noise.backward(saved, np.ones_like(f))
h = 1e-6
(_, up), _ = rounding.forward(f, quarter + h)
(_, down), _ = rounding.forward(f, quarter - h)
assert np.isclose((up - down).sum() / (2 * h), symbols.sum())
assert np.array_equal(rounding.forward(f + h, quarter)[0][1], symbols * quarter)


def with_its_error(f, q):
    return noise.forward(f, u, q)


given = {"f": f, "q": quarter}
rng = np.random.default_rng(7)
_ = lessons.adjoint(rng, with_its_error, given, np.ones_like(f), straight_through)
lessons.check_number("07.2", [-0.6, -2], [straight_through["q"][0, 0], symbols.sum()])


# %% [markdown]
# **07.3** The mean of $\bar f = f + uq$ is $f = 2$. The mean of $\bar q = u\,(f + uq)$ is
# $q\,E[u^2] = q/12 = 0.05$, because $u$ has the mean 0. It is positive wherever the loss is curved
# upwards, so descent narrows the step: noise costs quality. What keeps steps from vanishing is the
# rate, which gets larger when they get smaller.

# %%
two = np.full((1, 100_000), 2.0)
u = ((np.arange(100_000) + 0.5) / 100_000 - 0.5)[None]  # evenly over [-1/2, 1/2)
noisy, saved = noise.forward(two, u, np.array([[0.6]]))
bars = noise.backward(saved, noisy)  # the sum over all draws
means = [bars["f"].mean(), bars["q"][0, 0] / two.size]
lessons.check_number("07.3", [2, 0.6 / 12], means)

# %% [markdown]
# **Predict, then run.** With noise, the mean squared error is $q^2/12$, wherever the numbers are.
# In the file it is 0, because rounding does not change these numbers. Noise is a good model of
# rounding only where the numbers spread over many steps.

# %%
f = 0.25 * rng.integers(-9, 10, (1, 100_000))
noisy, _ = noise.forward(f, rng.random(f.shape) - 0.5, quarter)
rounded = rounding.forward(f, quarter)[0][1]
assert np.isclose(((noisy - f) ** 2).mean(), 0.25**2 / 12, rtol=0.02)
assert np.array_equal(rounded, f)
