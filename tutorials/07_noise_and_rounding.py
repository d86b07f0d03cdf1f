# %% [markdown]
# # Eq. (7) and Eq. (10): noise during training, rounding in the file
#
# **Promise.** After this tutorial you can explain why noise can take the place of rounding, when it
# cannot, and why ties need a rule. **Before it:** `01_offsets`. **Takes** two seconds of machine
# time on two cores, 25 minutes of reading and 30 of exercises.
#
# **Files:** Eq. (7) [noise.py](../p4dgs_ref/equations/noise.py),
# Eq. (10) [rounding.py](../p4dgs_ref/equations/rounding.py).

# %%
import numpy as np
from scipy.special import ndtr

from p4dgs_ref import lessons

plt = lessons.begin()
from tutorials.tools import architecture

architecture.show("07_noise_and_rounding")
rng = np.random.default_rng(7)

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
# rounded to 0, 2 and 2. The function `np.rint` follows this rule, which treats positive and
# negative numbers alike. Over many ties, its errors cancel on average.

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
# For $A$ anchors and the $n$ numbers of one attribute the shapes are `f [A, n]`, `u [A, n]` and
# `q [A, 1]`, because each anchor has one step per attribute. Eq. (7) is `f + u * q`. Eq. (10) has
# *two* outputs: the integers `symbols [A, n]`, and `f_hat = symbols * q`. Both errors are at most
# half a step.

# %%
A, n = 5, 3
f = rng.normal(size=(A, n))
u = rng.random((A, n)) - 0.5
q = rng.uniform(0.1, 0.4, (A, 1))
f_noisy, saved = noise.forward(f, u, q)
(symbols, f_hat), _ = rounding.forward(f, q)
half_step = q / 2 * (1 + 1e-12)
assert (np.abs(f_hat - f) <= half_step).all()
assert (np.abs(f_noisy - f) <= half_step).all()
assert np.array_equal(f_hat, symbols * q)

# %% [markdown]
# The symbols are the primary output. A decoder multiplies and never rounds, so it cannot disagree
# with the encoder. The code divides in `float64` regardless of the precision of the inputs. In
# `float32` the quotient itself is rounded, and the result can be a tie although the exact quotient
# is not. The next cell finds such values.

# %%
values = rng.uniform(0.5, 40, 200_000).astype(np.float32)
steps = rng.uniform(0.1, 1, 200_000).astype(np.float32)
quotients = values / steps
in_single = np.rint(quotients)
in_double = np.rint(values.astype(np.float64) / steps)
wrong = np.flatnonzero(in_single != in_double)
assert len(wrong) > 0
assert (quotients[wrong] % 1 == 0.5).all()
i = wrong[0]
example = f"{values[i]} / {steps[i]} gives {in_single[i]:.0f} instead of {in_double[i]:.0f}"
print(f"{len(wrong)} of {len(values)} symbols differ: {example}")

# %% [markdown]
# **Why noise can take the place of rounding.** Let $f$ have the density $\phi$. The density of the
# noisy value is $\phi$ averaged over one step. The probability of a rounded value is $\phi$
# integrated over one step, around a multiple $kq$ with an integer $k$:
# $$p_{\tilde f}(y) = \frac{1}{q}\int_{y-\frac{1}{2}q}^{y+\frac{1}{2}q}\phi(x)\,dx, \qquad
# P(\hat f = kq) = \int_{kq-\frac{1}{2}q}^{kq+\frac{1}{2}q}\phi(x)\,dx = q\,p_{\tilde f}(kq)$$
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


sample = rng.normal(mean, deviation, 400_000)
with_noise = sample + step * (rng.random(sample.size) - 0.5)
(_, rounded), _ = rounding.forward(sample[None], np.array([[step]]))
multiples = np.arange(-5, 6) * step
share_of_rounded = np.array([np.mean(rounded == m) for m in multiples])
density_of_noisy = np.array([np.mean(np.abs(with_noise - m) < 0.05) / 0.1 for m in multiples])
assert np.abs(share_of_rounded - mass(multiples)).max() < 0.004
assert np.abs(step * density_of_noisy - mass(multiples)).max() < 0.01

# %% [markdown]
# The two errors also have the same size, $q/\sqrt{12}$, because the mean of $u^2$ is
# $\int_{-1/2}^{1/2} u^2 du = 1/12$. This holds as long as $\phi$ is wider than the step. If $\phi$
# is narrower, the two errors differ: values that are concentrated around a multiple of $q$ lose
# less by rounding, and values that are concentrated around a tie lose more, up to $q/2$.


# %%
def rounding_error(deviation, mean):
    """Return the root mean square error of rounding a Gaussian to integers."""
    error = np.linspace(-0.5, 0.5, 1001)[:-1]
    density = np.zeros(1000)
    for k in range(-30, 31):
        density += np.exp(-0.5 * ((error + k - mean) / deviation) ** 2)
    density /= deviation * np.sqrt(2 * np.pi)
    return np.sqrt(np.mean(error**2 * density))


widths = np.geomspace(0.05, 3, 40)
at_a_multiple = np.array([rounding_error(w, 0) for w in widths])
at_a_tie = np.array([rounding_error(w, 0.5) for w in widths])
assert abs(at_a_multiple[-1] - 1 / np.sqrt(12)) < 1e-6
assert abs(at_a_tie[-1] - 1 / np.sqrt(12)) < 1e-6
assert abs(at_a_multiple[0] - widths[0]) < 1e-6
assert 0.45 < at_a_tie[0] < 0.5

# %%
blue, red, green = lessons.COLORS[:3]
figure, (left, right) = plt.subplots(
    1,
    2,
    figsize=(13, 4.8),
    layout="constrained",
)
bins = np.linspace(-2, 2.4, 89)
light = lessons.COLORS[5]
left.hist(
    with_noise,
    bins,
    density=True,
    color=light,
    alpha=0.6,
)
left.text(0.05, 0.2, "noisy\nvalues", fontsize=11)
y = np.linspace(-2, 2.4, 500)
left.plot(
    y,
    mass(y) / step,
    color=blue,
    label=r"$\phi$ averaged over one step",
)
left.vlines(
    multiples,
    0,
    share_of_rounded / step,
    color=red,
    lw=2,
)
left.plot(
    multiples,
    share_of_rounded / step,
    "o",
    color=red,
    ms=8,
    label="rounded values,\nshare / $q$",
)
lessons.finish(
    left,
    xlabel="value (units of the attribute)",
    ylabel="density (per unit)",
    xlim=(-2, 2.4),
    ylim=(0, 0.75),
    title="One curve describes both ($q = 0.5$)",
)
lessons.label(left, (0.45, 0.66), (-1.75, 0.28), fontsize=11)
right.semilogx(
    widths,
    at_a_multiple,
    color=red,
    label="rounding, values around\na multiple of $q$",
)
right.semilogx(
    widths,
    at_a_tie,
    ":",
    color=green,
    lw=3,
    label="rounding, values around a tie",
)
right.axhline(
    1 / np.sqrt(12),
    color=blue,
    ls="--",
    label=r"noise: $q/\sqrt{12}$",
)
lessons.finish(
    right,
    xlabel="standard deviation of the values, in steps $q$",
    ylabel="root mean square error, in steps $q$",
    ylim=(0, 0.55),
    title="The errors agree unless a step is wider than the values",
)
lessons.label(
    right,
    (0.26, 0.13),
    (0.12, 0.45),
    (1.2, 0.305),
    fontsize=11,
)
lessons.show(figure, "07_noise_and_rounding")

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
d = {"f": rng.normal(size=(A, n)), "q": rng.normal(size=(A, 1))}
moved, _ = noise.forward(f + d["f"], u, q + d["q"])  # linear: the step need not be small
change = inner(f_noisy_bar, moved - f_noisy)
assert close(change, inner(ours, d))

# %% [markdown]
# What does $\bar f$ mean on average? The mean $E_u$ over all draws is an integral over one step:
# $$E_u\Bigl[\frac{dL}{df}(f+uq)\Bigr] = \frac{1}{q}\int_{f-\frac{1}{2}q}^{f+\frac{1}{2}q}
# \frac{dL}{df}(x)\,dx
# = \frac{L(f+\frac{1}{2}q) - L(f-\frac{1}{2}q)}{q} = \frac{d}{df}E_u\bigl[L(f+uq)\bigr]$$
# On average the gradient is therefore that of a loss smoothed over one step, and the gradient of a
# single draw is an unbiased estimate of it.


# %%
def L(x):
    return np.sin(3 * x) + x**2


def slope_of_L(x):
    return 3 * np.cos(3 * x) + 2 * x


evenly_spread = (np.arange(1000) + 0.5) / 1000 - 0.5  # instead of random draws
mean_slope = slope_of_L(0.8 + evenly_spread * step).mean()
slope_of_smoothed = (L(0.8 + step / 2) - L(0.8 - step / 2)) / step
assert abs(mean_slope - slope_of_smoothed) < 1e-6

# %% [markdown]
# Rounding, on the other hand, is a staircase. Its slope is 0 on every tread and does not exist at
# the edges. The backward of rounding returns an empty dictionary, and the table of equations lists
# no gradients for it.

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
# symbol stays 0. The paper uses noise here. Straight-through returns in `09_hash_grid`, where a
# noisy value would no longer be binary.


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
# rounded to 1. Two encoders, one with each rule, write different files for the same model.

# %%
x = 5 * rng.normal(size=100_000)
assert np.array_equal(np.floor(x + 0.5), np.rint(x))
below_half = np.nextafter(0.5, 0)
print("just below 0.5:", np.floor(below_half + 0.5), "instead of", np.rint(below_half))
assert np.floor(below_half + 0.5) != np.rint(below_half)
assert np.floor(2.5 + 0.5) != np.rint(2.5)

# %% [markdown]
# Some golden cases are ties, or numbers next to ties. Five of the nine cases fail, and the checker
# names the mistake.


# %%
def half_up(f, q):
    symbols = np.floor(f / q + 0.5).astype(np.int64)
    return symbols, symbols * q


lessons.caught(half_up, "rounding", "rounding/ties", "rounded up instead of to even")

# %% [markdown]
# ## What a codec does with it
# Every lossy codec has this step size; in video coding it follows from the quantisation parameter.
# If the values spread over several steps, halving the step costs about 1 bit more per number and
# reduces the squared error by a factor of 4, which is 6.02 dB. Eq. (8) learns this trade-off for
# each anchor.


# %%
def entropy(step):
    """Return the entropy, in bits, of a standard Gaussian rounded to multiples of `step`."""
    k = np.arange(-12 / step, 12 / step + 1)
    p = ndtr((k + 0.5) * step) - ndtr((k - 0.5) * step)
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
# ## Exercises
# **07.1** ● What are the symbols of $0.625$, $0.375$, $-0.875$ and $-0.45$ with the step $0.25$?
# Give a list of four integers.
#
# **07.2** ●● A port rounds in training too, and the gradient passes straight through `rint` as if
# its slope were one. What changes in the gradient? The numbers are $0.6$, $0.4$, $-0.9$ and $-0.45$
# with the shared step $0.25$, and all cotangents are one. Give $\bar q$ as this port computes it,
# and the slope of $q\,\mathrm{rint}(f/q)$ in $q$ that differences find.
#
# **07.3** ●● Write the backward of Eq. (7).
#
# **Predict, then run.** All numbers of a group are exact multiples of their step. What is the mean
# squared error with the noise of training, and what is it in the file?

# %%
answer_1 = ...
answer_2 = ...


def my_backward(inputs, cotangents):
    """Return the gradients {"f" [A, n], "q" [A, 1]}.

    inputs["u"] and cotangents["f_noisy_bar"] have the shape [A, n].
    """
    raise NotImplementedError


lessons.check_number("07.1", answer_1)
lessons.check_number("07.2", answer_2)
lessons.check_backward("07.3", my_backward, "noise")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rounding` and `p4dgs-ref oracle check DIR --only noise` check
# what a port wrote. Ports differ at ties: `round` in C rounds them away from zero, and `Math.round`
# in JavaScript rounds them up. Use `rint` or an equivalent function, and compare the integers.

# %%
from p4dgs_ref import oracle

lessons.passes("rounding", "noise")
assert oracle.check(EQUATIONS["rounding"], "rounding_ties").ok
