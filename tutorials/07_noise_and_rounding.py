# %% [markdown]
# # Eq. (7) and Eq. (10): noise while training, rounding in the file
#
# **Promise.** After this you can say why noise may stand in for rounding, when it may not, and why ties need a rule.
# **Before it:** `01_offsets`. **Takes** two seconds of machine time on two cores, half an hour of yours.

# %%
import numpy as np
from scipy.special import ndtr

from p4dgs_ref import EQUATIONS
from p4dgs_ref.equations import noise, rounding
from p4dgs_ref.school import lessons

plt = lessons.pyplot()

# %% [markdown]
# ## Claim
# A file holds whole numbers. So every attribute of an anchor is rounded to a multiple of a step $q$ when the file is written:
# $$\hat{f_a} = \lfloor\frac{f_a}{q}\rceil \cdot q \tag{10}$$
# $\lfloor\cdot\rceil$ is the nearest integer, the *symbol* that the file holds; $\hat{f_a}$ is what the decoder makes of it.

# %% [markdown]
# Rounding has no slope to learn from. While training, the paper adds noise of the same width instead:
# $$\tilde{f_a}=f_a + \mathcal{U}\left(-\frac{1}{2},\frac{1}{2}\right) \cdot q \tag{7}$$
# $\mathcal{U}$ is drawn anew for every number in every iteration. Here the draw $u$ is an input: equations draw nothing.

# %% [markdown]
# ## By hand
# Step 0.2, the values 1.0 and 2.0, the draws $-0.5$ and $0.25$: the noisy values are 0.9 and 2.05.
# Step 0.25, the value 0.37: the quotient is 1.48, its nearest integer 1, so the file holds 1 and the decoder gets 0.25.

# %%
assert np.allclose([1.0 + -0.5 * 0.2, 2.0 + 0.25 * 0.2], [0.9, 2.05], rtol=1e-15)
assert abs(0.37 / 0.25 - 1.48) < 1e-15 and round(1.48) == 1 and 1 * 0.25 == 0.25

# %% [markdown]
# Half-way between two integers the rule is *ties to even*: quotients 0.5, 1.5 and 2.5 become 0, 2 and 2. Python's `round` and
# NumPy's `rint` do so. Over many ties the errors cancel on average, and the rule is the same on both sides of zero.

# %%
assert (round(0.5), round(1.5), round(2.5)) == (0, 2, 2)
assert np.rint([-2.5, -1.5, -0.5]).tolist() == [-2, -2, 0]

# %% [markdown]
# ## In code
# For `A` anchors and `n` numbers of one group: `f (A, n)`, `u (A, n)`, `q (A, 1)`, one step an anchor and group.
# Eq. (7) is `f + u * q`. Eq. (10) gives *two* outputs: `symbols (A, n)`, whole numbers, and `f_hat = symbols * q`.

# %%
rng = np.random.default_rng(7)
A, n = 5, 3
f, u, q = rng.normal(size=(A, n)), rng.random((A, n)) - 0.5, rng.uniform(0.1, 0.4, (A, 1))
noisy, noise_res = noise.forward(f, u, q)
hard, _ = rounding.forward(f, q)
assert np.array_equal(noisy.f_noisy, f + u * q) and hard.symbols.dtype == np.int64
assert np.array_equal(hard.f_hat, hard.symbols * q)
assert (np.abs(hard.f_hat - f) <= q / 2 * (1 + 1e-12)).all() and (
    np.abs(noisy.f_noisy - f) <= q / 2 * (1 + 1e-12)
).all()

# %% [markdown]
# The symbols are the primary output: a decoder multiplies, it never rounds, so it cannot disagree. And the quotient is taken
# in `float64` whatever comes in: in `float32` the quotient itself is rounded, and may land on a tie that is none.

# %%
values, steps = (
    rng.uniform(0.5, 40, 200_000).astype(np.float32),
    rng.uniform(0.1, 1, 200_000).astype(np.float32),
)
single, double = np.rint(values / steps), np.rint(values.astype(float) / steps)
wrong = np.flatnonzero(single != double)
assert len(wrong) > 0 and (np.abs(values[wrong] / steps[wrong] % 1 - 0.5) < 1e-5).all()
i = wrong[0]
print(
    f"{len(wrong)} of {len(values)} symbols differ, as {values[i]} / {steps[i]}: {single[i]:.0f}, not {double[i]:.0f}"
)

# %% [markdown]
# **Why noise may stand in.** Let $f$ have the density $\phi$. The noisy value has that density averaged over one step, the
# rounded one collects it over one step, around $kq$ with $k$ whole:
# $$p_{\tilde f}(y) = \frac{1}{q}\int_{y-\frac{1}{2}q}^{y+\frac{1}{2}q}\phi(x)\,dx, \qquad
# P(\hat f = kq) = \int_{kq-\frac{1}{2}q}^{kq+\frac{1}{2}q}\phi(x)\,dx = q\,p_{\tilde f}(kq)$$

# %% [markdown]
# So at every multiple of $q$ the two agree but for the factor $q$, whatever $\phi$ is: one smooth curve passes through all the
# probabilities of the rounded values. Eq. (11) is this integral. That is why bits counted on noisy values speak for bits of the
# file. Below $\phi$ is a Gaussian; `ndtr` is SciPy's $\Phi$, its integral up to a point.

# %%
step, many = 0.5, rng.normal(0.2, 0.6, 400_000)
kq = np.arange(-5, 6) * step
probability = ndtr((kq + step / 2 - 0.2) / 0.6) - ndtr((kq - step / 2 - 0.2) / 0.6)
rounded = np.array(
    [np.mean(rounding.forward(many[None], np.array([[step]]))[0].f_hat == v) for v in kq]
)
with_noise = many + (rng.random(many.size) - 0.5) * step
around = np.array([np.mean(np.abs(with_noise - v) < 0.05) / 0.1 for v in kq])
assert (
    np.abs(rounded - probability).max() < 0.004 and np.abs(step * around - probability).max() < 0.01
)

# %% [markdown]
# The two errors have the same size as well, $q/\sqrt{12}$ (the mean of $u^2$ is $\int_{-1/2}^{1/2} u^2 du = 1/12$), as long as
# $\phi$ is wider than the step. Where it is not, rounding knows something that noise does not: values that hug a multiple of $q$
# lose less, values that hug a tie lose more, up to $q/2$.


# %%
def rounding_error(deviation, middle):
    """Root mean square error of rounding a Gaussian about `middle` to whole numbers, q = 1: by a sum over its bins."""
    x = np.linspace(-0.5, 0.5, 1001)
    density = sum(np.exp(-0.5 * ((x + k - middle) / deviation) ** 2) for k in range(-30, 31)) / (
        deviation * np.sqrt(2 * np.pi)
    )
    return np.sqrt(np.mean((x * x * density)[:-1]))  # both ends are equal: a plain mean


widths = np.geomspace(0.05, 3, 40)
errors, at_a_tie = np.array([[rounding_error(w, middle) for w in widths] for middle in (0, 0.5)])
assert abs(errors[-1] - 1 / np.sqrt(12)) < 1e-6 and abs(errors[0] - widths[0]) < 1e-6
assert abs(at_a_tie[-1] - 1 / np.sqrt(12)) < 1e-6 and 0.45 < at_a_tie[0] < 0.5

y = np.linspace(-2, 2.4, 500)
smooth = (ndtr((y + step / 2 - 0.2) / 0.6) - ndtr((y - step / 2 - 0.2) / 0.6)) / step
figure, axes = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
axes[0].hist(
    with_noise,
    np.linspace(-2, 2.4, 89),
    density=True,
    color=lessons.COLORS[5],
    alpha=0.6,
    label="noisy values",
)
axes[0].plot(y, smooth, color=lessons.COLORS[0], label=r"$\phi$ averaged over one step")
axes[0].vlines(kq, 0, rounded / step, color=lessons.COLORS[1], lw=2)
axes[0].plot(
    kq, rounded / step, "o", color=lessons.COLORS[1], ms=8, label="rounded values, share / $q$"
)
axes[0].set(
    xlabel="value (units of the attribute)",
    ylabel="density (per unit)",
    xlim=(-2, 2.4),
    ylim=(0, 0.95),
    title="One curve through both ($q = 0.5$)",
)
axes[0].legend(loc="upper left", fontsize=10)
axes[1].semilogx(
    widths, errors, color=lessons.COLORS[1], label="rounding, values about a multiple of $q$"
)
axes[1].semilogx(
    widths, at_a_tie, ":", color=lessons.COLORS[2], lw=3, label="rounding, values about a tie"
)
axes[1].axhline(1 / np.sqrt(12), color=lessons.COLORS[0], ls="--", label=r"noise: $q/\sqrt{12}$")
axes[1].set(
    xlabel="deviation of the values, in steps $q$",
    ylabel="root mean square error, in steps $q$",
    ylim=(0, 0.55),
    title="Same error, unless a step is wider than the values",
)
axes[1].legend(loc="upper right", fontsize=11)
lessons.show(figure, "07_noise_and_rounding")

# %% [markdown]
# ## Backward by hand
# One number: $\tilde f = f + u\,q$, and $u$ is data. A small change is $d\tilde f = df + u\,dq$, hence
# $$\bar f = \bar{\tilde f}, \qquad \bar q = u\,\bar{\tilde f}.$$

# %% [markdown]
# Shapes: `f` and `u` have an entry for each number, so $\bar f$ is handed on unchanged (`"f": f_noisy_bar`). The step serves
# all $n$ numbers of its anchor, so it collects: $\bar q_a = \sum_i u_{ai}\,\bar{\tilde f}_{ai}$.
# In code: `(f_noisy_bar * res.u).sum(axis=1, keepdims=True)`. For the draws of "By hand" and $\bar{\tilde f} = (3, -8)$: -3.5.

# %%
one_anchor = noise.forward(np.array([[1.0, 2]]), np.array([[-0.5, 0.25]]), np.array([[0.2]]))[1]
assert noise.backward(one_anchor, np.array([[3.0, -8]]))["q"] == -3.5
f_noisy_bar = rng.normal(size=(A, n))
bars = noise.backward(noise_res, f_noisy_bar)
assert np.array_equal(bars["f"], f_noisy_bar)
assert np.array_equal(bars["q"], (f_noisy_bar * u).sum(axis=1, keepdims=True)) and bars[
    "q"
].shape == (A, 1)
d_f, d_q = rng.normal(size=f.shape), rng.normal(size=q.shape)
change = (
    noise.forward(f + d_f, u, q + d_q)[0].f_noisy - noisy.f_noisy
)  # linear: no small step needed
assert np.isclose(
    (f_noisy_bar * change).sum(), (bars["f"] * d_f).sum() + (bars["q"] * d_q).sum(), rtol=1e-12
)

# %% [markdown]
# What does $\bar f$ mean on average? The mean $E_u$ over the draws is an integral over one step:
# $$E_u\Bigl[\frac{dL}{df}(f+uq)\Bigr] = \frac{1}{q}\int_{f-\frac{1}{2}q}^{f+\frac{1}{2}q}\frac{dL}{df}(x)\,dx
# = \frac{L(f+\frac{1}{2}q) - L(f-\frac{1}{2}q)}{q} = \frac{d}{df}E_u\bigl[L(f+uq)\bigr]$$
# The gradient is right for a loss smoothed over one step; a single draw is an estimate of it, without bias.


# %%
def L(x):
    return np.sin(3 * x) + x**2


draws = (np.arange(1000) + 0.5) / 1000 - 0.5  # evenly spread in place of random
slopes = 3 * np.cos(3 * (0.8 + draws * 0.5)) + 2 * (0.8 + draws * 0.5)
assert abs(slopes.mean() - (L(0.8 + 0.25) - L(0.8 - 0.25)) / 0.5) < 1e-6

# %% [markdown]
# Rounding is a staircase: slope 0 on every stair, none at its edges. Its backward returns nothing, and that is the truth.

# %%
assert (
    rounding.backward(rounding.forward(f, q)[1], f_noisy_bar) == {}
    and EQUATIONS["rounding"].differentiable == ()
)
inner = rounding.forward(f + 1e-9, q)[0].f_hat
assert np.abs(inner - hard.f_hat).max() == 0

# %% [markdown]
# *Straight-through* is the other way out: go forward with $\hat f$, go back as if it were $f$. That is Eq. (7) with a draw
# that is not random, $u = (\hat f - f)/q$. Minimise $(x - 0.3)^2$ with $q = 1$, starting at $f = 0$, in both ways.


# %%
def descend(draw, steps=4000, rate=0.02):
    """Where gradient descent takes f, when the forward sees f + draw(f)."""
    f, path = 0.0, []
    for _ in range(steps):
        f -= rate * 2 * (f + draw(f) - 0.3)
        path.append(f)
    return np.array(path[steps // 2 :])


straight, noisy_path = descend(lambda f: np.rint(f) - f), descend(lambda f: rng.random() - 0.5)
assert np.abs(straight - 0.5).max() < 0.03 and set(np.rint(straight)) == {0, 1}
assert abs(noisy_path.mean() - 0.3) < 0.02 and set(np.rint(noisy_path)) == {0}
print(
    f"straight-through hovers at {straight.mean():.3f}, a tie; noise settles at {noisy_path.mean():.3f}"
)

# %% [markdown]
# Straight-through ends at the edge 0.5 between two stairs and flips for ever. Noise ends at 0.3 on average, and rounds to 0.
# The paper takes noise here. Straight-through returns in `09_hash_grid`, where a smoothed value would no longer be binary.

# %%
assert abs(straight.mean() - 0.5) < 0.01 and abs(noisy_path.mean() - 0.3) < 0.02
assert len(set(np.rint(straight))) == 2 and np.rint(noisy_path.mean()) == 0

# %% [markdown]
# ## Break it
# `floor(x + 0.5)` looks like rounding, and on random values it is. On ties it goes up. And on the largest number below 0.5 it
# gives 1: the sum itself is rounded, to 1. Two encoders, one with each rule, write different files for one model.

# %%
x = rng.normal(size=100_000) * 5
assert np.array_equal(np.floor(x + 0.5), np.rint(x))  # what still looks fine
below = np.nextafter(0.5, 0)
assert (
    below < 0.5 and np.floor(below + 0.5) == 1 and np.rint(below) == 0 and np.floor(2.5 + 0.5) == 3
)

# %% [markdown]
# The golden cases that stand on ties catch it, and the checker names the mistake.

# %%
from p4dgs_ref import oracle


def half_up(f, q):
    symbols = np.floor(f / q + 0.5).astype(np.int64)
    return symbols, symbols * q


report = oracle.check(half_up, "rounding")
assert not report.ok and report.first.id == "rounding/ties"
print(report.first.id, "fails:", report.first.explanation)
print("passes all the same:", [r.id for r in report.results if r.verdict == "pass"])

# %% [markdown]
# ## What a codec does with it
# Every lossy codec has this step size; in video it follows from the quantisation parameter. Where the values spread over several
# steps, halving it costs about 1 bit more a number and makes the squared error 4 times smaller, 6.02 dB. This trade is what Eq.
# (8) learns, anchor by anchor.


# %%
def entropy(step):
    """Bits a number: entropy of a standard Gaussian rounded to multiples of `step`."""
    k = np.arange(-12 / step, 12 / step + 1)
    p = ndtr((k + 0.5) * step) - ndtr((k - 0.5) * step)
    return -(p[p > 0] * np.log2(p[p > 0])).sum()


sample = rng.normal(size=(1, 200_000))
error = {
    s: np.mean((rounding.forward(sample, np.array([[s]]))[0].f_hat - sample) ** 2)
    for s in (0.25, 0.125)
}
assert abs(entropy(0.125) - entropy(0.25) - 1) < 0.01 and abs(error[0.25] / error[0.125] - 4) < 0.05
assert round(10 * np.log10(4), 2) == 6.02
print({s: f"{entropy(s):.3f} bits, error {e:.2e}" for s, e in error.items()})

# %% [markdown]
# ## Exercises
# **07.1** The symbols of $0.625$, $-0.3$, $0.125$ and $1.1$ with step $0.25$? A list of four whole numbers.
# **07.2** Write Eq. (10): symbols as integers, and `f_hat`. **07.3** Write the backward of Eq. (7).

# %%
answer_1 = ...


def my_rounding(f, q):
    """f (A, n), q (A, 1) -> symbols (A, n) of integers, f_hat (A, n)."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"f" (A, n), "q" (A, 1)}: gradients, from inputs["u"] (A, n) and cotangents["f_noisy_bar"] (A, n)."""
    raise NotImplementedError


lessons.number(
    "07.1",
    answer_1,
    rounding.forward(np.array([[0.625, -0.3, 0.125, 1.1]]), np.array([[0.25]]))[0].symbols[0],
)
lessons.forward("07.2", my_rounding, "rounding")
lessons.backward("07.3", my_backward, "noise")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rounding` and `p4dgs-ref oracle check DIR --only noise`. Ties are where ports differ:
# `round` of C goes away from zero, `Math.round` of JavaScript goes up. Write `rint` or its like, and compare the integers.


# %%
def port(f, q):
    symbols = np.rint(f / q).astype(np.int64)
    return symbols, symbols * q


print(oracle.check(port, "rounding"))
assert oracle.check(port, "rounding").ok and oracle.check(lambda f, u, q: f + u * q, "noise").ok
assert oracle.check(port, "rounding_ties").ok
