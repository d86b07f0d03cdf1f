# %% [markdown]
# # Eq. (11) and Eq. (12): how many bits a number costs
#
# **Promise.** After this tutorial you can compute the cost of a number in bits, say what a wrong
# guess and a wrong width of the guess cost, and derive all four gradients. **Before it:**
# `07_noise_and_rounding`, `08_step`. **Takes** four seconds of machine time on two cores, 40
# minutes of reading and 40 of exercises.
#
# **Files:** Eq. (11) [likelihood.py](../p4dgs_ref/equations/likelihood.py), Eq. (12)
# [prior.py](../p4dgs_ref/equations/prior.py).

# %%
import math

import numpy as np
from scipy.special import erfcx, ndtr

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, panels, show, tour

plt = figures.pyplot()
architecture.show("10_prior_and_likelihood")
rng = np.random.default_rng(10)

# %% [markdown]
# ## What fails without it
# The decoder guesses every number, and a bell curve around the guess says how likely other values
# are. If the bell is too narrow, every surprise is expensive; if it is too wide, bits are spent on
# values that do not occur. The right width differs from number to number, so it must be predicted
# like the guess itself.
#
# The left side shows one number of *anchor 29*, in steps, and three bells around its guess in the
# trained scene: with the predicted width, a quarter of it, and four times as much. The right side
# shows what the features of the whole file, and those of anchor 29, cost if all widths are
# multiplied by a factor.

# %%
from p4dgs_ref.equations import likelihood
from p4dgs_ref.report.inspect import float_context

model, thread = tour.MODEL, figures.THREAD
context, d = float_context(model), model.design.d  # d numbers of a feature
steps = context.q[:, :1]
means, deviations = context.mu[:, :d] / steps, context.sigma[:, :d] / steps
symbols = tour.FILE.symbols[:, :d].astype(float)
factors = 2.0 ** np.arange(-3, 4)
costs = np.array(
    [likelihood.forward(symbols, means, x * deviations, np.ones_like(means))[0] for x in factors]
)
whole, own = costs.sum(axis=(1, 2)), costs[:, thread.index].sum(axis=1)
print("all features:", np.round(whole / 8), "bytes for the factors", factors)
assert whole.argmin() == 3

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
place, guess, width = (a[thread.index, 3] for a in (symbols, means, deviations))
x = np.linspace(guess - 12, guess + 12, 400)
for factor, style in ((0.25, ":"), (1, "-"), (4, "--")):
    bell = np.exp(-(((x - guess) / (factor * width)) ** 2) / 2) / (factor * width)
    left.plot(x, bell / np.sqrt(2 * np.pi), style, color=thread.color, label=f"width × {factor:g}")
left.axvspan(place - 0.5, place + 0.5, color=show.PALE)
left.set(xlabel="value (steps)", ylabel="density", title="the bin of the number, and three bells")
left.legend()
powers = np.log2(factors)
right.semilogy(powers, whole / 8, "o-", color=show.GREY, label="features of the file")
right.semilogy(powers, own / 8, "o-", color=thread.color, label=f"those of {thread.name}")
right.set(xlabel="all widths times 2 to the power", ylabel="bytes", title="too narrow, too wide")
right.legend()
figures.show(figure, "10_wrong_width")

# %% [markdown]
# ## Claim
# Play a guessing game: you ask questions, and every answer is yes or no. If 8 numbers are equally
# likely, 3 questions find the right one, because each answer halves the number of candidates. A
# number of probability $\frac18$ therefore costs 3 bits. If one number has the probability
# $\frac12$, ask for it first: it costs 1 bit, and the others cost more. In general, a number of
# probability $p$ costs $-\log_2 p$ bits. An ideal entropy coder needs exactly that many, even if
# this is not an integer.
#
# A number is therefore cheap if the decoder expects it. For every number, a network makes a guess,
# $\mu$, and says how far off this guess may be, $\sigma$. Together they describe a normal
# distribution. The file does not store the exact number, only its *symbol*: the nearest multiple of
# the step $q$. The symbol stands for all values within half a step of it, an interval of width $q$
# that we call its *bin*. The probability of the symbol is the probability that the value falls into
# the bin, which is the area under the bell curve over the bin.

# %% [markdown]
# ## By hand
# Let the guess be $\mu = 0$, the standard deviation $\sigma = 1$ and the step $q = 1$. The bin of
# the symbol 0 extends from $-0.5$ to $0.5$. According to a table of the normal distribution, a
# share of 0.69146 of all values lies below $0.5$, and 0.30854 below $-0.5$. The difference, 0.3829,
# is the probability of the symbol, which therefore costs $-\log_2 0.3829 = 1.385$ bits. The symbol
# 1 has the probability 0.2417 and costs 2.049 bits, and the symbol 3 costs 7.386 bits. With the
# guess $\mu = 3$, the symbol 3 would cost only 1.385 bits: the better guess saves 6 bits.


# %%
def Phi(x):
    return 0.5 * (1 + math.erf(x / math.sqrt(2)))


def density_at(x):
    return np.exp(-0.5 * x**2) / math.sqrt(2 * math.pi)


for symbol in range(4):
    p = Phi(symbol + 0.5) - Phi(symbol - 0.5)
    print(f"symbol {symbol}: probability {p:.4f}, {-math.log2(p):.3f} bits")

# %% [markdown]
# The figure shows two numbers of anchor 29 in the trained scene, in steps. The first is where the
# decoder expects it. The second is a surprise, and costs four times as much. The purple area is the
# probability of the symbol.

# %%
figure, both = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
for ax, j in zip(both, (14, 13)):
    symbol, mean, deviation = (a[thread.index, j] for a in (symbols, means, deviations))
    x = np.linspace(min(mean, symbol) - 12, max(mean, symbol) + 12, 2001)
    bell, inside = density_at((x - mean) / deviation) / deviation, np.abs(x - symbol) <= 0.5
    ax.plot(x, bell, color="k")
    ax.fill_between(x[inside], bell[inside], color=thread.color)
    ax.set(
        xlabel="value (steps)",
        ylabel="density (per step)",
        title=f"symbol {symbol:.0f}: {costs[3, thread.index, j]:.1f} bits",
    )
figures.show(figure, "10_areas")

# %% [markdown]
# ## In code
# **The guess**, Eq. (12). The network $\psi_p$ reads the context $h$ of Eq. (9), which the decoder
# knows as well:
# $$(\mu, \sigma) = \psi_p(h) \tag{12}$$
# For the $n$ numbers of an anchor, $\psi_p$ has $2n$ outputs. They are ordered by the groups f, s,
# l, O; within a group, all means come first, then all logarithms of the standard deviations. Each
# logarithm is clamped to $[-14, 6]$ (choice `Q8`), so that $\sigma$ is neither too close to 0 nor
# infinite.

# %%
from p4dgs_ref.equations import mlp, prior
from p4dgs_ref.lab.random_inputs import random_network
from p4dgs_ref.lessons import close, inner, shift

# paper, Sec. 3.3: the mean and the deviation of a normal distribution, by a network of h
# silent: Q8, the deviation is exp of an output, which is clamped
A, width, widths = 6, 5, (2, 3, 3, 3)
n = sum(widths)
weights, biases = random_network(rng, width, 7, 2 * n)
h = rng.normal(size=(A, width))
(mu, sigma), prior_saved = prior.forward(h, weights, biases, widths)
psi_p, _ = mlp.forward(h, weights, biases)
assert mu.shape == sigma.shape == (A, n)
assert np.array_equal(mu[:, :2], psi_p[:, :2])
assert np.array_equal(sigma[:, :2], np.exp(psi_p[:, 2:4]))
assert np.array_equal(mu[:, 2:5], psi_p[:, 4:7])

# %% [markdown]
# **The price**, Eq. (11). The area over the bin of $\tilde f_a$ is an integral of the density
# $\phi$. With the function $\Phi(x)$, the share of all values below $x$, the integral becomes a
# difference:
# $$p(\tilde{f}_a)=\int_{\tilde{f}_a-\frac{1}{2}q}^{\tilde{f}_a+\frac{1}{2}q}\phi_{\mu,\sigma}(x)dx
# = \Phi_{\mu,\sigma}\left(\tilde{f_a}+\frac{1}{2}q\right)
# - \Phi_{\mu,\sigma}\left(\tilde{f_a}-\frac{1}{2}q\right) \tag{11}$$
# (In training, $\tilde f_a$ is the value with noise; in the file, it is a multiple of $q$.) The
# bits depend on only two numbers: $z = (\tilde f - \mu)/\sigma$, the distance of the value from the
# mean, and $w = q/\sigma$, the width of the bin. In these units the bin extends from $z - w/2$ to
# $z + w/2$, and the distribution is the standard normal one.

# %%
f = mu + sigma * rng.normal(size=(A, n))
q = sigma * rng.uniform(0.2, 3, (A, n))
bits, saved = likelihood.forward(f, mu, sigma, q)
z, w = (f - mu) / sigma, q / sigma
assert bits.shape == (A, n)
assert close(bits, -np.log2(ndtr(z + w / 2) - ndtr(z - w / 2)), 1e-9)

# %% [markdown]
# **A likelihood above one?** The density $\phi$ is a probability *per unit*, and it may have any
# size: with $\sigma = 0.1$ it is 3.989 at the mean. Taken for a likelihood, it would cost $-2.0$
# bits, less than nothing. The bin of width 0.1 around the mean has the probability 0.383 and costs
# 1.385 bits.
#
# **Do likelihoods sum to one?** Yes, over all symbols that *one* number could have: neighbouring
# bins share an edge, so the differences add up to 1. The likelihoods of all numbers of a file have
# no such sum, because each of them comes from a bell of its own, and their mean misleads. The mean
# price of the demo's features is 2.52 bits, a likelihood of 0.17, but the mean of the likelihoods
# is 0.23. Always average bits: the file pays the sum of the logarithms.

# %%
assert round(density_at(0) / 0.1, 3) == 3.989
assert close(likelihood.forward(*np.array([[[0.0]], [[0]], [[0.1]], [[0.1]]]))[0], 1.385, 1e-3)

alphabet = np.arange(-500.0, 501)[None]
of_29 = [np.full_like(alphabet, a[thread.index, 3]) for a in (means, deviations)]
every_price, _ = likelihood.forward(alphabet, *of_29, np.ones_like(alphabet))
assert close((2**-every_price).sum(), 1)
mean_bits, mean_likelihood = costs[3].mean(), (2 ** -costs[3]).mean()
print(f"{mean_bits:.2f} bits: {2**-mean_bits:.2f}; mean of likelihoods {mean_likelihood:.2f}")
assert np.round([mean_bits, 2**-mean_bits, mean_likelihood], 2).tolist() == [2.52, 0.17, 0.23]

# %% [markdown]
# ## Backward by hand
# We begin with the two numbers $z$ and $w$. Since $\Phi' = \phi$, and the edges of the bin move by
# $dz \pm \frac{1}{2}dw$,
# $$dp = (\phi_{high} - \phi_{low})\,dz + \tfrac{1}{2}(\phi_{high} + \phi_{low})\,dw,$$
# where $\phi_{high}$ and $\phi_{low}$ are the densities at the upper and the lower edge. Dividing
# the two factors by $p$ gives the slopes of $\log p$ in $z$ and in $w$. The function below obtains
# them from `likelihood`: for a standard Gaussian, $\tilde f = z$ and $q = w$.


# %%
def slopes_of_log_p(z, w):
    """Return the slopes of log p in z and in w, accurate for all z and w."""
    _, saved = likelihood.forward(z, np.zeros_like(z), np.ones_like(z), w)
    gradients = likelihood.backward(saved, np.full_like(z, -math.log(2)))  # from bits to log p
    return gradients["f_noisy"], gradients["q"]


slope_z, slope_w = slopes_of_log_p(z, w)
p = ndtr(z + w / 2) - ndtr(z - w / 2)
upper, lower = density_at(z + w / 2), density_at(z - w / 2)
assert close(slope_z, (upper - lower) / p, 1e-8)
assert close(slope_w, (upper + lower) / (2 * p), 1e-8)

# %% [markdown]
# Now the four inputs. From $z = (\tilde f - \mu)/\sigma$ and $w = q/\sigma$, by the quotient rule,
# $$dz = \frac{d\tilde f - d\mu - z\,d\sigma}{\sigma}, \qquad dw = \frac{dq - w\,d\sigma}{\sigma}.$$
# Both numbers are divided by $\sigma$, so its gradient has two terms. The bits are $-\log p/\ln 2$,
# so every gradient has the factor $\overline{bits}/(\sigma\ln 2)$:
# $$\bar f = -\frac{\overline{bits}}{\sigma\ln 2}\,slope_z, \quad \bar\mu = -\bar f,
# \quad \bar q = -\frac{\overline{bits}}{\sigma\ln 2}\,slope_w,$$
# $$\bar\sigma = \frac{\overline{bits}}{\sigma\ln 2}\,(z\,slope_z + w\,slope_w)$$
# All of this holds entry by entry, for arrays `[A, n]`.

# %%
bits_bar = rng.normal(size=(A, n))
ours = likelihood.backward(saved, bits_bar)
factor = bits_bar / (sigma * math.log(2))
assert close(ours["f_noisy"], -factor * slope_z, 1e-11)
assert np.array_equal(ours["mu"], -ours["f_noisy"])
assert close(ours["q"], -factor * slope_w, 1e-11)
assert close(ours["sigma"], factor * (z * slope_z + w * slope_w), 1e-11)

inputs = {"f_noisy": f, "mu": mu, "sigma": sigma, "q": q}
direction = {name: 0.1 * sigma * rng.normal(size=(A, n)) for name in inputs}
up, _ = likelihood.forward(**shift(inputs, direction, 1e-5))
down, _ = likelihood.forward(**shift(inputs, direction, -1e-5))
difference = inner(bits_bar, up - down) / 2e-5
gradient = inner(ours, direction)
assert close(difference, gradient, 1e-7)
print(f"by differences {difference:.9f}, by gradient {gradient:.9f}")

# %% [markdown]
# In narrow bins the gradients have a simple meaning, because there $slope_z \to -z$ and $slope_w
# \to 1/w$. The value is pulled towards the mean as by a spring, $\bar f = z/(\sigma\ln 2)$. The
# rate always pushes the step to grow: $\bar q = -1/(q\ln 2)$ means that doubling the step saves one
# bit. The gradient of the standard deviation, $\bar\sigma = (1 - z^2)/(\sigma\ln 2)$, vanishes at
# $z^2 = 1$.

# %%
narrow_q = 1e-4 * sigma
_, narrow_saved = likelihood.forward(f, mu, sigma, narrow_q)
narrow = likelihood.backward(narrow_saved, np.ones((A, n)))
per_bit = 1 / math.log(2)
assert close(narrow["f_noisy"], z / sigma * per_bit, 1e-6)
assert close(narrow["q"], -per_bit / narrow_q, 1e-6)
assert close(narrow["sigma"], (1 - z**2) / sigma * per_bit, 0.0001)

# %% [markdown]
# In the backward of Eq. (12), $\sigma = e^{raw}$ gives $\overline{raw} = \sigma\,\bar\sigma$, or 0
# where the logarithm was clamped. The gradients of the means and of the logarithms are written to
# their columns, which `prior.layout` lists, and then go back through the network.

# %%
mu_bar = rng.normal(size=(A, n))
sigma_bar = rng.normal(size=(A, n))
ours = prior.backward(prior_saved, mu_bar, sigma_bar)
mu_columns, raw_columns = prior.layout(widths)
psi_p_bar = np.zeros((A, 2 * n))
psi_p_bar[:, mu_columns] = mu_bar
psi_p_bar[:, raw_columns] = sigma_bar * sigma
assert close(ours["biases"][1], psi_p_bar.sum(axis=0))

clamped = np.array([0.0, 7.0])  # mu is 0, and log sigma is above the clamp
_, clamped_saved = prior.forward(np.zeros((1, 1)), [np.zeros((1, 2))], [clamped], (1,))
gradients = prior.backward(clamped_saved, np.zeros((1, 1)), np.ones((1, 1)))
assert not gradients["biases"][0].any()

# %% [markdown]
# ## Break it
# Far from the mean, probabilities become so small that a lower bound for them looks harmless. HAC,
# a codec for static scenes whose entropy model the paper follows, never lets the probability fall
# below $10^{-6}$, a *floor*. No number then costs more than 19.93 bits, and nothing is ever
# infinite. Training runs, but it reports a lower rate than the file will need, and on the floor the
# gradient is 0. A number 6 standard deviations from the mean is never pulled towards the mean,
# although it costs 25.7 bits by Eq. (11). And no coder can keep what this table promises: with the
# floor, the probabilities of $2^{16}$ symbols sum to 1.066.


# %%
def one(value, dtype=np.float64):
    """Return a number as an array [1, 1]."""
    return np.array([[value]], dtype)


def floored_bits(f_noisy, mu, sigma, q):
    bits, _ = likelihood.forward(f_noisy, mu, sigma, q)
    return np.minimum(bits, -math.log2(1e-6))


def floored_gradients(inputs, cotangents):
    bits, saved = likelihood.forward(**inputs)
    free = bits < -math.log2(1e-6)
    return likelihood.backward(saved, cotangents["bits_bar"] * free)


bits_6, saved_6 = likelihood.forward(one(6), one(0), one(1), one(1))
pull = likelihood.backward(saved_6, one(1))["f_noisy"]
six = {"f_noisy": one(6), "mu": one(0), "sigma": one(1), "q": one(1)}
no_pull = floored_gradients(six, {"bits_bar": one(1)})["f_noisy"]
print(f"z = 6 costs {bits_6[0, 0]:.1f} bits, with the floor {floored_bits(**six)[0, 0]:.2f}")
assert pull > 8
assert no_pull == 0

alphabet = np.arange(-(2.0**15), 2.0**15)[None]
ones = np.ones_like(alphabet)
promised = (2 ** -floored_bits(alphabet, 0 * ones, ones, ones)).sum()
print(f"with the floor, all probabilities sum to {promised:.3f}")
assert round(promised, 3) == 1.066

# %% [markdown]
# ## What a codec does with it
# The entropy coder uses only integers, because a different last digit on another machine would
# corrupt everything that follows. $\mu/q$ and $\log_2(\sigma/q)$ are rounded to small fractions,
# and $p$ becomes a count out of $2^{24}$. For $\mu = 0.3q$ and $\sigma = 1.5q$, the symbol $0$
# costs 1.947 bits in the file. Eq. (11) gives 1.965. The difference comes from rounding the two
# parameters: with their rounded values, $0.3125$ and $2^{9/16}$, Eq. (11) gives 1.947 as well.
# [See it move](viewer/demo.html#step=context): the distributions that the decoder predicts for an
# anchor.

# %%
from p4dgs_ref.codec.gaussian_table import gaussian_model

mu_in_file = round(0.3 * 1024)
log_sigma_in_file = 9  # log2(1.5) is about 9/16
table = gaussian_model(np.array([mu_in_file]), np.array([log_sigma_in_file]))
place = table.first[table.table[0]] - table.lowest[0]
count = table.keys[place + 1] - table.keys[place]
bits_in_file = 24 - math.log2(count)
bits_exact, _ = likelihood.forward(one(0), one(0.3), one(1.5), one(1))
bits_rounded, _ = likelihood.forward(one(0), one(0.3125), one(2 ** (9 / 16)), one(1))
print(f"{bits_in_file:.3f} bits in the file, {bits_exact[0, 0]:.3f} by Eq. (11)")
assert abs(bits_in_file - bits_rounded[0, 0]) < 1e-3
assert abs(bits_in_file - bits_exact[0, 0]) > 1e-2

# %% [markdown]
# **Noise pays the average.** Training pays for the number with noise, the file for the rounded one.
# Are these the same bits? Suppose that $f$ follows the bell, and let $P(x)$ be the area over the
# bin around $x$. The density of $\tilde f$ is $P(x)/q$ (`07_noise_and_rounding`), so with noise one
# pays on average
# $$\int \frac{P(x)}{q}\,\bigl(-\log_2 P(x)\bigr)\,dx
#   = \frac{1}{q}\int_0^q \sum_m P(mq + r)\,\bigl(-\log_2 P(mq + r)\bigr)\,dr.$$
# The sum on the right is what rounding pays if all multiples of $q$ are shifted by $r$. In other
# words, *noise is rounding to a random grid*, and its price is exact on average over all grids. The
# file has one grid. With $\sigma = q$ this makes no difference: 2.105 bits in all cases. With
# $\sigma = 0.1\,q$ noise pays 0.261 bits, rounding nothing if the mean is a multiple of $q$, and
# 1 bit if it lies between two.


# %%
def price_on_grids(deviation, shifts):
    """Return the mean bits of a normal number rounded to the integers plus a shift."""
    P = np.diff(ndtr((np.arange(-30.5, 31.5)[:, None] + shifts) / deviation), axis=0)
    return -(P * np.log2(np.where(P > 0, P, 1))).sum(axis=0)


every_shift = (np.arange(200) + 0.5) / 200
for deviation in (1.0, 0.1):
    with_noise = price_on_grids(deviation, every_shift).mean()
    on, between = price_on_grids(deviation, np.array([0, 0.5]))
    print(f"{deviation} q: {with_noise:.3f} with noise, {on:.3f} or {between:.3f} rounded")
assert np.round([with_noise, on, between], 3).tolist() == [0.261, 0, 1]

# %% [markdown]
# ## What this idea buys
# The paper's Table 3 measures rounding and entropy coding together, as the last of its three ideas:
# T-Rex shrinks from 5.39 to 0.85 MB, 6.3 times. Here the anchors shrink from 29,551 to 4,569 bytes,
# 6.5 times, but the file only from 76,590 to 38,649. The rest is mostly networks, which are rounded
# to float16 and not entropy coded. They are 87 percent of our file, and a third of the paper's at
# its higher rate.

# %%
from tutorials import gains

rows = {
    "float32 anchors": "+ compact deformation MLP",
    "rounded and coded": "+ quantisation and entropy coding",
}
assert [round(gains.mean(label, "gaussians_bytes")) for label in rows.values()] == [29551, 4569]
paper = {"before": (5.39, "38.34 dB"), "rounded and coded": (0.85, "38.24 dB")}
gains.show("10_prior_and_likelihood", rows, paper)

# %% [markdown]
# **In short**
# - A number costs $-\log_2$ of the probability of its bin: the area under the bell, over the width
#   of one step.
# - The guess and its width come from the context, so the decoder has both before it reads the
#   number.
# - The gradients pull values and guesses towards each other, and the widths to the size of the
#   usual error. They always push steps to grow.
#
# **Often misunderstood**
# - *The density is the probability.* Its logarithm would change with the unit of the scene, and
#   could be negative; a bin has a width.
# - *A wide bell is on the safe side.* No number then costs very much, but every number costs more
#   than it needs to.
# - *The file contains $\mu$ and $\sigma$.* It contains the grid of Eq. (9) and the network
#   $\psi_p$, from which both sides compute them.

# %% [markdown]
# ## Exercises
# **10.1** ● With $\sigma = 0.02$ and $q = 0.001$, what are the density and the likelihood of a
# value at the mean? Give a list of two numbers.
#
# **10.2** ●● Compute $\log p$ (natural logarithm) of the golden bins `z_golden` and `w_golden`
# below, as an array of the same length. Here $|z|$ lies between $1$ and $40$, and $w = 1$. The
# formula with `erfcx` of *For ports* works for all of them if you use $|z|$. So does
# `scipy.special.log_ndtr`, which is $\log\Phi$ with all its digits.
#
# **10.3** ●● So that the tables of its coder stay short, a port bounds $\sigma$ of Eq. (12) from
# below: $\sigma = \max(e^{r}, q/4)$, where $r$ is the output of $\psi_p$. What changes in the
# gradient? For $f = 0.3$, $\mu = 0.1$, $r = \ln 0.02$ and $q = 0.2$, give the gradients of the bits
# in $r$ and $q$.
#
# **10.4** ●●● Write the backward of Eq. (11), with the function `slopes_of_log_p` of this tutorial.
#
# **Predict, then run.** The unit of a scene changes from metres to millimetres, so that $f$, $\mu$,
# $\sigma$ and $q$ are all multiplied by $1000$. What happens to the bits, and what happens to the
# gradient of $\mu$?

# %%
case = lessons.golden("gaussian_bin/tails")
near = np.abs(case["in.z"]) <= 40
z_golden, w_golden = case["in.z"][near], case["in.w"][near]
answer_1 = ...
answer_2 = ...
answer_3 = ...


def my_likelihood_backward(inputs, cotangents):
    """Return the gradients {"f_noisy", "mu", "sigma", "q"}, given cotangents["bits_bar"] [A, n]."""
    raise NotImplementedError


lessons.check_number("10.1", answer_1)
lessons.check_number("10.2", answer_2, case["out.log_p"][near], digits=9)
lessons.check_number("10.3", answer_3)
lessons.check_backward("10.4", my_likelihood_backward, "likelihood")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only likelihood` and `--only prior` check what a port wrote; start
# with the scalar formula, `--only gaussian_bin`. Besides the tails, the usual mistakes are natural
# logarithms in place of bits, a density in place of a probability, which the checker names, a
# variance in place of a standard deviation, and a network that returns all means first instead of
# group by group.


# %%
lessons.passes("likelihood", "prior")

# %% [markdown]
# ## For ports
# Eq. (11) is correct, but a computer cannot always evaluate it as printed.
#
# **The printed formula fails in the tails.** Far to the right of the mean, both values of $\Phi$
# round to 1 and their difference is 0. In bins of one sigma, $w = 1$, this happens at $z = 9$ in
# `float64`, and already at $z = 6$ in `float32`; how far out depends on the width of the bin. The
# bits are then infinite and their gradient is NaN.


# %%
with np.errstate(divide="ignore"):
    printed_9 = likelihood.literal(one(9), one(0), one(1), one(1))
    printed_6 = likelihood.literal(*(one(value, np.float32) for value in (6, 0, 1, 1)))
assert printed_9 == np.inf
assert printed_6 == np.inf

# %% [markdown]
# At $z = -9$ nothing is wrong: to the left of the mean, $\Phi$ is small and keeps all its digits.
# The Gaussian is symmetric, so we can use the mirrored bin there:
# $$p = \Phi(-low) - \Phi(-high), \qquad
# low = |z| - \tfrac{1}{2}w, \quad high = |z| + \tfrac{1}{2}w$$
# Now the bin at $z = 9$ costs 56.6 bits. If a bin contains the mean, its probability is one minus
# two such tails, and `log1p` computes the logarithm without losing digits.

# %%
mirrored_9 = -math.log2(ndtr(-8.5) - ndtr(-9.5))
assert close(likelihood.literal(one(-9), one(0), one(1), one(1))[0, 0], mirrored_9)
bits_9, _ = likelihood.forward(one(9), one(0), one(1), one(1))
assert close(bits_9[0, 0], mirrored_9)
print(f"z = 9 costs {mirrored_9:.1f} bits")

# %% [markdown]
# Mirroring the bin is only half of the solution (`24_hard_cases` shows both sides on a map). From
# about $z = 38$ on, even $\Phi(-low)$ is too small for a float, but its logarithm is not. SciPy has
# the function $\mathrm{erfcx}(v) = e^{v^2}\mathrm{erfc}(v)$, which omits the factor that becomes so
# small. With $\Phi(-v) = \frac12\mathrm{erfc}(v/\sqrt2)$, we get $\log p = \log g -
# \frac{1}{2}low^2$, where
# $$g = \tfrac12\bigl(\mathrm{erfcx}(low/\sqrt2)
# - e^{(low^2 - high^2)/2}\,\mathrm{erfcx}(high/\sqrt2)\bigr).$$

# %%
low, high = 39.5, 40.5
beyond = math.exp((low**2 - high**2) / 2) * erfcx(high / math.sqrt(2))
g = 0.5 * (erfcx(low / math.sqrt(2)) - beyond)
by_erfcx = -(math.log(g) - low**2 / 2) / math.log(2)
bits_40, _ = likelihood.forward(one(40), one(0), one(1), one(1))
assert ndtr(-38.5) == 0
assert close(bits_40[0, 0], by_erfcx)
print(f"z = 40 costs {by_erfcx:.6f} bits")

# %% [markdown]
# **Narrow bins** have the same problem at any $z$, because both edges have nearly the same $\Phi$.
# The density is then almost constant over the bin. If its Taylor series about the middle of the bin
# is integrated term by term, no difference between two edges is needed:
# $$p = \phi(z)\,w\,\Bigl(1 + \frac{w^2}{24}(z^2 - 1) + \dots\Bigr)$$
#
# The module `likelihood.py` therefore computes $\log p$ with different functions in different
# *regimes*: around the mean, next to it, far from it, and in narrow bins.

# %%
z_narrow = 0.7
w_narrow = np.geomspace(1e-14, 1e-2, 49)
second = w_narrow**2 / 24 * (z_narrow**2 - 1)
fourth = w_narrow**4 / 1920 * (z_narrow**4 - 6 * z_narrow**2 + 3)
series = density_at(z_narrow) * w_narrow * (1 + second + fourth)
row = w_narrow[None]
narrow_bits, _ = likelihood.forward(0 * row + z_narrow, 0 * row, 0 * row + 1, row)
printed = ndtr(z_narrow + w_narrow / 2) - ndtr(z_narrow - w_narrow / 2)
both_forms = {"in regimes": np.exp2(-narrow_bits[0]), "as printed, float64": printed}
errors = {name: np.abs(p / series - 1) for name, p in both_forms.items()}
assert errors["in regimes"].max() < 1e-13
assert errors["as printed, float64"][w_narrow < 1e-13].max() > 1e-3

distance = np.linspace(0, 14, 141)[None]
standard = [distance, 0 * distance, 0 * distance + 1, 0 * distance + 1]  # f, mu, sigma, q
forms = {"in regimes": likelihood.forward(*standard)[0]}
with np.errstate(divide="ignore"):
    forms["as printed, float64"] = likelihood.literal(*standard)
    forms["as printed, float32"] = likelihood.literal(*(a.astype(np.float32) for a in standard))
forms["HAC's floor of $10^{-6}$"] = floored_bits(*standard)

# %% [markdown]
# Left: the cost of a symbol far from the mean, with the printed formula, with the floor of "Break
# it", and with a function for each regime. Right: the error of the probability in narrow bins.


# %%
panels.tails_and_digits(distance, forms, w_narrow, errors)

# %% [markdown]
# The golden vectors find both mistakes, the floor and the printed formula. Both fail in the tails
# and pass on ordinary inputs.

# %%
from p4dgs_ref import oracle

with np.errstate(all="ignore"):
    of_floor = oracle.check(floored_bits, "likelihood", floored_gradients)
    of_printed = oracle.check(likelihood.literal, "likelihood")
for name, report in (("floor", of_floor), ("printed formula", of_printed)):
    passed = [r.id for r in report.results if r.verdict == "pass"]
    print(f"{name}: {len(passed)} of {len(report.results)} cases pass")
    assert "likelihood/ordinary" in passed
    assert "likelihood/tail" not in passed

# %% [markdown]
# ## An open project
# **Beat the context with a table.** The hash grid and the networks give the decoder a step, a mean
# and a deviation for every number. Is a table enough, for example one mean and one deviation for
# each column? `p4dgs-ref inspect tutorials/demo.p4dgs` prints the baseline. The symbols of
# features, scales, offset scales and offsets take $1013 + 337 + 417 + 1566 = 3333$ bytes, and the
# context takes $149$ (`hash_grid`) and $4112$ (`context_mlps`). The sum is $7594$ bytes.
#
# Measure the same sum for your table, with the same symbols. The sum consists of the symbols' bits
# by Eq. (11) ($3304$ bytes with the context), $29$ bytes for the coder, the table, and what you
# keep of the context. If the steps still come from $\psi_q$, you keep the grid and $484$ of the
# $2056$ numbers in `context_mlps`, $968$ bytes. With a Gaussian for each column, the bits are
# $3868$ bytes and the table is $136$; the sum is $5150$, because a context for $199$ anchors costs
# more than it saves. You have succeeded if you need fewer than $5150$ bytes.
#
# To begin, call `quantised_of(container.read_container(data))` of the package's `codec`. It returns
# the `symbols [199, 34]`, and `kept` says which of them the file contains. In units of its step,
# every bin has the width $1$. Find out which columns are not Gaussian and which ones predict each
# other. What happens to both sums with ten times as many anchors?
