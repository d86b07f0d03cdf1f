# %% [markdown]
# # Eq. (11) and Eq. (12): what a number costs
#
# **Promise.** After this you can price a number in bits, far out and in narrow bins too, and derive all four gradients.
# **Before it:** `07_noise_and_rounding`, `08_step`. **Takes** two seconds on two cores, an hour of yours.

# %%
import math

import numpy as np
from scipy.special import erfcx, ndtr

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.equations import gaussian_bin, likelihood, mlp, prior
from p4dgs_ref.school import lessons

plt = lessons.pyplot()
rng = np.random.default_rng(10)

# %% [markdown]
# ## Claim
# A number that the decoder expects costs little, a surprise costs much. A network predicts a Gaussian for each number, from the
# context $h$ of Eq. (9):
# $$(\mu, \sigma) = \psi_p(h) \tag{12}$$
# A symbol stands for all values within half a step, so its probability is the Gaussian's mass in that *bin*:

# %% [markdown]
# $$p(\tilde{f}_a)=\int_{\tilde{f}_a-\frac{1}{2}q}^{\tilde{f}_a+\frac{1}{2}q}\phi_{\mu,\sigma}(x)dx
# = \Phi_{\mu,\sigma}\left(\tilde{f_a}+\frac{1}{2}q\right) - \Phi_{\mu,\sigma}\left(\tilde{f_a}-\frac{1}{2}q\right) \tag{11}$$
# The price is $b = -\log_2 p$ bits: what an ideal entropy coder pays.

# %% [markdown]
# ## By hand
# Mean 0, deviation 1, step 1. The symbol 0 owns the bin from $-0.5$ to $0.5$: mass 0.3829, so 1.385 bits.
# The symbol 1 has mass 0.2417 and costs 2.049 bits; the symbol 3, 7.386 bits.

# %%
Phi = lambda x: 0.5 * (1 + math.erf(x / math.sqrt(2)))
mass = [Phi(k + 0.5) - Phi(k - 0.5) for k in range(4)]
assert abs(mass[0] - 0.3829) < 5e-5 and abs(mass[1] - 0.2417) < 5e-5
assert [round(-math.log2(mass[k]), 3) for k in (0, 1, 3)] == [1.385, 2.049, 7.386]

# %% [markdown]
# ## In code
# `psi_p` has `2n` outputs for the `n` numbers of an anchor: group by group f, s, l, O, all means of a group, then all its raw
# deviations. $\sigma = e^{raw}$, with raw clamped to $[-14, 6]$ (choice Q8): it is positive and neither 0 nor infinite.

# %%
A, I, widths = 6, 5, (2, 3, 3, 3)
n = sum(widths)
weights, biases = mlp.random_network(rng, I, 7, 2 * n)
h = rng.normal(size=(A, I))
p, p_res = prior.forward(h, weights, biases, widths)
y = mlp.forward(h, weights, biases)[0].y
assert p.mu.shape == p.sigma.shape == (A, n)
assert np.array_equal(p.mu[:, :2], y[:, :2]) and np.array_equal(p.mu[:, 2:5], y[:, 4:7])
assert np.array_equal(p.sigma[:, :2], np.exp(y[:, 2:4])) and math.exp(-14) > 0
f, q = p.mu + p.sigma * rng.normal(size=(A, n)), p.sigma * rng.uniform(0.2, 3, (A, n))
out, res = likelihood.forward(f, p.mu, p.sigma, q)
assert out.bits.shape == (A, n) and (out.bits > 0).all()

# %% [markdown]
# Two numbers decide everything: $z = (\tilde f - \mu)/\sigma$, how far from the mean, and $w = q/\sigma$, how wide the bin.
# In these units the edges are $z \pm w/2$ and the Gaussian is the standard one.

# %%
z, w = (f - p.mu) / p.sigma, q / p.sigma
printed = -np.log2(ndtr(z + w / 2) - ndtr(z - w / 2))
assert np.allclose(out.bits, printed, rtol=1e-9)

# %% [markdown]
# **The printed formula dies in the tail.** Far right of the mean both values of $\Phi$ round to 1, and nothing is left between.
# In `float64` it is 0 for $z = 9$, $w = 1$: infinite bits, and a gradient that is no number. In `float32`, $z = 6$ is enough.

# %%
with np.errstate(divide="ignore", invalid="ignore"):
    at_9 = likelihood.literal(*(np.array([[v]]) for v in (9.0, 0.0, 1.0, 1.0)))
    at_6 = likelihood.literal(*(np.array([[v]], np.float32) for v in (6.0, 0.0, 1.0, 1.0)))
assert at_9[0].bits == np.inf and np.isnan(at_9[1].sigma_slope) and 1 - ndtr(8.5) == 0
assert at_6[0].bits == np.inf and at_6[0].bits.dtype == np.float32

# %% [markdown]
# The Gaussian is even: look at the bin from the left, where $\Phi$ is small and has all its digits.
# $$p = \Phi(-low) - \Phi(-high), \qquad low = |z| - \tfrac{1}{2}w, \quad high = |z| + \tfrac{1}{2}w$$
# Now $z = 9$ costs 56.6 bits. A bin that holds the mean is one minus two such tails, by `log1p`.

# %%
assert round(-math.log2(ndtr(-8.5) - ndtr(-9.5)), 1) == 56.6
stable_9 = likelihood.forward(*(np.array([[v]]) for v in (9.0, 0.0, 1.0, 1.0)))[0].bits[0, 0]
assert np.isclose(stable_9, -math.log2(ndtr(-8.5) - ndtr(-9.5)), rtol=1e-13)

# %% [markdown]
# At $z = 39$ even $\Phi(-low)$ is too small for a float. Its logarithm is not. $\Phi(-v) = \frac12\mathrm{erfc}(v/\sqrt2)$,
# and $\mathrm{erfcx}(v) = e^{v^2}\mathrm{erfc}(v)$ has the main factor taken out, so $\log p = \log g - \frac{1}{2}low^2$ with
# $$g = \tfrac12\bigl(\mathrm{erfcx}(low/\sqrt2) - e^{(low^2 - high^2)/2}\,\mathrm{erfcx}(high/\sqrt2)\bigr).$$

# %%
low, high = 39.5, 40.5
g = 0.5 * (
    erfcx(low / math.sqrt(2)) - math.exp((low**2 - high**2) / 2) * erfcx(high / math.sqrt(2))
)
bits_40 = -(math.log(g) - low**2 / 2) / math.log(2)
ours = likelihood.forward(*(np.array([[v]]) for v in (40.0, 0.0, 1.0, 1.0)))[0].bits[0, 0]
assert ndtr(0.5 - 39) == 0 and ndtr(-37.5) > 0 and abs(ours / bits_40 - 1) < 1e-12
print(f"40 deviations out: {bits_40:.6f} bits")

# %% [markdown]
# **Narrow bins** have the same illness: two nearly equal values, anywhere. There the density is all but constant, and its
# Taylor series about the bin's centre, integrated, needs no difference of two edges:
# $$p = \phi(z)\,w\,\Bigl(1 + \frac{w^2}{24}(z^2 - 1) + \dots\Bigr)$$
#
# The picture: a symbol's area; what a symbol costs farther and farther out; the digits that narrow bins keep.

# %%
z_n, w_n = 0.7, np.geomspace(1e-14, 1e-2, 49)
density = math.exp(-(z_n**2) / 2) / math.sqrt(2 * math.pi)
series = (
    density * w_n * (1 + w_n**2 / 24 * (z_n**2 - 1) + w_n**4 / 1920 * (z_n**4 - 6 * z_n**2 + 3))
)
stable = np.exp(
    gaussian_bin.stable(
        np.full((1, 49), z_n), np.zeros((1, 49)), np.ones((1, 49)), w_n[None]
    ).log_p[0]
)
assert np.abs(stable / series - 1).max() < 1e-13
wrong_by = np.abs((ndtr(z_n + w_n / 2) - ndtr(z_n - w_n / 2)) / series - 1)
assert wrong_by[w_n < 1e-13].max() > 1e-3

far = np.linspace(0, 14, 141)[None]
one, none = np.ones_like(far), np.zeros_like(far)
with np.errstate(divide="ignore", invalid="ignore"):
    curves = {
        "stable": likelihood.forward(far, none, one, one)[0].bits[0],
        "as printed, float64": likelihood.literal(far, none, one, one)[0].bits[0],
        "as printed, float32": likelihood.literal(
            *(a.astype(np.float32) for a in (far, none, one, one))
        )[0].bits[0],
        "HAC's floor of $10^{-6}$": likelihood.hac(far, none, one, one)[0].bits[0],
    }
figure, axes = plt.subplots(1, 3, figsize=(16, 4.8), layout="constrained")
x = np.linspace(-3.5, 3.5, 701)
phi = np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
axes[0].plot(x, phi, color="k", label=r"density $\phi_{\mu,\sigma}$")
for k, color in ((0, lessons.COLORS[0]), (1, lessons.COLORS[4]), (3, lessons.COLORS[1])):
    inside = np.abs(x - k) <= 0.5
    axes[0].fill_between(
        x[inside],
        phi[inside],
        color=color,
        alpha=0.7,
        label=f"symbol {k}: {-math.log2(mass[k]):.2f} bits",
    )
axes[0].set(
    xlabel=r"value (in $\sigma$, from $\mu$)",
    ylabel=r"density (per $\sigma$)",
    ylim=(0, 0.58),
    title="A symbol's probability is an area",
)
axes[0].legend(loc="upper left", fontsize=10, ncols=2)
for (name, bits), style, color in zip(curves.items(), ("-", "--", "--", ":"), (0, 1, 4, 3)):
    axes[1].plot(
        far[0],
        np.where(np.isfinite(bits), bits, np.nan),
        style,
        lw=3.5 if style == "-" else 2.5,
        color=lessons.COLORS[color],
        label=name,
    )
    if np.isinf(bits).any():
        wall = far[0][np.isinf(bits)][0]  # infinite bits from here on
        axes[1].plot(
            [wall, wall],
            [bits[np.isfinite(bits)][-1], 150],
            style,
            lw=2.5,
            color=lessons.COLORS[color],
        )
axes[1].set(
    xlabel=r"distance from $\mu$ (in $\sigma$)",
    ylabel="bits",
    ylim=(0, 150),
    title="Tails: as printed, infinite from the wall on",
)
axes[1].legend(loc="upper left", fontsize=10)
axes[2].loglog(w_n, wrong_by + 1e-17, color=lessons.COLORS[1], label="as printed, float64")
axes[2].loglog(w_n, np.abs(stable / series - 1) + 1e-17, color=lessons.COLORS[0], label="stable")
axes[2].set(
    xlabel=r"width of the bin $q/\sigma$",
    ylabel="relative error of the mass",
    title="Narrow bins: digits gone one by one",
)
axes[2].legend(loc="upper right", fontsize=10)
lessons.show(figure, "10_prior_and_likelihood")

# %% [markdown]
# ## Backward by hand
# First in the two numbers. $\Phi' = \phi$, the edges move by $dz \pm \frac{1}{2}dw$. With $\phi_{up}$, $\phi_{low}$ at the edges
# $$dp = (\phi_{up} - \phi_{low})\,dz + \tfrac{1}{2}(\phi_{up} + \phi_{low})\,dw$$
# What multiplies $dz$ and $dw$, divided by $p$, are the slopes of $\log p$: `slope_z` and `slope_w`.

# %%
b = gaussian_bin.stable(f, p.mu, p.sigma, q)
phi_up, phi_low = (
    np.exp(-0.5 * edge**2) / math.sqrt(2 * math.pi) for edge in (z + w / 2, z - w / 2)
)
P = ndtr(z + w / 2) - ndtr(z - w / 2)
assert np.allclose(b.slope_z, (phi_up - phi_low) / P, rtol=1e-8, atol=1e-12)
assert np.allclose(b.slope_w, (phi_up + phi_low) / (2 * P), rtol=1e-8)

# %% [markdown]
# Then the four inputs. From $z = (\tilde f - \mu)/\sigma$ and $w = q/\sigma$, by the rule for quotients:
# $$dz = \frac{d\tilde f - d\mu - z\,d\sigma}{\sigma}, \qquad dw = \frac{dq - w\,d\sigma}{\sigma}$$
# $\sigma$ scales both, so it collects two terms. Bits are $-\log p/\ln 2$: each line below has the factor $\bar b/(\sigma\ln 2)$.

# %% [markdown]
# $$\bar f = -\frac{\bar b}{\sigma\ln 2}\,slope_z, \quad \bar\mu = -\bar f, \quad \bar q = -\frac{\bar b}{\sigma\ln 2}\,slope_w,$$
# $$\bar\sigma = \frac{\bar b}{\sigma\ln 2}\,(z\,slope_z + w\,slope_w)$$
# All entry by entry, `(A, n)`. In code: `per_unit = -1 / (log(2) * sigma)`, then the three products with the slopes.

# %%
bits_bar = rng.normal(size=(A, n))
bars, per_unit = likelihood.backward(res, bits_bar), -1 / (math.log(2) * p.sigma)
assert np.allclose(bars["f_noisy"], bits_bar * per_unit * b.slope_z, rtol=1e-13)
assert np.array_equal(bars["mu"], -bars["f_noisy"])
assert np.allclose(bars["q"], bits_bar * per_unit * b.slope_w, rtol=1e-13)
assert np.allclose(
    bars["sigma"], bits_bar * per_unit * -(b.z * b.slope_z + b.w * b.slope_w), rtol=1e-13
)
inputs = dict(f_noisy=f, mu=p.mu, sigma=p.sigma, q=q)
d = {name: 0.1 * p.sigma * rng.normal(size=(A, n)) for name in inputs}
up, down = (
    likelihood.forward(**{m: a + s * 1e-5 * d[m] for m, a in inputs.items()})[0].bits
    for s in (1, -1)
)
difference, gradient = (bits_bar * (up - down)).sum() / 2e-5, sum((bars[m] * d[m]).sum() for m in d)
assert abs(difference - gradient) < 1e-7 * abs(gradient)
print(f"by differences {difference:.9f}, by gradient {gradient:.9f}")

# %% [markdown]
# What the signs say, for narrow bins, where $slope_z \to -z$ and $slope_w \to 1/w$. The value is pulled to the mean as by a
# spring, $\bar f = z/(\sigma\ln 2)$. The step always wants to grow: $\bar q = -1/(q\ln 2)$, one bit for each doubling.
# The deviation rests where $z^2 = 1$, by $\bar\sigma = (1 - z^2)/(\sigma\ln 2)$.

# %%
narrow = likelihood.backward(
    likelihood.forward(f, p.mu, p.sigma, 1e-4 * p.sigma)[1], np.ones((A, n))
)
assert np.allclose(narrow["f_noisy"], z / (p.sigma * math.log(2)), rtol=1e-6)
assert np.allclose(narrow["q"], -1 / (1e-4 * p.sigma * math.log(2)), rtol=1e-6)
assert np.allclose(narrow["sigma"], (1 - z**2) / (p.sigma * math.log(2)), rtol=1e-4, atol=1e-6)

# %% [markdown]
# The prior's backward: $\sigma = e^{raw}$ gives $\overline{raw} = \sigma\,\bar\sigma$, and 0 outside the clamp. Means and raw
# deviations go back to their columns, `y_bar[:, res.columns[0]]` and `[1]`, and then through the network.

# %%
mu_bar, sigma_bar = rng.normal(size=(A, n)), rng.normal(size=(A, n))
back = prior.backward(p_res, mu_bar, sigma_bar)
mu_columns, raw_columns = prior.layout(widths)
y_bar = np.zeros((A, 2 * n))
y_bar[:, mu_columns], y_bar[:, raw_columns] = mu_bar, sigma_bar * p.sigma
assert np.allclose(back["biases"][1], y_bar.sum(axis=0), rtol=1e-12)
clamped = prior.forward(np.zeros((1, 1)), [np.zeros((1, 2))], [np.array([0.0, 7.0])], (1,))[1]
assert prior.backward(clamped, sigma_bar=np.ones((1, 1)))["biases"][0].tolist() == [0, 0]

# %% [markdown]
# ## Break it
# HAC, the codec of still scenes whose prior the paper follows, puts a floor of 1e-6 under the mass: at most 19.93 bits, and never
# an infinity. Training runs, and reports a lower rate. But on the floor the gradient is 0: a number 6 deviations out is never
# pulled in, though by Eq. (11) it costs 25.7 bits.

# %%
six = [np.array([[v]]) for v in (6.0, 0.0, 1.0, 1.0)]
floored, right = likelihood.hac(*six), likelihood.forward(*six)
assert (
    round(floored[0].bits[0, 0], 2) == 19.93 and abs(2.0 ** -floored[0].bits[0, 0] - 1e-6) < 1e-12
)
assert likelihood.backward(floored[1], np.ones((1, 1)))["f_noisy"] == 0 and six[0] == 6
assert round(right[0].bits[0, 0], 1) == 25.7
assert likelihood.backward(right[1], np.ones((1, 1)))["f_noisy"] > 8
found = {}
for rung in (likelihood.hac, likelihood.literal):
    with np.errstate(all="ignore"):
        report = oracle.check(
            lambda **i: rung(**i)[0],
            "likelihood",
            lambda i, c: likelihood.backward(rung(**i)[1], **c),
        )
    found[rung.__name__] = names = [
        r.id.split("/")[1] for r in report.results if r.verdict != "pass"
    ]
    print(
        rung.__name__,
        "passes",
        len(report.results) - len(names),
        "cases, fails",
        len(names),
        "as",
        names[:3],
    )
assert all("tail" in names and "ordinary" not in names for names in found.values())

# %% [markdown]
# ## What a codec does with it
# The coder uses no floats: a last digit that differs on another machine would spoil all that follows. $\mu/q$ and
# $\log_2(\sigma/q)$ are rounded to small fractions, and $p$ becomes a count out of $2^{24}$. For $\mu = 0.3q$, $\sigma = 1.5q$
# the symbol $0$ costs 1.947 bits there. Eq. (11) says 1.965, and 1.947 with the rounded ones, $0.3125$ and $2^{9/16}$ steps.

# %%
from p4dgs_ref.codec.gaussian_table import gaussian_model

table = gaussian_model(np.array([round(0.3 * 1024)]), np.array([9]))  # log2(1.5) is about 9/16
place = table.first[table.table[0]] - table.lowest[0]
bits_in_file = 24 - math.log2(table.keys[place + 1] - table.keys[place])
by_equation = [
    likelihood.forward(*(np.array([[v]]) for v in (0.0, mu, sigma, 1.0)))[0].bits[0, 0]
    for mu, sigma in ((0.3, 1.5), (0.3125, 2 ** (9 / 16)))
]
assert round(bits_in_file, 3) == 1.947 and [round(bits, 3) for bits in by_equation] == [
    1.965,
    1.947,
]

# %% [markdown]
# ## Exercises
# **10.1** $\log p$, natural, of the golden bins `z_golden`, `w_golden` below, an array as long: $|z|$ from $1$ to $40$, $w = 1$.
# The formula with `erfcx` serves them all, mind $|z|$; so does `scipy.special.log_ndtr`, $\log\Phi$ with all its digits.
# **10.2** The backward of Eq. (12), with `mlp.forward`, `mlp.backward`, `prior.layout`, `prior.RAW_MIN` and `RAW_MAX`.
# **10.3** That of Eq. (11), from `gaussian_bin.stable(f, mu, sigma, q)`, which has `z`, `w`, `slope_z` and `slope_w`.

# %%
case = lessons.golden("gaussian_bin/tails")
near = np.abs(case["in.z"]) <= 40
z_golden, w_golden = case["in.z"][near], case["in.w"][near]
answer_1 = ...


def my_prior_backward(inputs, cotangents):
    """{"h", "weights", "biases"}: gradients, from inputs of these names, inputs["widths"], and cotangents["mu_bar"],
    cotangents["sigma_bar"] (A, n)."""
    raise NotImplementedError


def my_likelihood_backward(inputs, cotangents):
    """{"f_noisy", "mu", "sigma", "q"}: gradients (A, n), from cotangents["bits_bar"] (A, n)."""
    raise NotImplementedError


lessons.number("10.1", answer_1, case["out.log_p"][near], digits=9)
lessons.backward("10.2", my_prior_backward, "prior")
lessons.backward("10.3", my_likelihood_backward, "likelihood")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only likelihood` and `--only prior`; first the scalar, `--only gaussian_bin`. What goes wrong
# besides tails: nats for bits, a variance for a deviation, all means first in the network's output instead of group by group.

# %%
print(oracle.check(lambda **i: likelihood.forward(**i)[0], "likelihood"))
assert oracle.check(
    lambda **i: likelihood.forward(**i)[0],
    "likelihood",
    lambda i, c: likelihood.backward(likelihood.forward(**i)[1], **c),
).ok
assert (
    oracle.check(lambda **i: prior.forward(**i)[0], "prior").ok
    and EQUATIONS["likelihood"].number == "11"
)
