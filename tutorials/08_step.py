# %% [markdown]
# # Eq. (8): a quantisation step for every anchor
#
# **Promise.** After this tutorial you can say why every anchor has its own quantisation step,
# compute it and its gradient by hand, and say how much it gains. **Before it:**
# `03_opacity_and_masking` for networks, `07_noise_and_rounding`. **Takes** ten seconds of machine
# time on two cores, 25 minutes of reading and 25 of exercises.
#
# **File:** Eq. (8) [step.py](../p4dgs_ref/equations/step.py).

# %%
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import expit as sigmoid

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("08_step")
rng = np.random.default_rng(8)

# %% [markdown]
# ## What fails without it
# One step for all anchors is too coarse for some of them and too fine for others: a coarse step
# damages anchors that are seen well, and a fine one spends bits on anchors that are hardly seen.
#
# The left side shows the scene of `demo.p4dgs` with all features rounded to one coarse step, 2. For
# the right side, only the features of one anchor were rounded to it, one anchor after another. A
# dot is the squared error in the picture that one anchor causes; the dots are sorted by it. *Anchor
# 29* is purple.

# %%
model, camera, thread = tour.MODEL, tour.CAMERA, figures.THREAD


def rounded(anchors):
    """The trained model with the features of some anchors rounded to multiples of 2."""
    f_a = model.anchors.f_a.copy()
    f_a[anchors] = 2 * np.round(f_a[anchors] / 2)
    return replace(model, anchors=model.anchors._replace(f_a=f_a))


clean = model.render(camera, tour.T)
damage = [np.sum((rounded(a).render(camera, tour.T) - clean) ** 2) for a in range(model.count)]
most, median = np.quantile(damage, (0.9, 0.5))
print(f"a tenth of the anchors suffers at least {most / median:.0f} times as much as the median")
assert most > 15 * median

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
coarse = show.frame(rounded(slice(None)), camera, tour.T)
show.picture(left, coarse, camera, **tour.VIEW, title="one coarse step for all features")
right.semilogy(np.sort(damage), ".", color=show.GREY)
mine = damage[thread.index]
right.semilogy(np.sum(damage < mine), mine, "o", ms=12, color=thread.color)
right.set(
    xlabel="anchors, in order",
    ylabel="squared error in the picture",
    title="what the rounding of a single anchor costs",
)
figures.show(figure, "08_step_one_for_all")

# %% [markdown]
# ## Claim
# A network $\psi_q$ therefore reads the context $h$ of the anchor and scales a base step $Q_0$:
# $$q = Q_0\cdot\left(1+\tanh(\psi_q(h))\right) \tag{8}$$
# The context is a row of numbers that is looked up at the anchor's position, which is the subject
# of `09_hash_grid`. Here any numbers will do. The step $q$ lies between $0$ and $2Q_0$, and the
# output $\psi_q = 0$ gives $q = Q_0$.

# %% [markdown]
# ## By hand
# With $Q_0 = 1$, the step is 1 at $\psi_q = 0$, 1.4621 at $\psi_q = 0.5$ and 0.0360 at
# $\psi_q = -2$.
#
# The same numbers follow from another formula, which the code uses (*For ports* at the end says
# why). Since $\tanh\psi = \frac{e^\psi - e^{-\psi}}{e^\psi + e^{-\psi}}$, adding 1 leaves a
# fraction without a subtraction:
# $$1+\tanh\psi = \frac{2e^\psi}{e^\psi+e^{-\psi}} = \frac{2}{1+e^{-2\psi}}
# = 2\,\mathrm{sigmoid}(2\psi)$$

# %%
from p4dgs_ref.lessons import close

print(1 + np.tanh([0, 0.5, -2]))
psi = np.linspace(-3, 3, 61)
assert close(2 * sigmoid(2 * psi), 1 + np.tanh(psi))

# %% [markdown]
# ## In code
# `h [A, I]` goes through $\psi_q$, a network with four outputs. `Q_0 [4]` has one base step for
# each group of attributes, in the order feature, scale, offset scaling, offsets (f, s, l, O). The
# paper's appendix sets them to 1, 0.001, 0.001 and 0.2; the preset `tiny` has 0.25, 0.01, 0.01 and
# 0.1. On a tiny scene, the paper's finer steps of $s_a$ and $l_a$ cost bytes and gain nothing; its
# coarser steps of the other two hardly matter (choice Q6). The result is `q [A, 4]`. Each column
# serves all numbers of its group, as in `07_noise_and_rounding`.

# %%
from p4dgs_ref.equations import mlp, rounding, step
from p4dgs_ref.lab.random_inputs import random_network

assert model.design.Q_0 == (0.25, 0.01, 0.01, 0.1)

# paper, Sec. 3.3: a step for every anchor, Q_0 times 1 + tanh of a network of h
# silent: Q6, one step for all numbers of a group; Q7, a floor of 2^-10 Q_0
A, width = 6, 5
h = rng.normal(size=(A, width))
Q_0 = np.array([1, 0.001, 0.002, 0.2])
weights, biases = random_network(rng, width, 7, 4)
q, saved = step.forward(h, weights, biases, Q_0)
psi_q, _ = mlp.forward(h, weights, biases)
assert q.shape == (A, 4)
assert close(q, Q_0 * (1 + np.tanh(psi_q)))

# %% [markdown]
# The next cell prints the four steps of anchor 29 in the demo's file: fine ones for features,
# offset scaling and offsets, and almost the widest possible one for its scale. The curve ends on
# the left at a *floor* (choice `Q7`), $q \ge 2^{-10} Q_0$, so that the quotient $f/q$ of Eq. (10)
# stays finite.

# %%
from p4dgs_ref.report.inspect import float_context

shares = float_context(model).q / np.array(model.design.Q_0)
own = shares[thread.index]
print(f"{thread.name}:", ", ".join(f"{g} {x:.2f} Q_0" for g, x in zip("fslO", own)))
assert (shares >= step.SMALLEST).all()
assert (shares <= 2).all()

# %%
figure, ax = plt.subplots(figsize=(9, 4.8), layout="constrained")
psi = np.linspace(-5, 4, 361)
ax.semilogy(psi, np.maximum(2 * sigmoid(2 * psi), step.SMALLEST), color=show.STEP)
ax.semilogy(np.arctanh(own - 1), own, "o", ms=10, color=thread.color)
for group, share, x, y in zip("fslO", own, (0.3, 1.5, 0.3, 0.3), (0.6, 0.9, 0.2, 0.35)):
    ax.text(x, y, f"{group}: {share:.2f} $Q_0$", color=thread.color, va="center")
ax.set(
    xlabel=r"output $\psi_q(h)$ of the network",
    ylabel="$q / Q_0$",
    title="Eq. (8), and the four steps of anchor 29",
)
figures.show(figure, "08_step")

# %% [markdown]
# ## Backward by hand
# For one number, let $g = \mathrm{sigmoid}(2\psi_q)$. The derivative of the sigmoid is $g\,(1-g)$.
# One factor 2 stands in front of it, and the argument $2\psi_q$ contributes another:
# $$dq = 2Q_0\,g(1-g)\,2\,d\psi_q \quad\Longrightarrow\quad
# \bar\psi_q = 4Q_0\,g\,(1-g)\,\bar q$$
# At $\psi_q = 0$ with $Q_0 = 1$ and $\bar q = 3$ this is $\bar\psi_q =
# 4\cdot\frac{1}{2}\cdot\frac{1}{2}\cdot 3 = 3$.


# %%
def slope_at(psi):
    """Return dq/dpsi_q for Q_0 = 1, by the module's own backward."""
    _, saved = step.forward(np.zeros((1, 1)), [np.zeros((1, 1))], [np.array([psi])], np.ones(1))
    return step.backward(saved, np.array([[1.0]]))["biases"][0][0]


assert 3 * slope_at(0.0) == 3
by_difference = (np.tanh(0.5 + 1e-6) - np.tanh(0.5 - 1e-6)) / 2e-6
assert abs(slope_at(0.5) - by_difference) < 1e-8
assert slope_at(-4.0) == 0  # on the floor

# %% [markdown]
# In the arrays, `q` and $\psi_q$ have the shape `[A, 4]`, so the formula holds entry by entry, with
# $Q_0$ along the columns. On the floor the slope is 0. Then $\bar\psi_q$ enters the backward of the
# network. The last layer, for example, is $\psi_q = xW + b$ with the hidden units $x$, and
# $$\bar b = \textstyle\sum_a \bar\psi_{q,a}, \qquad \bar W = x^T \bar\psi_q, \qquad
# \bar x = \bar\psi_q\,W^T.$$

# %%
q_bar = rng.normal(size=(A, 4))
ours = step.backward(saved, q_bar)
hidden = np.maximum(h @ weights[0] + biases[0], 0)
g = sigmoid(2 * psi_q)
psi_q_bar = 4 * Q_0 * g * (1 - g) * q_bar
psi_q_bar[2 * g <= step.SMALLEST] = 0  # on the floor
assert close(ours["biases"][1], psi_q_bar.sum(axis=0))
assert close(ours["weights"][1], hidden.T @ psi_q_bar)

# %% [markdown]
# The adjoint identity checks the context, the weights and the biases at once.

# %%
inputs = {"h": h, "weights": weights, "biases": biases}
_ = lessons.adjoint(rng, partial(step.forward, Q_0=Q_0), inputs, q_bar, ours)


# %% [markdown]
# ## Break it
# Suppose we forget the factor 2 in the argument, so that $q = 2Q_0\,\mathrm{sigmoid}(\psi_q)$. The
# step still rises to $2Q_0$, and it is still $Q_0$ at $\psi_q = 0$. Training compensates for the
# mistake, because a last layer with weights twice as large gives the old steps again. But a file
# that another program has written gives other steps. The golden vectors find the mistake.


# %%
def half_argument(h, weights, biases, Q_0):
    psi_q, _ = mlp.forward(h, weights, biases)
    return Q_0 * np.maximum(2 * sigmoid(psi_q), step.SMALLEST)


twice_weights = [weights[0], 2 * weights[1]]
twice_biases = [biases[0], 2 * biases[1]]
assert close(half_argument(h, twice_weights, twice_biases, Q_0), q)
lessons.check_mistake(half_argument, "step", "2 psi_q")

# %% [markdown]
# ## What a codec does with it
# A video encoder changes its quantisation parameter from block to block and sends the changes. Here
# nothing is sent, because the decoder and the encoder both compute $q$ from the grid.
#
# Where did training put the coarse steps? The loss rewards coarse steps for anchors that are seldom
# seen, although nothing in Eq. (8) says so. The cell counts in how many of the 48 training pictures
# an anchor is seen, which means that its Gaussians together fill more than a quarter of a pixel.
# The number of pixels that a Gaussian fills is the gradient of the sum of all pixels with respect
# to its colour. [See it move](viewer/demo.html#step=steps): the demo with coarser and coarser
# steps.

# %%
from scipy.stats import spearmanr

from p4dgs_ref import load_scene
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import FAST

seen = np.zeros(model.count)
for view in load_scene("bouncing").train:
    *gaussians, index = model.gaussians(view.time, view.camera)
    (image, *_), saved = render.forward(*gaussians, view.camera, model.background, FAST)
    pixels = render.backward(saved, np.ones_like(image))["color"][:, 0]
    seen += np.bincount(index // model.design.k, pixels, model.count) > 0.25
ranks = [spearmanr(seen, column).statistic for column in shares.T]
least, most = (shares[seen <= np.quantile(seen, 0.25)], shares[seen >= np.quantile(seen, 0.75)])
print("rank correlations of f, s, l, O:", np.round(ranks, 2))
print("seldom seen, times as wide:", np.round(least.mean(axis=0) / most.mean(axis=0), 2))
assert np.allclose(ranks, [-0.31, -0.06, -0.38, -0.53], atol=0.02)

# %%
figure, panels = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
for ax, group, name in zip(panels, (0, 3), ("features", "offsets")):
    ax.plot(seen, shares[:, group], ".", ms=8, color=show.STEP)
    ax.plot(seen[thread.index], own[group], "o", ms=12, color=thread.color)
    ax.set(
        xlabel="training pictures in which an anchor is seen",
        ylabel="$q / Q_0$",
        title=f"steps of {name}: rank correlation {ranks[group]:+.2f}",
    )
figures.show(figure, "08_step_seen")

# %% [markdown]
# The steps of features, offset scaling and offsets are wider where an anchor is seldom seen: in the
# quarter of anchors that is seen least they are 1.2 to 1.5 times as wide as in the quarter that is
# seen most. This is a tendency with many exceptions. The steps of scales show no tendency: nearly
# all of them are at their limit, $2Q_0$.

# %% [markdown]
# ## What this idea buys
# In the ablation, "one step" gives every anchor $q = Q_0$. With a step for each anchor, our files
# have nearly the same size and 0.35 dB more on `bouncing` (0.20, 0.50 and 0.35 dB with three
# seeds); on the scene `figure` it makes no difference. The paper counts quantisation and entropy
# coding together (`10_prior_and_likelihood`) and has no number for this part alone.

# %%
from tutorials import gains

rows = {"one step": "fixed step", "a step for each anchor": "+ quantisation and entropy coding"}
one_step, own_step = (gains.mean(label, "psnr_db") for label in rows.values())
assert round(own_step - one_step, 2) == 0.35
gains.show("08_step", rows, {})

# %% [markdown]
# **In short**
# - The step of every anchor and group is read from the context, between 0 and $2Q_0$; it is $Q_0$
#   where $\psi_q = 0$.
# - No bit is spent on steps: both sides compute them.
# - Training makes the steps of anchors that are seldom seen somewhat wider, here 1.2 to 1.5 times
#   as wide.
#
# **Often misunderstood**
# - *Steps become wide where nobody sees the difference.* This is only a tendency: $\psi_q$ reads
#   only the context, which neighbours share.
# - *$Q_0$ is the step.* It is the middle of the range. If many steps are at $2Q_0$, as those of
#   scales are here, a larger $Q_0$ is worth a try.
# - *A smaller step is always better.* Halving it costs about one bit for every number.

# %% [markdown]
# ## Exercises
# **08.1** ● At which $\psi_q$ is the step half of $Q_0$?
#
# **08.2** ●● Suppose that the four groups share one output $\psi_q$, so that the last layer needs
# only one column. What changes in the gradient? Give $\bar\psi_q$ at the $\psi_q$ of 08.1, for $Q_0
# = (0.25, 0.01, 0.01, 0.1)$ and $\bar q = (1, -10, 20, 4)$, and $\bar\psi_q$ at $\psi_q = -5$,
# where the floor applies.
#
# **08.3** ●● Write the backward of Eq. (8), with the slope 0 on the floor. You may use
# `psi_q, saved = mlp.forward(x, weights, biases)`; `mlp.backward(saved, psi_q_bar)` returns a
# dictionary of `"x"`, `"weights"` and `"biases"`.
#
# **Predict, then run.** A port computes $1 + \tanh\psi_q$ in float16, as it is printed. What does
# it return at $\psi_q = -4$ and at $\psi_q = -5$? The true values are $0.00067$ and $0.000091$.

# %%
answer_1 = ...
answer_2 = ...


def my_backward(inputs, cotangents):
    """Return the gradients {"h": array [A, I], "weights": list, "biases": list}.

    `inputs` has these names and "Q_0" [G], and cotangents["q_bar"] has the shape [A, G].
    """
    raise NotImplementedError


lessons.check_number("08.1", answer_1)
lessons.check_number("08.2", answer_2)
lessons.check_backward("08.3", my_backward, "step")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only step` compares what a port wrote. Begin with the scalar
# formula, `--only step_floor`, and look at its gradient, which must be 0 on the floor. A port that
# clamps the value outside of what its framework differentiates lets the gradient pass, which is
# wrong.

# %%
lessons.passes("step")

# %% [markdown]
# ## For ports
# **Why the printed form fails.** Just above $-1$, consecutive `float32` numbers are about $6\cdot
# 10^{-8}$ apart, and $\tanh\psi_q$ is rounded to one of them. Adding 1 is exact, but it leaves this
# rounding error in a small number. A small step therefore has an error as large as itself, and from
# $\psi_q = -10$ on the result is 0.

# %%
at_minus_9, at_minus_10 = 1 + np.tanh(np.array([-9, -10], np.float32))
assert at_minus_9 > 0
assert at_minus_10 == 0
psi = 0.0
while 1 + np.tanh(psi) > 0:
    psi -= 1
print("in float64, the printed form is 0 from psi_q =", psi, "on")

# %% [markdown]
# The sigmoid form adds a *large* number, $e^{-2\psi_q}$, to 1 and divides, so nothing cancels. The
# next cell compares both forms with decimal arithmetic of 50 digits. In `float32`, the printed form
# has errors larger than its value, and the sigmoid form is accurate to $10^{-6}$ everywhere.


# %%
from decimal import Decimal, localcontext


def exact_share(psi):
    """Return 1 + tanh(psi), computed with 50 digits."""
    with localcontext() as context:
        context.prec = 50
        power = (Decimal(-2) * Decimal(float(psi))).exp()
        return float(2 / (1 + power))


def printed_form(psi):
    return 1 + np.tanh(psi)


def sigmoid_form(psi):
    return 2 * sigmoid(2 * psi)


points = np.linspace(-20, 4, 241) + 0.013


def relative_error(form, dtype):
    """Return the relative error of a form at all `points`, in the given precision."""
    given = points.astype(dtype)
    exact = np.array([exact_share(psi) for psi in given])
    return np.abs(form(given) - exact) / exact


printed_32 = relative_error(printed_form, np.float32)
sigmoid_32 = relative_error(sigmoid_form, np.float32)
assert printed_32[points <= -9].max() >= 1
assert sigmoid_32.max() < 1e-6

# %% [markdown]
# What would a step of 0 do? The quotient $f/q$ of Eq. (10) is infinite, so there is no symbol and
# the file cannot be written. Training could not correct it either, because the slope
# $1 - \tanh^2\psi_q$ of the printed form is also 0 there.

# %%
assert 1 - np.tanh(np.float32(-10)) ** 2 == 0
try:
    rounding.forward(np.array([[0.3]]), np.array([[0.0]]))
    raise AssertionError("expected an OverflowError")
except OverflowError as error:
    print("rounding says:", error)

# %% [markdown]
# The sigmoid form does not become 0, but the symbols $f/q$ would still grow without bound as $q$
# shrinks. The project therefore adds a *floor* (choice `Q7`), $q \ge 2^{-10} Q_0$, which is reached
# at $\psi_q = -3.812$. At the floor, the printed form in `float32` has lost more than two of its
# seven digits.

# %%
edge = 0.5 * np.log(step.SMALLEST / 2 / (1 - step.SMALLEST / 2))
assert abs(edge - -3.812) < 5e-4
near_the_floor = (points > -3.82) & (points < -3)
digits_lost = np.log10(printed_32[near_the_floor].max() / np.finfo(np.float32).eps)
assert 2 <= digits_lost < 3
below_the_floor = np.array([-4.0, -1e4])
q_low, _ = step.forward(np.zeros((1, 1)), [np.zeros((1, 2))], [below_the_floor], np.ones(2))
assert (q_low == 2.0**-10).all()

# %%
figure, ax = plt.subplots(figsize=(9, 4.8), layout="constrained")
for form, color in ((printed_form, show.STEP), (sigmoid_form, show.SPACE)):
    for dtype, style in ((np.float32, "-"), (np.float64, "--")):
        label = f"{form.__name__.replace('_', ' ')}, {dtype.__name__}"
        ax.semilogy(points, relative_error(form, dtype) + 1e-17, style, color=color, label=label)
ax.axvline(edge, color="0.4", lw=1)
ax.set(
    xlabel=r"$\psi_q(h)$; the floor applies to the left of the line",
    ylabel="relative error (1: no digit right)",
    title="The printed form loses every digit, the sigmoid form none",
)
ax.legend(fontsize=11, loc=(0.02, 0.1))
figures.show(figure, "08_step_digits")

# %% [markdown]
# In the backward, the code computes $1-g$ as $\mathrm{sigmoid}(-2\psi_q)$, which keeps all its
# digits. In `float64`, $1 - g$ is 0 from $\psi_q = 19$ on, so a step at its upper end could never
# become smaller again. With the sigmoid, the slope at $\psi_q = 30$ is $4e^{-60}Q_0$, which is tiny
# but not zero.

# %%
assert 1 - sigmoid(2 * 19.0) == 0
assert close(slope_at(30.0), 4 * np.exp(-60))

# %% [markdown]
# Is the printed form good enough with the same floor? The golden vectors `step_floor` test only the
# last line of the code, $q$ as a function of $\psi_q$, which they call `u`. In `float64` the
# printed form has lost a few digits beside the floor. The check accepts that, because the formula
# is right, and says how to keep the digits; with `strict=True` it fails. The loss does little harm,
# because `float64` has many more digits than anybody needs. A port in `float32` has no digits to
# spare.


# %%
from p4dgs_ref import oracle


def printed_with_floor(u, Q_0):
    return Q_0 * np.maximum(printed_form(u), step.SMALLEST)


report = oracle.check(printed_with_floor, "step_floor")
assert report.ok
report = oracle.check(printed_with_floor, "step_floor", strict=True)
print(report.first.id, "fails where digits are demanded")
assert report.first.id == "step_floor/beside_the_floor"
