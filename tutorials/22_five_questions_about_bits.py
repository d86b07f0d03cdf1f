# %% [markdown]
# # Five questions everybody asks about bits
#
# **Promise.** After this you can answer the five questions that users of learned codecs ask most, each with a number.
# **Before it:** `07_noise_and_rounding`, `08_step`, `10_prior_and_likelihood`. **Takes** three seconds on two cores, an hour
# of yours.

# %%
import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from p4dgs_ref import EQUATIONS, look_at, oracle
from p4dgs_ref.codec import container, inspect
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS, quantised_of
from p4dgs_ref.equations import likelihood, noise
from p4dgs_ref.oracle import stages_coding
from p4dgs_ref.school import lessons

plt = lessons.pyplot()
rng = np.random.default_rng(22)
data = (oracle.path() / "model.p4dgs").read_bytes()  # a trained model of 60 anchors
model = quantised_of(container.open_container(data))
design, prior, kept = model.model.design, inspect.float_context(model.model), model.kept
q = np.repeat(model.context.q, design.widths, axis=1)
price = lambda values: likelihood.forward(values, prior.mu, prior.sigma, q)[0].bits[kept]

# %% [markdown]
# ## Claim
# **One: why is a likelihood above one?** It is a density. Eq. (11) has a mass, which never is.
# **Two: why do likelihoods not sum to one?** They do, over the symbols that *could* be; not over those that *are*.
# **Three: is the estimate the file?** To a few percent, for what it counts. It does not count everything.

# %% [markdown]
# **Four: why noise in training, rounding in the file?** Noise has a slope, and on average it has the right price.
# **Five: why adaptive steps?** A number that the picture hardly feels may be coarse; that pays for fine ones elsewhere.

# %% [markdown]
# ## By hand
# **Question one.** A Gaussian with $\sigma = 0.1$ has the density 3.989 at its mean: so much *per unit* of the attribute, so it
# may be any size. Its "bits" would be -2.0, fewer than none. The bin of width $q = 0.1$ there has the mass 0.3829, a
# probability, without unit: 1.385 bits. Where bins are narrow, mass is density times $q$.

# %%
density = 1 / (0.1 * math.sqrt(2 * math.pi))
mass = ndtr(0.5) - ndtr(-0.5)
assert round(density, 3) == 3.989 and round(-math.log2(density), 1) == -2.0
assert round(mass, 4) == 0.3829 and round(-math.log2(mass), 3) == 1.385
tiny = math.exp(
    -likelihood.forward(*(np.array([[v]]) for v in (0.0, 0.0, 0.1, 1e-4)))[0].bits[0, 0]
    * math.log(2)
)
assert abs(tiny / (density * 1e-4) - 1) < 1e-6

# %% [markdown]
# ## In code
# All 1416 numbers of a trained model, as they are in its file: every likelihood is between 0 and 1. Their mean is 0.124, but the
# mean price is 4.076 bits, a likelihood of 0.059. Average bits, never likelihoods: the sum of logarithms is what is paid.

# %%
bits = price(model.symbols * q)
p = 2.0**-bits
assert len(p) == 1416 and 0 < p.min() and p.max() <= 1
assert (
    round(p.mean(), 3) == 0.124
    and round(bits.mean(), 3) == 4.076
    and round(2.0 ** -bits.mean(), 3) == 0.059
)

# %% [markdown]
# **Question two.** The likelihoods of these numbers sum to 175.5, which means nothing: each is from another table. Take *one*
# number and run over all symbols it could have been: neighbouring bins share an edge, and the sum telescopes to 1.

# %%
assert round(p.sum(), 1) == 175.5
reach = np.arange(-6000, 6001)
for a, column in zip(*(index[::97] for index in np.nonzero(kept))):
    row = [
        np.full((1, len(reach)), v)
        for v in (prior.mu[a, column], prior.sigma[a, column], q[a, column])
    ]
    alphabet = 2.0 ** -likelihood.forward(reach[None] * q[a, column], *row)[0].bits
    assert abs(alphabet.sum() - 1) < 1e-9

# %% [markdown]
# A floor breaks that. With HAC's 1e-6 under every mass, an alphabet of $2^{16}$ symbols sums to 1.066. That promises more than
# there is: no coder can charge at most 19.93 bits for the rare ones without charging the others more than Eq. (11) says.

# %%
row = [np.full((1, 2**16), v) for v in (0.0, 1.0, 1.0)]
floored = 2.0 ** -likelihood.hac(np.arange(-(2**15), 2**15, dtype=float)[None], *row)[0].bits
assert (
    floored.min() > 0.999 * 1e-6
    and round(-math.log2(1e-6), 2) == 19.93
    and round(floored.sum(), 3) == 1.066
)

# %% [markdown]
# **Question three.** From training's estimate to the file: with noise (here on the rounded numbers, for the file has no others),
# rounded, under whole-number tables, coded, in sections. From each to the next: less than one percent, next to nothing, three
# percent (each section ends in whole words of the coder, which weighs little in a larger file), a byte a section. What
# Eq. (13) leaves out is the rest of the file.

# %%
noisy = (
    np.mean([price((model.symbols + rng.random(q.shape) - 0.5) * q).sum() for _ in range(40)]) / 8
)
rows = [row for row in inspect.ledger(data) if row["name"] in ATTRIBUTE_SECTIONS]
total = {"Eq. (13)\nwith noise": noisy, "Eq. (13)\nrounded": bits.sum() / 8}
total.update(
    {
        label: sum(row[name] for row in rows)
        for label, name in (
            ("whole-number\ntables", "integer_bytes"),
            ("coded", "payload_bytes"),
            ("sections", "bytes"),
        )
    }
)
steps = np.array(list(total.values()))
print(
    {label.replace("\n", " "): round(float(value), 1) for label, value in total.items()},
    "whole file",
    len(data),
)
change = np.diff(steps) / steps[:-1]
assert (
    -0.01 < change[0] < 0
    and abs(change[1]) < 1e-3
    and 0.02 < change[2] < 0.035
    and steps[4] - steps[3] == len(rows)
)

# %% [markdown]
# ## Backward by hand
# **Question four.** $\hat f = \lfloor f/q\rceil\,q$ has slope $0$ in $f$. Training rates $\tilde f = f + u\,q$ instead, Eq. (7),
# with $u$ uniform in $[-\frac12, \frac12)$. As $d\tilde f = df + u\,dq$, with $b_f$, $b_q$ the slopes of Eq. (11):
# $$\bar f = \bar b\,b_f, \qquad \bar q = \bar b\,(u\,b_f + b_q)$$

# %%
f, u, s = rng.normal(size=(1, 5)), rng.random((1, 5)) - 0.5, rng.lognormal(size=(1, 5))
rated = lambda f, q: likelihood.forward(
    noise.forward(f, u, q)[0].f_noisy, 0 * s, s, np.tile(q, (1, 5))
)
b_bar, step = rng.normal(size=(1, 5)), np.array([[0.7]])
bars = likelihood.backward(rated(f, step)[1], b_bar)
through_noise = noise.backward(noise.forward(f, u, step)[1], bars["f_noisy"])
f_bar, q_bar = (
    through_noise["f"],
    through_noise["q"][0, 0] + bars["q"].sum(),
)  # q is used twice: two terms
up, down = ((b_bar * rated(f + h * f_bar, step + h)[0].bits).sum() for h in (1e-6, -1e-6))
assert (
    np.array_equal(f_bar, bars["f_noisy"])
    and abs((up - down) / 2e-6 - (f_bar**2).sum() - q_bar) < 1e-7
)

# %% [markdown]
# Is the price right as well? Let $f$ follow the prior; $P(x)$ is the mass of the bin about $x$. $\tilde f$ has the density
# $P(x)/q$, the prior averaged over that bin, so noise pays
# $$\int \frac{P(x)}{q}\,\bigl(-\log_2 P(x)\bigr)\,dx = \frac{1}{q}\int_0^q \sum_k P(kq + r)\,\bigl(-\log_2 P(kq + r)\bigr)\,dr.$$
# On the right, with $x = kq + r$: the entropy of rounding on a grid shifted by $r$, averaged over all shifts.

# %% [markdown]
# **Noise is rounding with a random grid.** So it is exact on average, and wrong for one grid where bins are wide. With
# $\sigma = 0.1\,q$ noise pays 0.261 bits. A mean on a multiple of $q$ costs 0.000 in the file, a mean between two of them
# 1.000. At $\sigma = q$ all three agree: 2.105.


# %%
def entropy(sigma, r):
    """Bits of rounding to whole numbers, f Gaussian about -r: (n,) for shifts r (n,)."""
    edges = (np.arange(-30, 32) - 0.5)[:, None] + r
    P = np.diff(ndtr(edges / sigma), axis=0)
    return -(P * np.log2(np.where(P > 0, P, 1))).sum(axis=0)


phases = (np.arange(200) + 0.5) / 200
three = lambda sigma: [
    entropy(sigma, phases).mean(),
    *entropy(sigma, np.array([0, 0.5])),
]  # noise, and two grids
print(np.round(three(0.1), 4), np.round(three(1.0), 4))
assert (
    np.abs(np.array(three(0.1)) - [0.261, 0.000, 1.000]).max() < 5e-4
    and np.abs(np.array(three(1.0)) - 2.105).max() < 5e-4
)
x = (np.arange(-50000, 50000) + 0.5) / 5000  # and the left side of the identity
P = ndtr((x + 0.5) / 0.1) - ndtr((x - 0.5) / 0.1)
assert abs(-(P * np.log2(np.where(P > 0, P, 1))).sum() / 5000 - three(0.1)[0]) < 1e-4

# %%
figure, axes = plt.subplots(1, 2, figsize=(16, 5), layout="constrained")
axes[0].plot(list(total), steps, "o:", ms=14)
for i, value in enumerate(steps):
    axes[0].text(i, value + 2.5, f"{value:.1f}", ha="center", fontsize=14)
axes[0].set(
    ylim=(700, 760),
    ylabel="bytes of f, s, l, O",
    title=f"The estimate speaks of {steps[4]:.0f} of the file's {len(data)} bytes",
)
sigmas = np.geomspace(0.03, 3, 60)
labels = ("noise: every grid", "rounding, mean on a multiple of q", "rounding, mean between two")
for curve, style, label in zip(np.array([three(s) for s in sigmas]).T, ("-", "--", ":"), labels):
    axes[1].plot(sigmas, curve, style, lw=3, label=label)
axes[1].set(
    xscale="log",
    xlabel="σ / q",
    ylabel="bits a number",
    title="Noise pays the average over all grids",
)
axes[1].legend()
lessons.show(figure, "22_five_questions_about_bits")

# %% [markdown]
# ## Break it
# Use the density as likelihood: then no $q$ is in the rate. The loss falls as never before, below zero, for as $\sigma$ shrinks
# such "bits" have no lower end; a thousand times less $\sigma$ is about 10 bits less. And $b_q$ is 0, so nothing
# wants a coarse step. The vectors see it at once.


# %%
def with_density(f_noisy, mu, sigma, q):
    return {
        "bits": ((f_noisy - mu) / sigma) ** 2 / (2 * math.log(2))
        + np.log2(sigma * math.sqrt(2 * math.pi))
    }


at = [np.zeros((1, 3)), np.zeros((1, 3)), np.array([[1e-1, 1e-4, 1e-7]])]
fine, coarse = (with_density(*at, np.full((1, 3), step))["bits"][0] for step in (1, 2))
assert (np.round(np.diff(fine)) == -10).all() and fine[2] < 0 and (coarse - fine == 0).all()
assert not oracle.check(with_density, "likelihood").ok

# %% [markdown]
# ## What a codec does with it
# **Question five.** Rounding, if bins are narrow, costs the picture $D = \sum_a w_a q_a^2/12$, where $w_a$ is how much it feels
# anchor $a$, and the file $R = const - \sum_a \log_2 q_a$. For a given $R$ the least $D$ has the same ratio of slopes,
# $\frac{w_aq_a}{6} : \frac{1}{q_a\ln 2}$, at every anchor: all $w_a q_a^2$ are equal, so $q_a \propto w_a^{-1/2}$.

# %% [markdown]
# A video encoder chooses its step block by block. Here it is learnt, Eq. (8). Was it?
# We measure $w_a$: an anchor's features are moved by a tenth, up or down, and six pictures are compared.

# %%
cameras = [
    look_at((2.2 * math.cos(v), 2.2 * math.sin(v), 0.9), (0, 0, -0.4), 36, 36, 40, 28)
    for v in (0.3, 2.4, 4.5)
]


def pictures(f_a):
    at = replace(model.model, anchors=model.model.anchors._replace(f_a=f_a))
    return np.stack([at.render(camera, t) for camera in cameras for t in (0.2, 0.7)]).astype(float)


learnt = model.context.q[:, :1]
f_a = model.model.anchors.f_a + (rng.random((60, design.d)) - 0.5) * learnt  # as if not yet rounded
truth, w = pictures(f_a), np.zeros((60, 1))
for a in range(60):
    for sign in (0.1, -0.1):
        f_moved = f_a.copy()
        f_moved[a] += sign * rng.choice([-1, 1], design.d)
        w[a] += ((pictures(f_moved) - truth) ** 2).mean() / 0.02
typical = np.exp(np.log(w[w > 0]).mean())
ideal = np.clip(
    (np.maximum(w, 1e-30) / typical) ** -0.5, 1 / 8, 8
)  # who is never seen gets the coarsest step
together = np.corrcoef(np.log(ideal[:, 0]), np.log(learnt[:, 0]))[0, 1]
print(f"correlation of learnt and ideal steps, in logarithms: {together:.2f}")
assert together > 0.6

# %% [markdown]
# What is it worth? All features are rounded with steps of three kinds, each finer and coarser. Learnt ones beat one step for all
# over most of the range. Those computed from $w_a$ are best where bins are narrow, as derived, and worst where they are wide:
# $w_a$ was measured by small moves, and says nothing of large ones.


# %%
def trade(q_a):
    """Bits a feature and mean squared error of the pictures, features rounded with steps q_a (60, 1)."""
    rounded = np.rint(f_a / q_a) * q_a
    mu, sigma = (a[:, : design.d] for a in (prior.mu, prior.sigma))
    bits = likelihood.forward(rounded, mu, sigma, np.repeat(q_a, design.d, axis=1))[0].bits
    return bits.mean(), ((pictures(rounded) - truth) ** 2).mean()


ways = {
    "one step for all": np.ones((60, 1)),
    "learnt, Eq. (8)": learnt / np.exp(np.log(learnt).mean()),
    "from $w_a$": ideal,
}
curves = {
    name: np.array([trade(scale * way) for scale in np.geomspace(0.03, 1, 12)])
    for name, way in ways.items()
}
at_1e5 = {
    name: np.interp(1e-5, np.maximum.accumulate(curve[:, 1]), curve[:, 0])
    for name, curve in curves.items()
}
print({name: f"{bits:.2f} bits a feature at an error of 1e-5" for name, bits in at_1e5.items()})
assert at_1e5["one step for all"] - at_1e5["learnt, Eq. (8)"] > 0.2
one, by_eq_8, by_w = (curve[0] for curve in curves.values())  # the finest steps: bits, error
assert by_w[1] < by_eq_8[1] < one[1] and max(by_w[0], by_eq_8[0]) < one[0] + 0.01
assert (
    curves["from $w_a$"][-1] > curves["one step for all"][-1]
).all()  # the widest: worse in both
figure, axes = plt.subplots(1, 2, figsize=(16, 5), layout="constrained")
seen = w[:, 0] > 0
axes[0].loglog(w[seen], learnt[seen], "o", ms=8)
axes[0].set(
    xlabel="what a unit of error costs the picture, $w_a$",
    ylabel="learnt step q of the features",
    title="Anchors that matter got finer steps",
)
for (name, curve), marker in zip(curves.items(), "os^"):
    axes[1].semilogy(curve[:, 0], curve[:, 1], f"-{marker}", label=name)
axes[1].set(
    xlabel="bits a feature, Eq. (11)", ylabel="mean squared error", title="Same error, fewer bits"
)
axes[1].legend()
lessons.show(figure, "22_adaptive_steps")

# %% [markdown]
# ## Exercises
# **22.1** $\sigma = 0.02$, $q = 0.001$, value at the mean: density and likelihood? **22.2** Write the whole rate, Eq. (11),
# Eq. (13), Eq. (14), Eq. (17), with `likelihood.forward`. **22.3** Its gradients of `mu` and `q (A, 4)`: a step serves a group.

# %%
answer_1 = ...


def my_rate(noisy, mu, sigma, q, mask, grids, d, k):
    """{"bits", "L_rate"}; noisy, mu, sigma (A, n), columns f, s, l, O; q (A, 4); mask (A, k); grids [(T, F), ...].

    A sign is +1 where the entry is >= 0. Masked offsets cost no bits. L_rate is bits over all numbers, masked ones too.
    """
    raise NotImplementedError


def my_rate_backward(inputs, cotangents):
    """{"mu" (A, n), "q" (A, 4)} from cotangents["bits_bar"], cotangents["L_rate_bar"]; inputs holds the arguments of my_rate."""
    raise NotImplementedError


lessons.number("22.1", answer_1, [1 / (0.02 * math.sqrt(2 * math.pi)), ndtr(0.025) - ndtr(-0.025)])
lessons.forward("22.2", my_rate, "rate_stage")
lessons.backward("22.3", my_rate_backward, "rate_stage", "mu", "q")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only likelihood`, then `--only rate_stage`. What goes wrong: a density, nats, offsets of masked
# children counted, a mean over numbers where a sum is meant, and `bits` of one image divided by its pixels.

# %%
ours = oracle.check(
    lambda **i: stages_coding.rate_forward(**i)[0],
    "rate_stage",
    lambda i, c: stages_coding.rate_backward(stages_coding.rate_forward(**i)[1], **c),
)
print(ours)
assert (
    ours.ok
    and oracle.check(lambda **i: likelihood.forward(**i)[0], "likelihood").ok
    and EQUATIONS["noise"].number == "7"
)
