# %% [markdown]
# # Eq. (8): a quantisation step for every anchor
#
# **Promise.** After this tutorial you can write one formula in two ways, and explain where one of
# them fails in floating-point arithmetic, and why. **Before it:** `03_opacity_and_masking` for
# networks, `07_noise_and_rounding`. **Takes** two seconds of machine time on two cores, 20 minutes
# of reading and 25 of exercises.
#
# **File:** Eq. (8) [step.py](../p4dgs_ref/equations/step.py).

# %%
from decimal import Decimal, localcontext
from functools import partial

import numpy as np
from scipy.special import expit as sigmoid

from p4dgs_ref import lessons

plt = lessons.begin()
from tutorials.tools import architecture

architecture.show("08_step")
rng = np.random.default_rng(8)

# %% [markdown]
# ## Claim
# Not every anchor needs the same precision. A network reads the context $h$ of the anchor and
# scales a base step $Q_0$:
# $$q = Q_0\cdot\left(1+\tanh(\psi_q(h))\right) \tag{8}$$
# The context is a row of numbers that is looked up at the anchor's position, which is the subject
# of `09_hash_grid`. Here any numbers will do. The step $q$ lies between $0$ and $2Q_0$, and the
# output $\psi_q = 0$ gives $q = Q_0$.

# %% [markdown]
# ## By hand
# We write $u$ for $\psi_q(h)$. With $Q_0 = 1$, the step is 1 at $u = 0$, 1.4621 at $u = 0.5$ and
# 0.0360 at $u = -2$.
#
# The same numbers follow from another formula. Since $\tanh u = \frac{e^u - e^{-u}}{e^u + e^{-u}}$,
# adding 1 leaves a fraction without a subtraction:
# $$1+\tanh u = \frac{2e^u}{e^u+e^{-u}} = \frac{2}{1+e^{-2u}} = 2\,\mathrm{sigmoid}(2u)$$

# %%
from p4dgs_ref.lessons import close

for u in (0, 0.5, -2):
    print(f"u = {u}: printed form {1 + np.tanh(u):.4f}, sigmoid form {2 * sigmoid(2 * u):.4f}")
u = np.linspace(-3, 3, 61)
assert close(2 * sigmoid(2 * u), 1 + np.tanh(u))

# %% [markdown]
# ## In code
# `h [A, I]` goes through $\psi_q$, a network with four outputs. `Q_0 [4]` has one base step for
# each group of attributes, in the order feature, scale, offset scaling, offsets (f, s, l, O). The
# paper's appendix sets them to 1, 0.001, 0.001 and 0.2; the preset `tiny` has 0.25, 0.01, 0.01 and
# 0.1. On a tiny scene, the paper's finer steps of $s_a$ and $l_a$ cost bytes and gain nothing, and
# the other two hardly matter (`reference.md` has the figures under choice Q6). The result is
# `q [A, 4]`. Each column serves all numbers of its group, as in `07_noise_and_rounding`.

# %%
from p4dgs_ref.equations import mlp, rounding, step
from p4dgs_ref.lab.random_inputs import random_network
from p4dgs_ref.training.presets import PAPER_SYNTHETIC, TINY


def base_steps(preset):
    return [preset.Q_f, preset.Q_s, preset.Q_l, preset.Q_O]


assert base_steps(PAPER_SYNTHETIC) == [1, 0.001, 0.001, 0.2]
assert base_steps(TINY) == [0.25, 0.01, 0.01, 0.1]

A, width = 6, 5
h = rng.normal(size=(A, width))
Q_0 = np.array([1, 0.001, 0.002, 0.2])
weights, biases = random_network(rng, width, 7, 4)
q, saved = step.forward(h, weights, biases, Q_0)
u, _ = mlp.forward(h, weights, biases)
assert q.shape == (A, 4)
assert close(q, Q_0 * (1 + np.tanh(u)))

# %% [markdown]
# **Why the printed form fails.** Just above $-1$, consecutive `float32` numbers are about
# $6\cdot 10^{-8}$ apart, and $\tanh u$ is rounded to one of them. Adding 1 is exact, but it leaves
# this rounding error in a small number. A small step therefore has an error as large as itself, and
# from $u = -10$ on the result is 0.

# %%
at_minus_9, at_minus_10 = 1 + np.tanh(np.array([-9, -10], np.float32))
assert at_minus_9 > 0
assert at_minus_10 == 0
u = 0.0
while 1 + np.tanh(u) > 0:
    u -= 1
print("in float64, the printed form is 0 from u =", u, "on")

# %% [markdown]
# The sigmoid form adds a *large* number, $e^{-2u}$, to 1 and divides, so nothing cancels. The next
# cell compares both forms with decimal arithmetic of 50 digits. In `float32`, the printed form has
# errors larger than its value, and the sigmoid form is accurate to $10^{-6}$ everywhere.


# %%
def exact_share(u):
    """Return 1 + tanh(u), computed with 50 digits."""
    with localcontext() as context:
        context.prec = 50
        power = (Decimal(-2) * Decimal(float(u))).exp()
        return float(2 / (1 + power))


def printed_form(u):
    return 1 + np.tanh(u)


def sigmoid_form(u):
    return 2 * sigmoid(2 * u)


us = np.linspace(-20, 4, 241) + 0.013


def relative_error(form, dtype):
    """Return the relative error of a form at all points `us`, in the given precision."""
    given = us.astype(dtype)
    exact = np.array([exact_share(u) for u in given])
    return np.abs(form(given) - exact) / exact


printed_32 = relative_error(printed_form, np.float32)
sigmoid_32 = relative_error(sigmoid_form, np.float32)
assert printed_32[us <= -9].max() >= 1
assert sigmoid_32.max() < 1e-6

# %% [markdown]
# What would a step of 0 do? The quotient $f/q$ of Eq. (10) is infinite, so there is no symbol and
# the file cannot be written. Training could not correct it either, because the slope
# $1 - \tanh^2 u$ of the printed form is also 0 there.

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
# at $u = -3.812$. At the floor, the printed form in `float32` has lost more than two of its seven
# digits.

# %%
edge = 0.5 * np.log(step.SMALLEST / 2 / (1 - step.SMALLEST / 2))
assert abs(edge - -3.812) < 5e-4
near_the_floor = (us > -3.82) & (us < -3)
digits_lost = np.log10(printed_32[near_the_floor].max() / np.finfo(np.float32).eps)
assert 2 <= digits_lost < 3
below_the_floor = np.array([-4.0, -1e4])
q_low, _ = step.forward(np.zeros((1, 1)), [np.zeros((1, 2))], [below_the_floor], np.ones(2))
assert (q_low == 2.0**-10).all()

# %%
blue, red = lessons.COLORS[:2]
figure, (left, right) = plt.subplots(
    1,
    2,
    figsize=(13, 4.8),
    layout="constrained",
)
share = sigmoid_form(us)
left.semilogy(
    us,
    share,
    color=blue,
    label="Eq. (8)",
)
left.semilogy(
    us,
    np.maximum(share, step.SMALLEST),
    "--",
    color=red,
    label="with the floor",
)
lessons.finish(
    left,
    xlabel=r"$u = \psi_q(h)$ (no unit)",
    ylabel="$q / Q_0$ (no unit)",
    xlim=(-8, 4),
    ylim=(1e-4, 4),
    title="A step can be a thousand times smaller than $Q_0$",
)
lessons.label(left, (-1.6, 2e-2), (-7.8, 1.3e-3))
for form, color, name in (
    (printed_form, red, r"$1 + \tanh u$"),
    (sigmoid_form, blue, r"$2\,$sigmoid$(2u)$"),
):
    for dtype, style in ((np.float32, "-"), (np.float64, "--")):
        error = relative_error(form, dtype) + 1e-17
        right.semilogy(
            us,
            error,
            style,
            color=color,
            label=f"{name}, {dtype.__name__}",
        )
right.axvline(edge, color="0.4", lw=1)
right.text(
    edge + 0.3,
    1e-3,
    "to the left\nthe floor applies",
    color="0.3",
    fontsize=11,
)
lessons.finish(
    right,
    xlabel=r"$u = \psi_q(h)$ (no unit)",
    ylabel="relative error (1: no digit right)",
    xlim=(-20, 4),
    ylim=(1e-17, 30),
    title="The printed form loses every digit, the sigmoid form none",
)
lessons.label(
    right,
    (-19.5, 3),
    (-14.6, 1e-12),
    (-18.8, 3e-10),
    (-19.5, 2e-15),
    fontsize=11,
)
lessons.show(figure, "08_step")

# %% [markdown]
# ## Backward by hand
# For one number, let $s = \mathrm{sigmoid}(2u)$. The derivative of the sigmoid is $s\,(1-s)$. One
# factor 2 stands in front of it, and the argument $2u$ contributes another:
# $$dq = 2Q_0\,s(1-s)\,2\,du \quad\Longrightarrow\quad \bar u = 4Q_0\,s\,(1-s)\,\bar q$$
# At $u = 0$ with $Q_0 = 1$ and $\bar q = 3$ this is
# $\bar u = 4\cdot\frac{1}{2}\cdot\frac{1}{2}\cdot 3 = 3$.
#
# The code computes $1-s$ as $\mathrm{sigmoid}(-2u)$, which keeps all its digits. In `float64`,
# $1 - s$ is 0 from $u = 19$ on, so a step at its upper end could never become smaller again. With
# the sigmoid, the slope at $u = 30$ is $4e^{-60}Q_0$, which is tiny but not zero.


# %%
def slope_at(u):
    """Return dq/du for Q_0 = 1, by the module's own backward."""
    _, saved = step.forward(np.zeros((1, 1)), [np.zeros((1, 1))], [np.array([u])], np.ones(1))
    return step.backward(saved, np.array([[1.0]]))["biases"][0][0]


assert 3 * slope_at(0.0) == 3
by_difference = (printed_form(0.5 + 1e-6) - printed_form(0.5 - 1e-6)) / 2e-6
assert abs(slope_at(0.5) - by_difference) < 1e-8
assert 1 - sigmoid(2 * 19.0) == 0
assert close(slope_at(30.0), 4 * np.exp(-60))
assert slope_at(-4.0) == 0  # on the floor

# %% [markdown]
# In the arrays, `q` and `u` have the shape `[A, 4]`, so the formula holds entry by entry, with
# $Q_0$ along the columns. On the floor the slope is 0. Then $\bar u$ enters the backward of the
# network. The last layer, for example, is $u = xW + b$ with the hidden units $x$, and
# $$\bar b = \textstyle\sum_a \bar u_a, \qquad \bar W = x^T \bar u, \qquad \bar x = \bar u\,W^T.$$

# %%
q_bar = rng.normal(size=(A, 4))
ours = step.backward(saved, q_bar)
hidden = np.maximum(h @ weights[0] + biases[0], 0)
u = hidden @ weights[1] + biases[1]
s = sigmoid(2 * u)
u_bar = 4 * Q_0 * s * (1 - s) * q_bar
u_bar[2 * s <= step.SMALLEST] = 0  # on the floor
assert close(ours["biases"][1], u_bar.sum(axis=0))
assert close(ours["weights"][1], hidden.T @ u_bar)
hidden_bar = (u_bar @ weights[1].T) * (hidden > 0)
assert close(ours["h"], hidden_bar @ weights[0].T, 1e-10)

# %% [markdown]
# The adjoint identity checks the context, the weights and the biases at once.

# %%
inputs = {"h": h, "weights": weights, "biases": biases}
_ = lessons.adjoint(rng, partial(step.forward, Q_0=Q_0), inputs, q_bar, ours)


# %% [markdown]
# ## Break it
# Suppose we forget the factor 2 in the argument, so that $q = 2Q_0\,\mathrm{sigmoid}(u)$. The step
# still rises to $2Q_0$, and it is still $Q_0$ at $u = 0$. Training compensates for the mistake,
# because a last layer with weights twice as large gives the old steps again. But a file that
# another program has written gives other steps. The golden vectors find the mistake.


# %%
def half_argument(h, weights, biases, Q_0):
    u, _ = mlp.forward(h, weights, biases)
    return Q_0 * np.maximum(2 * sigmoid(u), step.SMALLEST)


twice_weights = [weights[0], 2 * weights[1]]
twice_biases = [biases[0], 2 * biases[1]]
assert close(half_argument(h, twice_weights, twice_biases, Q_0), q)
lessons.caught(half_argument, "step", "2 psi_q")


# %% [markdown]
# What about the printed form with the same floor? The golden vectors `step_floor` test only the
# last line of the code, $q$ as a function of $u$. In `float64` the printed form has lost a few
# digits beside the floor. The check calls that acceptable: the formula is right, and it names what
# would keep the digits. With `strict=True` it fails. Since `float64` has many more digits than
# anybody needs, this loss does little harm. A port in `float32` has no digits to spare.


# %%
from p4dgs_ref import decode, oracle


def printed_with_floor(u, Q_0):
    return Q_0 * np.maximum(printed_form(u), step.SMALLEST)


report = oracle.check(printed_with_floor, "step_floor")
assert report.ok
report = oracle.check(printed_with_floor, "step_floor", strict=True)
print(report.first.id, "fails where digits are demanded")
assert report.first.id == "step_floor/beside_the_floor"

# %% [markdown]
# ## What a codec does with it
# A video encoder changes its quantisation parameter from block to block and sends the changes. Here
# nothing is sent, because the decoder and the encoder both compute $q$ from the grid. The cell
# shows the steps of the model in the golden vectors, whose parameters were drawn at random, not
# trained. [See it move](viewer/demo.html#step=5): the demo with coarser and coarser steps.

# %%
from p4dgs_ref.report.inspect import float_context

model = decode((oracle.path() / "model.p4dgs").read_bytes())
share = float_context(model).q / np.array(model.design.Q_0)
assert (share >= step.SMALLEST).all()
assert (share <= 2).all()
for group, column in zip("fslO", share.T):
    print(f"{group}: steps between {column.min():.3f} and {column.max():.3f} times Q_0")

# %% [markdown]
# ## Exercises
# **08.1** ● At which $u$ is the step half of $Q_0$?
#
# **08.2** ●● The four groups share one $u$, so that $\psi_q$ needs one column. What changes in the
# gradient? Give $\bar u$ at the $u$ of 08.1, for $Q_0 = (0.25, 0.01, 0.01, 0.1)$ and
# $\bar q = (1, -10, 20, 4)$, and $\bar u$ at $u = -5$, where the floor applies.
#
# **08.3** ●● Write the backward of Eq. (8), with the slope 0 on the floor. You may use
# `u, saved = mlp.forward(x, weights, biases)`; `mlp.backward(saved, u_bar)` returns a dictionary of
# `"x"`, `"weights"` and `"biases"`.
#
# **Predict, then run.** A port computes $1 + \tanh u$ in float16, as it is printed. What does it
# return at $u = -4$ and at $u = -5$? The true values are $0.00067$ and $0.000091$.

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
# clamps only the value, outside of what its framework differentiates, passes the gradient on.

# %%
lessons.passes("step")
