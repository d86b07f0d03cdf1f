# %% [markdown]
# # Eq. (7) and Eq. (10): noise during training, rounding in the file
#
# **Promise.** After this tutorial you can explain why noise can take the place of rounding, when it
# cannot, and why ties need a rule. **Before it:** `01_offsets`. **Takes** six seconds of machine
# time on two cores, 25 minutes of reading and 30 of exercises.
#
# **Files:** Eq. (7) [noise.py](../p4dgs_ref/equations/noise.py),
# Eq. (10) [rounding.py](../p4dgs_ref/equations/rounding.py).

# %%
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, panels, show, tour

plt = figures.pyplot()
architecture.show("07_noise_and_rounding")
rng = np.random.default_rng(7)

# %% [markdown]
# ## What fails without it
# A file holds integers, so every number is rounded to a multiple of a step. The picture as a
# function of such a number is then a staircase (orange): flat nearly everywhere, so no gradient
# says in which direction the number should go. Training without any rounding (grey) has slopes, but
# it never learns that the file will move numbers by up to half a step. The curves move one number
# of anchor 29, its fifth feature, and show how much the picture of the trained scene changes.
#
# The two pictures show what it costs. Both are drawn from files, whose numbers are rounded. One
# model was trained as if they were not; the other is the demo's, which was trained with the paper's
# solution, noise.

# %%
from p4dgs_ref import decode
from p4dgs_ref.scenes import simulator
from p4dgs_ref.training.objective import psnr

model, thread = tour.MODEL, figures.THREAD
camera = simulator.camera_at(tour.SCENE, *np.radians((60, 26)))
context = show.context_at(model, model.anchors.x_a[[thread.index]])
features, symbols_29 = model.anchors.f_a[thread.index], tour.FILE.symbols[thread.index, :16]
q_29 = features[4] / symbols_29[4]
assert symbols_29[4] == 7


def change(feature):
    """Return how far the picture changes (mean square) if the fifth feature of anchor 29 does."""
    f_a = model.anchors.f_a.copy()
    f_a[thread.index, 4] = feature
    moved = replace(model, anchors=model.anchors._replace(f_a=f_a))
    return np.mean((moved.render(camera, 0.3) - model.render(camera, 0.3)) ** 2)


steps_away = np.linspace(-4, 4, 81)
unrounded = np.array([change(features[4] + away * q_29) for away in steps_away])
rounded = np.array([unrounded[10 * int(np.rint(away)) + 40] for away in steps_away])
no_noise = tour.place_of("no noise").read_bytes()
reached = [psnr(m.render(tour.CAMERA, tour.T), tour.TRUTH) for m in (decode(no_noise), model)]
assert np.round(reached, 1).tolist() == [30.5, 32.7]

# %%
figure, (curves, *pictures) = plt.subplots(1, 3, figsize=(14, 4.2), layout="constrained")
curves.plot(steps_away, 1e6 * unrounded, color="0.7", lw=6, label="as it is")
curves.step(steps_away, 1e6 * rounded, color=figures.COLORS[1], where="mid", label="rounded")
curves.set(
    xlabel="a feature of anchor 29 minus\nits value in the file (steps $q$)",
    ylabel="change of the picture\n(mean square, $10^{-6}$)",
    title="rounding is a staircase",
)
curves.legend()
for ax, (title, data) in zip(pictures, {"without noise": no_noise, "with": tour.DATA}.items()):
    place = tour.CAMERA, tour.T, tour.TRUTH, tour.VIEW
    show.scored_picture(ax, decode(data), data, *place, f"trained {title}")
figures.show(figure, "07_noise_and_rounding_staircase")

# %% [markdown]
# ## Claim
# A file stores integers. When it is written, every attribute of an anchor is therefore divided by a
# step size $q$ and rounded to the nearest integer. That integer, called the *symbol*, is what the
# entropy coder sees. The decoder multiplies it by $q$ again, so it recovers the attribute only up
# to half a step:
# $$\hat{f_a} = \lfloor\frac{f_a}{q}\rceil \cdot q \tag{10}$$
# Rounding has no useful gradient. During training, the paper therefore adds noise of the same width
# instead:
# $$\tilde{f_a}=f_a + \mathcal{U}\left(-\frac{1}{2},\frac{1}{2}\right) \cdot q \tag{7}$$
# A new $\mathcal{U}$ is drawn for every number in every iteration. In this project the draws $u$
# are an input of the equation, because no equation draws random numbers itself.

# %% [markdown]
# ## By hand
# With the step 0.2, the values 1.0 and 2.0 and the draws $-0.5$ and $0.25$, the noisy values are
# 0.9 and 2.05. For rounding, take the step 0.25 and the value 0.37, whose quotient is 1.48. The
# nearest integer is 1, so the file contains the symbol 1 and the decoder obtains 0.25.
#
# Halfway between two integers the rule is *ties to even*: the quotients 0.5, 1.5 and 2.5 are
# rounded to 0, 2 and 2. The function `np.rint` follows this rule. It treats positive and negative
# numbers alike, and the errors of many ties cancel on average.

# %%
from p4dgs_ref.equations import noise, rounding
from p4dgs_ref.lessons import close, inner

draws = np.array([[-0.5, 0.25]])
noisy, noise_saved = noise.forward(np.array([[1.0, 2.0]]), draws, np.array([[0.2]]))
assert close(noisy, [[0.9, 2.05]])

ties = np.array([[-1.5, -0.5, 0.5, 1.5, 2.5]])
(symbols, _), _ = rounding.forward(ties, np.ones((1, 1)))
assert symbols.tolist() == [[-2, 0, 0, 2, 2]]

# %% [markdown]
# ## In code
# For $A$ anchors and the $n$ numbers of one attribute the shapes are `f [A, n]`, `u [A, n]` and `q
# [A, 1]`, because each anchor has one step per attribute. Eq. (7) is `f + u * q`. Eq. (10) has
# *two* outputs: the integers `symbols [A, n]`, and `f_hat = symbols * q`. Noise and rounding both
# change a number by at most half a step.

# %%
A, n = 5, 3
f = rng.normal(size=(A, n))
u = rng.random((A, n)) - 0.5
q = rng.uniform(0.1, 0.4, (A, 1))
# paper, Sec. 3.3: noise while training, hard rounding afterwards
# silent: Q23, how often noise is drawn, and Q19, where the grid of steps begins and what ties do
f_noisy, saved = noise.forward(f, u, q)
(symbols, f_hat), _ = rounding.forward(f, q)
half_step = q / 2 * (1 + 1e-12)
assert (np.abs(f_hat - f) <= half_step).all()
assert (np.abs(f_noisy - f) <= half_step).all()
assert np.array_equal(f_hat, symbols * q)

# %% [markdown]
# **Why noise can take the place of rounding.** Let $f$ have the density $\phi$. The density of the
# noisy value is $\phi$ averaged over one step. The probability of a rounded value is $\phi$
# integrated over one step, around a multiple $mq$ with an integer $m$:
# $$p_{\tilde f}(y) = \frac{1}{q}\int_{y-\frac{1}{2}q}^{y+\frac{1}{2}q}\phi(x)\,dx, \qquad
# P(\hat f = mq) = \int_{mq-\frac{1}{2}q}^{mq+\frac{1}{2}q}\phi(x)\,dx = q\,p_{\tilde f}(mq)$$
# The two expressions agree at every multiple of $q$, up to the factor $q$, for any density $\phi$.
# In other words, the density of the noisy values is a smooth curve that passes through the
# probabilities of all rounded values. Eq. (11) evaluates exactly this integral. This is why the
# bits that training estimates from noisy values are a good prediction of the bits that the file
# will need.
#
# The cell below checks this with samples of a Gaussian. `ndtr` is SciPy's name for $\Phi$, the
# integral of the standard Gaussian density up to a point.

# %%
step, mean, deviation = 0.5, 0.2, 0.6


def mass(y):
    """Return the probability of the interval of one step around y."""
    upper = ndtr((y + step / 2 - mean) / deviation)
    lower = ndtr((y - step / 2 - mean) / deviation)
    return upper - lower


def rms(a):
    """Return the root of the mean square."""
    return np.sqrt((a**2).mean())


sample = rng.normal(mean, deviation, 400_000)
with_noise = sample + step * (rng.random(sample.size) - 0.5)
(_, rounded), _ = rounding.forward(sample[None], np.array([[step]]))
multiples = np.arange(-5, 6) * step
share_of_rounded = np.array([np.mean(rounded == m) for m in multiples])
density_of_noisy = np.array([np.mean(np.abs(with_noise - m) < 0.05) / 0.1 for m in multiples])
assert np.abs(share_of_rounded - mass(multiples)).max() < 0.004
assert np.abs(step * density_of_noisy - mass(multiples)).max() < 0.01

# %% [markdown]
# The errors of noise and of rounding also have the same size, $q/\sqrt{12}$, because the mean of
# $u^2$ is $\int_{-1/2}^{1/2} u^2 du = 1/12$. This holds as long as $\phi$ is wider than the step.
# If $\phi$ is narrower, the two errors differ: values that are concentrated around a multiple of
# $q$ lose less by rounding, and values that are concentrated around a tie lose more, up to $q/2$.


# %%
(_, rounded_sample), _ = rounding.forward(sample[None], np.array([[step]]))
assert abs(rms(rounded_sample - sample) / step - 1 / np.sqrt(12)) < 0.001
assert abs(rms(with_noise - sample) / step - 1 / np.sqrt(12)) < 0.001
narrow = 1e-3 * sample / deviation
assert rms(np.rint(narrow) - narrow) < 0.01  # around a multiple of the step 1
assert rms(np.rint(narrow + 0.5) - narrow - 0.5) > 0.49  # around a tie

# %% [markdown]
# Now the numbers of anchor 29. On the left are its 16 features as the file has them, each an
# integer times $q$; a grey bar shows how far noise moves it in training. On the right is the
# distribution that the decoder predicts for the fifth of them (`10_prior_and_likelihood`), averaged
# over a step: the curve for noisy values passes through the probabilities of all rounded ones. The
# integer in the file is 7 (purple).

# %%
mean, deviation = context.mu[0, 4], context.sigma[0, 4]


def probability(m):
    """Return the probability of the interval of one step around m steps."""
    upper = ndtr(((m + 0.5) * q_29 - mean) / deviation)
    return upper - ndtr(((m - 0.5) * q_29 - mean) / deviation)


assert close(features, symbols_29 * q_29)
assert abs(probability(np.arange(-20, 21)).sum() - 1) < 0.01

# %%
panels.numbers_and_noise(features, symbols_29, q_29, probability)

# %% [markdown]
# ## Backward by hand
# For one number, $\tilde f = f + u\,q$, where $u$ is a constant. A small change is
# $d\tilde f = df + u\,dq$, hence
# $$\bar f = \bar{\tilde f}, \qquad \bar q = u\,\bar{\tilde f}.$$
# In the arrays, `f` has an entry for each number, so its gradient is the cotangent itself. All $n$
# numbers of an anchor share one step, so the gradient of the step is a sum,
# $\bar q_a = \sum_i u_{ai}\,\bar{\tilde f}_{ai}$. For the draws of "By hand" and
# $\bar{\tilde f} = (3, -8)$ it is $-1.5 - 2 = -3.5$.

# %%
assert noise.backward(noise_saved, np.array([[3.0, -8]]))["q"] == -3.5

f_noisy_bar = rng.normal(size=(A, n))
ours = noise.backward(saved, f_noisy_bar)
assert ours["q"].shape == (A, 1)
tangents = {"f": rng.normal(size=(A, n)), "q": rng.normal(size=(A, 1))}
moved, _ = noise.forward(f + tangents["f"], u, q + tangents["q"])  # linear: need not be small
difference = inner(f_noisy_bar, moved - f_noisy)
assert close(difference, inner(ours, tangents))

# %% [markdown]
# What does $\bar f$ mean on average? The mean $E_u$ over all draws is an integral over one step:
# $$E_u\Bigl[\frac{d\mathcal{L}}{df}(f+uq)\Bigr] = \frac{1}{q}
# \int_{f-\frac{1}{2}q}^{f+\frac{1}{2}q} \frac{d\mathcal{L}}{df}(x)\,dx
# = \frac{\mathcal{L}(f+\frac{1}{2}q) - \mathcal{L}(f-\frac{1}{2}q)}{q}
# = \frac{d}{df}E_u\bigl[\mathcal{L}(f+uq)\bigr]$$
# On average the gradient is therefore that of a loss that is smoothed over one step. The gradient
# of a single draw is an unbiased estimate of it.


# %%
def loss(x):
    return np.sin(3 * x) + x**2


def slope_of_loss(x):
    return 3 * np.cos(3 * x) + 2 * x


evenly_spread = (np.arange(1000) + 0.5) / 1000 - 0.5  # instead of random draws
mean_slope = slope_of_loss(0.8 + evenly_spread * step).mean()
slope_of_smoothed = (loss(0.8 + step / 2) - loss(0.8 - step / 2)) / step
assert abs(mean_slope - slope_of_smoothed) < 1e-6

# %% [markdown]
# The smoothed loss has slopes wherever the loss changes over a step. Rounding, on the other hand,
# is a staircase. Its slope is 0 on every tread and does not exist at the edges. The backward of
# rounding returns an empty dictionary, and the table of equations lists no gradients for it.

# %%
from p4dgs_ref import EQUATIONS

_, rounding_saved = rounding.forward(f, q)
assert rounding.backward(rounding_saved, f_noisy_bar) == {}
assert EQUATIONS["rounding"].gradients == ()
(_, after_a_small_step), _ = rounding.forward(f + 1e-9, q)
assert np.array_equal(after_a_small_step, f_hat)

# %% [markdown]
# There is another way to train through rounding, the *straight-through* estimator: compute the
# output with $\hat f$, but the gradient as if $\hat f$ were $f$. It is Eq. (7) with a draw that is
# not random, $u = (\hat f - f)/q$. The cell below minimises $(x - 0.3)^2$ with $q = 1$ in both
# ways, starting at $f = 0$.
#
# With straight-through, the parameter ends at 0.5, the edge between two treads of the staircase,
# and its symbol keeps changing between 0 and 1. With noise, the parameter ends near 0.3, and its
# symbol stays 0. The paper uses noise here. Straight-through is used in `09_hash_grid`, whose
# values are $+1$ or $-1$ and must stay so, which noise would prevent.


# %%
def descend(draw):
    """Return the second half of the path of gradient descent with x = f + draw(f)."""
    f = 0.0
    path = []
    for _ in range(4000):
        x = f + draw(f)
        f -= 0.02 * 2 * (x - 0.3)
        path.append(f)
    return np.array(path[2000:])


straight = descend(lambda f: np.rint(f) - f)
with_noise = descend(lambda f: rng.random() - 0.5)
print(f"straight-through stays at {straight.mean():.3f}, noise at {with_noise.mean():.3f}")
assert np.abs(straight - 0.5).max() < 0.03
assert set(np.rint(straight)) == {0, 1}
assert abs(with_noise.mean() - 0.3) < 0.02
assert set(np.rint(with_noise)) == {0}

# %% [markdown]
# ## Break it
# `floor(x + 0.5)` looks like rounding, and on random values it gives the same result. But it always
# rounds ties up. Moreover, for the largest float below 0.5 it gives 1, because the sum itself is
# rounded to 1. Two encoders with different rules write different files for the same model.

# %%
x = 5 * rng.normal(size=100_000)
assert np.array_equal(np.floor(x + 0.5), np.rint(x))
below_half = np.nextafter(0.5, 0)
print("just below 0.5:", np.floor(below_half + 0.5), "instead of", np.rint(below_half))
assert np.floor(below_half + 0.5) != np.rint(below_half)
assert np.floor(2.5 + 0.5) != np.rint(2.5)

# %% [markdown]
# Some golden cases are ties, or numbers next to ties. Five of the ten cases fail, and the checker
# names the mistake.


# %%
def half_up(f, q):
    symbols = np.floor(f / q + 0.5).astype(np.int64)
    return symbols, symbols * q


lessons.check_mistake(half_up, "rounding", "rounding/ties", "rounded up instead of to even")

# %% [markdown]
# ## What a codec does with it
# Every lossy codec has this step size; in video coding it follows from the quantisation parameter.
# If the values spread over several steps, halving the step costs about 1 bit more per number and
# reduces the squared error by a factor of 4, which is 6.02 dB. Eq. (8) learns this trade-off for
# each anchor.


# %%
def entropy(step):
    """Return the entropy, in bits, of a standard Gaussian rounded to multiples of `step`."""
    m = np.arange(-12 / step, 12 / step + 1)
    p = ndtr((m + 0.5) * step) - ndtr((m - 0.5) * step)
    p = p[p > 0]
    return -(p * np.log2(p)).sum()


sample = rng.normal(size=(1, 200_000))
squared_error = {}
for step in (0.25, 0.125):
    (_, rounded), _ = rounding.forward(sample, np.array([[step]]))
    squared_error[step] = np.mean((rounded - sample) ** 2)
    print(f"step {step}: {entropy(step):.3f} bits, squared error {squared_error[step]:.2e}")
assert abs(entropy(0.125) - entropy(0.25) - 1) < 0.01
assert abs(squared_error[0.25] / squared_error[0.125] - 4) < 0.05

# %% [markdown]
# ## What this idea buys
# Quantisation and entropy coding take T-Rex from 5.39 to 0.85 MB, 84 percent less, and cost 0.1 dB
# (Table 3). Here the file shrinks from 76,590 to 38,649 bytes and loses 0.4 dB. The anchors shrink
# from 29,551 to 4,569 bytes, 85 percent less. But networks are most of the file, and they are not
# entropy coded: they take 45,366 bytes before, in float32 except $\psi_d$, and 33,652 afterwards,
# all in float16.

# %%
from tutorials import gains

labels = "+ compact deformation MLP", "+ quantisation and entropy coding"
parts = [round(gains.mean(label, "gaussians_bytes")) for label in labels]
assert parts == [29_551, 4_569]
gains.show(
    "07_noise_and_rounding",
    dict(zip(("before", "rounded and coded"), labels)),
    {"before": (5.39, "38.34 dB"), "rounded and coded": (0.85, "38.24 dB")},
)

# %% [markdown]
# **In short**
# - The file holds symbols; a decoder multiplies them by $q$.
# - In training, noise as wide as a step takes the place of rounding, and gradients pass through it.
# - The density of noisy values passes through the probabilities of all rounded values.
#
# **Often misunderstood**
# - *Less noise is better.* Noise that is narrower than a step trains a model for a finer file than
#   the one that is written; without any noise, the picture above loses 2.2 dB.
# - *The decoder adds noise.* It multiplies, and everybody decodes the same numbers.
# - *Rounding makes the file small.* Rounding makes many numbers equal. The file becomes small
#   because likely numbers get few bits (`10_prior_and_likelihood`).

# %% [markdown]
# ## Exercises
# **07.1** ● What are the symbols of $0.625$, $0.375$, $-0.875$ and $-0.45$ with the step $0.25$?
# Give a list of four integers.
#
# **07.2** ●● A port rounds in training too, and its backward treats `rint` as if its slope were
# one. The numbers are $0.6$, $0.4$, $-0.9$ and $-0.45$ with the shared step $0.25$, and all
# cotangents are one. Give $\bar q$ as this port computes it, and the true slope in $q$ of the sum
# of all $q\,\mathrm{rint}(f/q)$, as finite differences find it.
#
# **07.3** ●● One number $f = 2$ has the step $q = 0.6$ and the loss $\mathcal{L} =
# \frac{1}{2}\tilde f^2$, so $\bar{\tilde f} = \tilde f$. Will descent widen or narrow the step?
# Give the means of $\bar f$ and of $\bar q$ over all draws of $u$.
#
# **Predict, then run.** All numbers of a group are exact multiples of their step. What is the mean
# squared error with the noise of training, and what is it in the file?

# %%
answer_1 = ...
answer_2 = ...
answer_3 = ...

lessons.check_number("07.1", answer_1)
lessons.check_number("07.2", answer_2)
lessons.check_number("07.3", answer_3)

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rounding` and `p4dgs-ref oracle check DIR --only noise` check
# what a port wrote. Ports differ at ties: `round` in C rounds them away from zero, and `Math.round`
# in JavaScript rounds them up. Use `rint` or an equivalent function, and compare the integers.

# %%
from p4dgs_ref import oracle

lessons.passes("rounding", "noise")
assert oracle.check(EQUATIONS["rounding"], "rounding_ties").ok

# %% [markdown]
# ## For ports
# The symbols are the primary output. A decoder multiplies and never rounds, so it cannot disagree
# with the encoder. The code divides in `float64` regardless of the precision of the inputs. In
# `float32` the quotient itself is rounded, and the result can be a tie although the exact quotient
# is not one. The next cell finds such values.

# %%
values = rng.uniform(0.5, 40, 2_000_000).astype(np.float32)
steps = rng.uniform(0.1, 1, 2_000_000).astype(np.float32)
quotients = values / steps
in_single = np.rint(quotients)
in_double = np.rint(values.astype(np.float64) / steps)
wrong = np.flatnonzero(in_single != in_double)
assert len(wrong) > 0
assert (quotients[wrong] % 1 == 0.5).all()
i = wrong[0]
example = f"{values[i]} / {steps[i]} gives {in_single[i]:.0f} instead of {in_double[i]:.0f}"
print(f"{len(wrong)} of {len(values)} symbols differ: {example}")
