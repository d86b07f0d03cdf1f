# %% [markdown]
# # Five questions everybody asks about bits
#
# **Promise.** After this you can answer the five questions that users of learned codecs ask most
# often, each with a number. **Before it:** `07_noise_and_rounding`, `08_step`,
# `10_prior_and_likelihood`. **Takes** three seconds on two cores, 30 minutes of reading and 35 of
# exercises.
#
# **Files:** [noise.py](../p4dgs_ref/equations/noise.py),
# [step.py](../p4dgs_ref/equations/step.py), [likelihood.py](../p4dgs_ref/equations/likelihood.py),
# [quantise.py](../p4dgs_ref/codec/quantise.py).

# %%
import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures

plt = figures.pyplot()
architecture.show(
    "22_five_questions_about_bits",
    "noise",
    "rounding",
    "step",
    "likelihood",
    "anchor_rate",
    "hash_rate",
)
rng = np.random.default_rng(22)


# %% [markdown]
# ## Claim
# **One: why is a likelihood above one?** Because it is a density. Eq. (11) uses a probability
# mass, which is never above one.
#
# **Two: why do likelihoods not sum to one?** They do, if you sum over the symbols that *could*
# occur. They do not if you sum over the symbols that *did* occur.
#
# **Three: is the estimate the size of the file?** Yes, to a few percent, for what it counts. It
# does not count everything.
#
# **Four: why noise in training and rounding in the file?** Noise has a derivative, and on average
# it has the right price.
#
# **Five: why adaptive steps?** A number that hardly influences the picture may be coarse, and the
# bits that it saves pay for fine steps elsewhere.

# %% [markdown]
# ## By hand
# **Question one.** A Gaussian with $\sigma = 0.1$ has the density 3.989 at its mean. A density is
# a probability *per unit* of the attribute, so it may have any size. Used as a likelihood, it
# would give -2.0 bits, less than nothing. The bin of width $q = 0.1$ at the same place has the
# mass 0.3829. This is a probability without a unit, and it costs 1.385 bits. For a narrow bin the
# mass is the density times $q$.


# %%
from p4dgs_ref.equations import likelihood, noise


def one(value):
    return np.array([[value]])


density = 1 / (0.1 * math.sqrt(2 * math.pi))
assert (round(density, 3), round(-math.log2(density), 1)) == (3.989, -2.0)
mass = ndtr(0.5) - ndtr(-0.5)
assert (round(mass, 4), round(-math.log2(mass), 3)) == (0.3829, 1.385)
narrow_bits, _ = likelihood.forward(
    f_noisy=one(0.0),
    mu=one(0.0),
    sigma=one(0.1),
    q=one(1e-4),
)
narrow_mass = 2.0 ** -narrow_bits[0, 0]
assert np.isclose(narrow_mass, density * 1e-4, rtol=1e-6)

# %% [markdown]
# ## In code
# Take all 1416 numbers of a trained model as they are in its file. Every likelihood is between 0
# and 1. Their mean is 0.124, but the mean price is 4.076 bits, which corresponds to a likelihood
# of 0.059. Always average bits and never likelihoods, because the file pays the sum of the
# logarithms.

# %%
from p4dgs_ref import look_at, oracle
from p4dgs_ref.codec import container
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS, quantised_of
from p4dgs_ref.report import inspect

data = (oracle.path() / "model.p4dgs").read_bytes()  # a trained model of 60 anchors
quantised = quantised_of(container.read_container(data))
model = quantised.model
design = model.design
kept = quantised.kept
prior = inspect.float_context(model)
q = np.repeat(quantised.context.q, design.widths, axis=1)


def bits_of(values):
    """The bits of all coded numbers of the model, if they had these values."""
    bits, _ = likelihood.forward(values, prior.mu, prior.sigma, q)
    return bits[kept]


bits = bits_of(quantised.symbols * q)
p = 2.0**-bits
assert len(p) == 1416
assert 0 < p.min() and p.max() <= 1
assert [round(v, 3) for v in (p.mean(), bits.mean(), 2.0 ** -bits.mean())] == [0.124, 4.076, 0.059]

# %% [markdown]
# **Question two.** The likelihoods of these numbers sum to 175.5, which means nothing, because
# each comes from a different table. Take *one* number instead and sum over all symbols that it
# could have had. Neighbouring bins share an edge, so the sum telescopes to 1.

# %%
assert round(p.sum(), 1) == 175.5
alphabet = np.arange(-6000, 6001)[None]
ones = np.ones(alphabet.shape)
for a, column in np.argwhere(kept)[::97]:
    step = q[a, column]
    every_bits, _ = likelihood.forward(
        f_noisy=alphabet * step,
        mu=ones * prior.mu[a, column],
        sigma=ones * prior.sigma[a, column],
        q=ones * step,
    )
    masses = 2.0**-every_bits
    assert abs(masses.sum() - 1) < 1e-9

# %% [markdown]
# A floor under the likelihood breaks this. HAC does not let a mass fall below 1e-6, and with this
# floor an alphabet of $2^{16}$ symbols sums to 1.066. Such a table promises more than a coder can
# keep: no coder can charge at most 19.93 bits for the rare symbols without charging the others
# more than Eq. (11) says.

# %%
from p4dgs_ref.lab.accuracy import formulas

alphabet = np.arange(-(2.0**15), 2.0**15)[None]
ones = np.ones(alphabet.shape)
floored_bits, _ = formulas.hac(alphabet, 0 * ones, ones, ones)
floored_masses = 2.0**-floored_bits
assert (round(floored_bits.max(), 2), round(floored_masses.sum(), 3)) == (19.93, 1.066)

# %% [markdown]
# **Question three.** From the estimate of training to the file there are five stages: with noise
# (added here to the rounded numbers, because the file has no others), rounded, under integer
# tables, coded, and stored in sections. The first change is less than one percent, and the second
# is negligible. The third is three percent, because each message ends in whole words of the
# coder; this weighs less in a larger file. The last adds one byte per section. The rest of the
# file is what Eq. (13) leaves out.

# %%
samples = []
for _ in range(40):
    u = rng.random(q.shape) - 0.5
    samples.append(bits_of((quantised.symbols + u) * q).sum())
rows = [row for row in inspect.ledger(data) if row["name"] in ATTRIBUTE_SECTIONS]
total = {
    "Eq. (13)\nwith noise": np.mean(samples) / 8,
    "Eq. (13)\nrounded": bits.sum() / 8,
    "integer\ntables": sum(row["integer_bytes"] for row in rows),
    "coded": sum(row["payload_bytes"] for row in rows),
    "sections": sum(row["bytes"] for row in rows),
}
for label, size in total.items():
    print(f"{size:7.1f} bytes", label.replace("\n", " "))
print(f"{len(data):5d}   bytes whole file")
sizes = np.array(list(total.values()))
change = np.diff(sizes) / sizes[:-1]
assert -0.01 < change[0] < 0
assert abs(change[1]) < 1e-3
assert 0.02 < change[2] < 0.035
assert sizes[4] - sizes[3] == len(rows)

# %% [markdown]
# ## Backward by hand
# **Question four.** The derivative of $\hat f = \lfloor f/q\rceil\,q$ with respect to $f$ is $0$.
# Training therefore rates $\tilde f = f + u\,q$, Eq. (7), with $u$ uniform in
# $[-\frac12, \frac12)$. We have $d\tilde f = df + u\,dq$. With the derivatives $b_f$ and $b_q$ of
# Eq. (11), the gradients are
# $$\bar f = \bar b\,b_f, \qquad \bar q = \bar b\,(u\,b_f + b_q).$$

# %%
f = rng.normal(size=(1, 5))
u = rng.random((1, 5)) - 0.5
sigma = rng.lognormal(size=(1, 5))
b_bar = rng.normal(size=(1, 5))
step = one(0.7)


def rated(f, step):
    """The bits, and what the two backwards need."""
    f_noisy, saved_noise = noise.forward(f, u, step)
    bits, saved_bits = likelihood.forward(
        f_noisy,
        mu=np.zeros_like(f),
        sigma=sigma,
        q=np.tile(step, f.shape),
    )
    return bits, saved_noise, saved_bits


_, saved_noise, saved_bits = rated(f, step)
bars = likelihood.backward(saved_bits, b_bar)
through_noise = noise.backward(saved_noise, bars["f_noisy"])
f_bar = through_noise["f"]
q_bar = through_noise["q"][0, 0] + bars["q"].sum()  # q is used twice: two terms
assert np.array_equal(f_bar, bars["f_noisy"])


def loss_at(h):
    """The loss after a move of f along its gradient and of q by h."""
    bits, _, _ = rated(f + h * f_bar, step + h)
    return (b_bar * bits).sum()


slope = (loss_at(1e-6) - loss_at(-1e-6)) / 2e-6
assert abs(slope - (f_bar**2).sum() - q_bar) < 1e-7

# %% [markdown]
# Is the price right as well? Let $f$ follow the prior, and let $P(x)$ be the mass of the bin
# about $x$. The density of $\tilde f$ is the prior averaged over that bin, $P(x)/q$, so with
# noise one pays on average
# $$\int \frac{P(x)}{q}\,\bigl(-\log_2 P(x)\bigr)\,dx
#   = \frac{1}{q}\int_0^q \sum_k P(kq + r)\,\bigl(-\log_2 P(kq + r)\bigr)\,dr.$$
# On the right we have substituted $x = kq + r$. The sum is the entropy of rounding to a grid that
# is shifted by $r$, and the integral averages over all shifts. In other words, **noise is
# rounding to a random grid**. Its price is exact on average, but wrong for a particular grid if
# the bins are wide. With $\sigma = 0.1\,q$ noise pays 0.261 bits, whereas in the file a mean on a
# multiple of $q$ costs 0.000 bits and a mean between two multiples costs 1.000 bits. With
# $\sigma = q$ all three are 2.105 bits.


# %%
def price(P):
    """P times its bits; 0 where P is 0."""
    return -P * np.log2(np.where(P > 0, P, 1))


def entropy(sigma, shifts):
    """Bits of rounding a Gaussian to integers, for several shifts of the grid."""
    edges = np.arange(-30.5, 31.5)[:, None] + shifts
    P = np.diff(ndtr(edges / sigma), axis=0)
    return price(P).sum(axis=0)


def three(sigma):
    """The bits with noise, with the mean on a multiple of q, and with the mean between two."""
    all_shifts = (np.arange(200) + 0.5) / 200
    on, between = entropy(sigma, np.array([0, 0.5]))
    return np.array([entropy(sigma, all_shifts).mean(), on, between])


wide_bins, equal = three(0.1), three(1.0)
print(wide_bins.round(4), equal.round(4))
assert np.round([wide_bins, equal], 3).tolist() == [[0.261, 0, 1], [2.105, 2.105, 2.105]]
dx = 1 / 5000  # the left side of the identity, as a sum
x = np.arange(-10 + dx / 2, 10, dx)
P = ndtr((x + 0.5) / 0.1) - ndtr((x - 0.5) / 0.1)
assert abs(price(P).sum() * dx - wide_bins[0]) < 1e-4

# %%
figure, (ladder, phases) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
bars = ladder.bar(list(total)[1:], np.diff(sizes))
ladder.bar_label(bars, fmt="{:+.1f}", padding=3)
ladder.set(
    ylim=(-8, 27),
    ylabel="bytes that each stage adds",
    title=f"From {sizes[0]:.1f} bytes with noise to {sizes[4]:.0f} in the file",
)
ladder.grid(False, axis="x")
sigmas = np.geomspace(0.03, 3, 60)
curves = np.array([three(s) for s in sigmas]).T
phases.plot(sigmas, curves[0], "-", lw=3, label="noise: every grid")
phases.plot(sigmas, curves[1], "--", lw=3, label="rounding, mean on\na multiple of q")
phases.plot(sigmas, curves[2], ":", lw=3, label="rounding, mean between two")
figures.finish(
    phases,
    xscale="log",
    xlabel="σ / q (logarithmic)",
    ylabel="bits a number",
    title="Noise pays the average over all grids",
)
figures.label(
    phases,
    (0.035, 0.5),
    (0.45, 0.05),
    (0.031, 1.1),
)
figures.show(figure, "22_five_questions_about_bits")

# %% [markdown]
# ## Break it
# Use the density as the likelihood. Then $q$ no longer occurs in the rate. The loss falls as
# never before, even below zero, because such "bits" have no lower limit as $\sigma$ shrinks: a
# deviation that is a thousand times smaller saves about 10 bits. And $b_q$ is 0, so nothing
# rewards a coarse step. The golden vectors detect the mistake immediately.


# %%
def with_density(f_noisy, mu, sigma, q):
    z = (f_noisy - mu) / sigma
    nats = z**2 / 2 + np.log(sigma * math.sqrt(2 * math.pi))
    return nats / math.log(2)


sigmas = np.array([[1e-1, 1e-4, 1e-7]])
zeros = np.zeros_like(sigmas)
fine = with_density(zeros, zeros, sigmas, zeros + 1)
coarse = with_density(zeros, zeros, sigmas, zeros + 2)
assert np.round(np.diff(fine)).tolist() == [[-10, -10]]
assert np.array_equal(coarse, fine) and fine[0, 2] < 0
assert not oracle.check(with_density, "likelihood").ok

# %% [markdown]
# ## What a codec does with it
# **Question five.** As long as the bins are narrow, rounding adds the error
# $D = \sum_a w_a q_a^2/12$ to the picture, where $w_a$ says how sensitive the picture is to
# anchor $a$. The rate is $R = const - \sum_a \log_2 q_a$. For a given $R$ the error is least if
# the ratio of the two derivatives, $\frac{w_aq_a}{6} : \frac{1}{q_a\ln 2}$, is the same at every
# anchor. All $w_a q_a^2$ are then equal, so $q_a \propto w_a^{-1/2}$.
#
# A video encoder chooses its step for each block. In P-4DGS the steps are learned, Eq. (8). Do
# they follow this law? We measure $w_a$: the features of an anchor are moved by a tenth, up or
# down, and six pictures are compared.

# %%
cameras = []
for angle in (0.3, 2.4, 4.5):
    position = (2.2 * math.cos(angle), 2.2 * math.sin(angle), 0.9)
    cameras.append(look_at(position, (0, 0, -0.4), 36, 36, 40, 28))


def pictures(f_a):
    """Three cameras at two times, for other features."""
    changed = replace(model, anchors=model.anchors._replace(f_a=f_a))
    images = []
    for camera in cameras:
        for t in (0.2, 0.7):
            images.append(changed.render(camera, t))
    return np.stack(images).astype(float)


learned = quantised.context.q[:, :1]
# The features before rounding are not in the file: we spread them over their bins again.
f_a = model.anchors.f_a + (rng.random((60, design.d)) - 0.5) * learned
truth = pictures(f_a)
w = np.zeros((60, 1))
for a in range(60):
    for sign in (0.1, -0.1):
        moved = f_a.copy()
        moved[a] += sign * rng.choice([-1, 1], design.d)
        w[a] += ((pictures(moved) - truth) ** 2).mean() / 0.02
typical = np.exp(np.log(w[w > 0]).mean())
from_w = (np.maximum(w, 1e-30) / typical) ** -0.5
from_w = np.clip(from_w, 1 / 8, 8)  # an anchor that is never seen gets the coarsest step
log_steps = np.log([from_w[:, 0], learned[:, 0]])
correlation = np.corrcoef(log_steps)[0, 1]
print(f"correlation of learned and ideal steps, in logarithms: {correlation:.2f}")
assert correlation > 0.6
assert 2.5 < learned[w > 0].max() / learned[w > 0].min() < 3.5

# %% [markdown]
# Their logarithms are correlated, but the first panel below, in which a decade is as long on both
# axes, shows how far they are from the law: the learned steps differ only by a factor of 3.
#
# What is the gain? All features are rounded with three kinds of steps, each scaled from fine to
# coarse. The learned steps are better than one step for all over most of the range. The steps
# computed from $w_a$ are the best as long as the bins are narrow, as derived above, and the worst
# when they are wide, because $w_a$ was measured with small moves and says nothing about large
# ones.


# %%
def trade(q_a):
    """Bits a feature and mean squared error of the pictures, for steps q_a (60, 1)."""
    rounded = np.rint(f_a / q_a) * q_a
    feature_bits, _ = likelihood.forward(
        f_noisy=rounded,
        mu=prior.mu[:, : design.d],
        sigma=prior.sigma[:, : design.d],
        q=np.repeat(q_a, design.d, axis=1),
    )
    error = (pictures(rounded) - truth) ** 2
    return feature_bits.mean(), error.mean()


ways = {
    "one step for all": np.ones((60, 1)),
    "learned, Eq. (8)": learned / np.exp(np.log(learned).mean()),
    "from $w_a$": from_w,
}
scales = np.geomspace(0.03, 1, 12)
curves = {name: np.array([trade(scale * way) for scale in scales]) for name, way in ways.items()}
same, by_eq_8, by_w = curves.values()


def bits_at(curve, error):
    bits, errors = curve.T
    return np.interp(error, np.maximum.accumulate(errors), bits)


for name, curve in curves.items():
    print(f"{name}: {bits_at(curve, 1e-5):.2f} bits a feature at an error of 1e-5")
assert bits_at(same, 1e-5) - bits_at(by_eq_8, 1e-5) > 0.2
finest = np.array([by_w[0], by_eq_8[0], same[0]])
assert (np.diff(finest[:, 1]) > 0).all()  # errors,
assert (finest[:2, 0] < finest[2, 0] + 0.01).all()  # and bits
assert (by_w[-1] > same[-1]).all()  # the widest steps: worse in both

# %%
figure, (steps, error_of) = plt.subplots(
    2, 1, figsize=(9, 8), layout="constrained", height_ratios=(1, 1.3)
)
seen = w[:, 0] > 0
steps.loglog(w[seen], learned[seen], "o", label="learned")
line = np.geomspace(1e-6, 1e-3, 2)
steps.loglog(line, 0.2 * (line / 1e-4) ** -0.5, color=figures.COLORS[1], label="$w_a^{-1/2}$")
steps.set(
    aspect="equal",  # a decade is as long on both axes, so that the slopes are the true ones
    ylim=(0.03, 3),
    xlabel="sensitivity of the picture, $w_a$ (logarithmic)",
    ylabel="step q of the features\n(logarithmic)",
    title="Anchors that matter more got finer steps, but less so than the law says",
)
figures.label(steps, (1e-7, 0.18), (3e-6, 1.3))
for (name, curve), marker in zip(curves.items(), "os^"):
    error_of.semilogy(*curve.T, f"-{marker}", label=name)
figures.finish(
    error_of,
    xlim=(0, None),
    xlabel="bits a feature, Eq. (11)",
    ylabel="mean squared error\n(logarithmic)",
    title="Bits that an error costs, for three kinds of steps",
)
figures.label(
    error_of,
    (4, 4.5e-6),
    (0.7, 4e-5),
    (2.2, 2e-4),
)
figures.show(figure, "22_adaptive_steps")

# %% [markdown]
# ## Exercises
# **22.1** ● With $\sigma = 0.02$ and $q = 0.001$, what are the density and the likelihood of a
# value at the mean?
#
# **22.2** ●● Write the whole rate, Eqs. (11), (13), (14) and (17), with `likelihood.forward`.
#
# **22.3** ●●● Write its gradients of `mu` and `q (A, 4)`. Each step serves a whole group of
# numbers.
#
# **Predict, then run.** A port adds up the bits in float16, one number after another. Ten thousand
# signs cost one bit each. What is its sum?

# %%
answer_1 = ...


def my_rate(noisy, mu, sigma, q, mask, grids, d, k):
    """Return {"bits", "L_rate"}.

    noisy, mu and sigma are (A, n) with columns f, s, l, O; q is (A, 4), mask (A, k), and grids is a
    list of arrays (T, F). A sign is +1 where the entry is >= 0. Masked offsets cost no bits. L_rate
    is bits divided by the count of all numbers, the masked ones included.
    """
    raise NotImplementedError


def my_rate_backward(inputs, cotangents):
    """Return {"mu" (A, n), "q" (A, 4)}; the cotangents are "bits_bar" and "L_rate_bar".

    `inputs` holds the arguments of my_rate.
    """
    raise NotImplementedError


lessons.check_number("22.1", answer_1)
lessons.check_forward("22.2", my_rate, "rate_stage")
lessons.check_backward("22.3", my_rate_backward, "rate_stage", "mu", "q")

# %% [markdown]
# ## Check your port
# Run `p4dgs-ref oracle check DIR --only likelihood`, then `--only rate_stage`. Typical mistakes
# of ports are a density instead of a mass, nats instead of bits, offsets of masked children that
# are counted, a mean over numbers instead of a sum, and `bits` divided by the number of pixels.


# %%
lessons.passes("likelihood")
