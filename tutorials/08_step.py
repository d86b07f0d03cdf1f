# %% [markdown]
# # Eq. (8): a quantisation step for every anchor
#
# **Promise.** After this you can write one formula in two ways, say which of them dies in floats, and where, and why.
# **Before it:** `03_opacity_and_masking` for networks, `07_noise_and_rounding`.
# **Takes** two seconds of machine time on two cores, half an hour of yours.

# %%
from decimal import Decimal, localcontext

import numpy as np
from scipy.special import expit

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.equations import mlp, rounding, step
from p4dgs_ref.school import lessons

plt = lessons.pyplot()
rng = np.random.default_rng(8)

# %% [markdown]
# ## Claim
# Not every anchor deserves the same precision. A network reads the context $h$ of the anchor and scales a base step:
# $$q = Q_0\cdot\left(1+\tanh(\psi_q(h))\right) \tag{8}$$
# $h$ is a row of numbers looked up at the anchor's place, the subject of `09_hash_grid`; here any numbers will do. So $q$ lies in
# $(0, 2Q_0)$, and a network that says nothing, $\psi_q = 0$, leaves $Q_0$.

# %% [markdown]
# ## By hand
# Write $u$ for $\psi_q(h)$. With $Q_0 = 1$: at $u = 0$ the step is 1; at $u = 0.5$ it is 1.4621, at $u = -2$ it is 0.0360.

# %%
q = [1 + np.tanh(u) for u in (0, 0.5, -2)]
assert q[0] == 1 and [f"{v:.4f}" for v in q[1:]] == ["1.4621", "0.0360"]  # 1.4621, 0.0360
assert abs(q[1] - 1.4621) < 5e-5 and abs(q[2] - 0.0360) < 5e-5

# %% [markdown]
# The same by another road. $\tanh u = \frac{e^u - e^{-u}}{e^u + e^{-u}}$, so one plus it has nothing left to subtract:
# $$1+\tanh u = \frac{2e^u}{e^u+e^{-u}} = \frac{2}{1+e^{-2u}} = 2\,\mathrm{sigmoid}(2u)$$

# %%
u = np.linspace(-3, 3, 61)
assert np.allclose(2 * expit(2 * u), 1 + np.tanh(u), rtol=1e-13)

# %% [markdown]
# ## In code
# `h (A, I)` goes through `psi_q`, a network from `I` numbers to four; `Q_0 (4,)` has one base for each group of attributes, in
# the order feature, scale, offset scaling, offsets: f, s, l, O. Out comes `q (A, 4)`. Each column then serves all numbers of its
# group, as `07_noise_and_rounding` used it.

# %%
A, I = 6, 5
h, Q_0 = rng.normal(size=(A, I)), np.array([1, 0.001, 0.002, 0.2])
weights, biases = mlp.random_network(rng, I, 7, len(Q_0))
out, res = step.forward(h, weights, biases, Q_0)
assert Q_0.shape == (4,) and out.q.shape == (A, 4)
u = np.maximum(h @ weights[0] + biases[0], 0) @ weights[1] + biases[1]
assert np.allclose(out.q, Q_0 * (1 + np.tanh(u)), rtol=1e-12)

# %% [markdown]
# **Why the printed form dies.** Near $-1$, `float32` numbers lie about 6e-8 apart, and $\tanh u$ is rounded to one of them.
# Adding 1 is exact, but it uncovers the rounding: a small true value has an error as large as itself. From $u = -10$ on it is 0.

# %%
gap = np.float32(1) - np.nextafter(np.float32(1), np.float32(0))
assert abs(gap - 6e-8) < 1e-9
plus_one = 1 + np.tanh(np.array([-9, -10], np.float32))
assert plus_one[0] > 0 and plus_one[1] == 0 and plus_one.dtype == np.float32  # u = -9, -10
first_64 = next(u for u in range(0, -40, -1) if 1 + np.tanh(float(u)) == 0)
print("in float64 it is 0 from u =", first_64, "on")


# %% [markdown]
# The sigmoid form adds a *large* number, $e^{-2u}$, to 1, and divides. No digits meet their opposite; none are lost.
# Beside decimal arithmetic of $50$ digits, in `float32`: the printed form is wrong by more than its value where the sigmoid is
# right to 1e-6.


# %%
def true_share(u):
    """1 + tanh u from 50 digits."""
    with localcontext() as context:
        context.prec = 50
        return float(2 / (1 + (Decimal(-2) * Decimal(float(u))).exp()))


def relative_error(form, dtype):
    given = us.astype(dtype)
    right = np.array([true_share(u) for u in given])
    return np.abs(form(given) - right) / right + 1e-17


us = np.linspace(-20, 4, 241) + 0.013
forms = {
    "$1 + \\tanh u$": lambda u: 1 + np.tanh(u),
    "$2\\,$sigmoid$(2u)$": lambda u: 2 * expit(2 * u),
}
found = {
    (name, t.__name__): relative_error(form, t)
    for name, form in forms.items()
    for t in (np.float32, np.float64)
}
printed, sigmoid = (found[name, "float32"] for name in forms)
assert printed[us <= -9].max() >= 1 and sigmoid.max() < 1e-6

# %% [markdown]
# What would a step of 0 do? The quotient $f/q$ of Eq. (10) is infinite: no integer is near it, and no file can be written.
# Nothing would lead training back, either: the slope $1 - \tanh^2 u$ is 0 there, too.

# %%
with np.errstate(divide="ignore"):
    assert plus_one[1] == 0 and np.isinf(np.float32(0.3) / plus_one[1])
assert (1 - np.tanh(np.array([-10], np.float32)) ** 2 == 0).all()
try:
    rounding.forward(np.array([[0.3]]), np.array([[0.0]]))
    raise AssertionError("expected an OverflowError")
except OverflowError as error:
    print("rounding says:", error)

# %% [markdown]
# The sigmoid is alive at such $u$, but the symbols $f/q$ would grow without bound as $q$ goes to zero. So the project adds a
# *floor* (choice Q7): $q \ge 2^{-10} Q_0$, reached at $u = -3.812$. So far down the printed form has lost over two digits of
# seven.

# %%
edge = 0.5 * np.log(step.FLOOR / 2 / (1 - step.FLOOR / 2))
assert step.FLOOR == 2.0**-10 and abs(edge - -3.812) < 5e-4
lost = np.log10(printed[(us > -3.82) & (us < -3)].max() / np.finfo(np.float32).eps)
assert 2 <= lost < 3
on_floor = step.forward(np.zeros((1, 1)), [np.zeros((1, 2))], [np.array([-4.0, -1e4])], np.ones(2))[
    0
].q
assert (on_floor == step.FLOOR).all()

figure, axes = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
axes[0].plot(us, 2 * expit(2 * us), color=lessons.COLORS[0], label="Eq. (8)")
axes[0].plot(
    us,
    2 * np.maximum(expit(2 * us), step.FLOOR / 2),
    "--",
    color=lessons.COLORS[1],
    label="with the floor",
)
axes[0].set(
    xlabel=r"$u = \psi_q(h)$ (no unit)",
    ylabel="$q / Q_0$ (no unit)",
    yscale="log",
    xlim=(-8, 4),
    ylim=(1e-4, 4),
    title="A step may shrink a thousandfold",
)
axes[0].legend(loc="lower right")
for i, ((name, precision), error) in enumerate(found.items()):
    axes[1].semilogy(
        us,
        error,
        color=lessons.COLORS[1 - i // 2],
        ls=("-", "--")[i % 2],
        label=f"{name}, {precision}",
    )
axes[1].axvline(edge, color="0.4", lw=1)
axes[1].text(
    edge + 0.3,
    1e-3,
    "left of this\nthe floor holds",
    ha="left",
    va="bottom",
    color="0.3",
    fontsize=11,
)
axes[1].set(
    xlabel=r"$u = \psi_q(h)$ (no unit)",
    ylabel="relative error (1 = no digit right)",
    ylim=(1e-17, 30),
    title="One plus tanh loses every digit, the sigmoid none",
    xlim=(-20, 4),
)
axes[1].legend(loc=(0.02, 0.17), fontsize=11)
lessons.show(figure, "08_step")

# %% [markdown]
# ## Backward by hand
# One number. The sigmoid's derivative is $s(1-s)$, and its argument is $2u$: two factors of 2, one in front, one inside.
# $$dq = 2Q_0\,s(1-s)\,2\,du \quad\Longrightarrow\quad \bar u = 4Q_0\,s\,(1-s)\,\bar q, \qquad s = \mathrm{sigmoid}(2u)$$

# %%
u_bar = lambda u, q_bar: 4 * expit(2 * u) * expit(-2 * u) * q_bar
by_difference = ((1 + np.tanh(0.5 + 1e-6)) - (1 + np.tanh(0.5 - 1e-6))) / 2e-6
assert abs(u_bar(0.5, 1.0) - by_difference) < 1e-8 and 2 * 2 == 4

# %% [markdown]
# The code takes $1-s$ as `expit(-2u)`, SciPy's sigmoid of $-2u$: the same number with all its digits. In `float64` $1 - s$ is 0
# from $u = 19$ on: a step at its upper end could then never come down. With `expit(-2u)` the slope at $u = 30$ is $4e^{-60}Q_0$:
# tiny, but alive. For a worked number take $u = 0$, $Q_0 = 1$, $\bar q = 3$:
# $\bar u = 4\cdot\frac{1}{2}\cdot\frac{1}{2}\cdot 3 = 3$.

# %%
assert 1 - expit(2 * 19.0) == 0 and expit(-2 * 19.0) > 0 and u_bar(0, 3) == 3
assert np.isclose(u_bar(30.0, 1.0), 4 * np.exp(-60), rtol=1e-14)
flat = step.forward(np.zeros((1, 1)), [np.zeros((1, 1))], [np.array([30.0])], np.ones(1))[1]
assert np.isclose(
    step.backward(flat, np.array([[1.0]]))["biases"][0][0], 4 * np.exp(-60), rtol=1e-14
)

# %% [markdown]
# Shapes: `q`, `u` and the slope are `(A, 4)`, so this line works entry by entry, with $Q_0$ along the columns. On the floor
# the slope is 0. Then $\bar u$ enters the network's backward, here its last layer $u = xW + b$, $x$ the hidden activations:
# $$\bar b = \textstyle\sum_a \bar u_a, \qquad \bar W = x^T \bar u, \qquad \bar x = \bar u\,W^T$$

# %%
q_bar = rng.normal(size=(A, 4))
bars = step.backward(res, q_bar)
s, x = expit(2 * u), np.maximum(h @ weights[0] + biases[0], 0)
u_bar = 4 * Q_0 * s * (1 - s) * q_bar * (s > step.FLOOR / 2)  # 0 on the floor
assert np.allclose(q_bar * res.slope, u_bar, rtol=1e-12)  # the code's name for it
assert np.allclose(bars["biases"][1], u_bar.sum(axis=0), rtol=1e-12)  # b_bar
assert np.allclose(bars["weights"][1], x.T @ u_bar, rtol=1e-12, atol=1e-18)  # W_bar
x_bar = (u_bar @ weights[1].T) * (x > 0)  # through the ReLU
assert np.allclose(bars["h"], x_bar @ weights[0].T, rtol=1e-10, atol=1e-18)  # and the first layer

# %% [markdown]
# The adjoint identity over all inputs at once: move context, weights and biases, and compare with differences.

# %%
d_h = rng.normal(size=h.shape)
d_W, d_b = ([rng.normal(size=a.shape) for a in arrays] for arrays in (weights, biases))
moved = [
    step.forward(
        h + e * d_h,
        [W + e * d for W, d in zip(weights, d_W)],
        [b + e * d for b, d in zip(biases, d_b)],
        Q_0,
    )[0].q
    for e in (1e-6, -1e-6)
]
difference = (q_bar * (moved[0] - moved[1])).sum() / 2e-6
gradient = (bars["h"] * d_h).sum() + sum(
    (g * d).sum()
    for name, ds in (("weights", d_W), ("biases", d_b))
    for g, d in zip(bars[name], ds)
)
assert abs(difference - gradient) < 1e-7 * abs(gradient)
print(f"by differences {difference:.9f}, by gradient {gradient:.9f}")


# %% [markdown]
# ## Break it
# Drop the 2 inside: $q = 2Q_0\,\mathrm{sigmoid}(u)$. It still rises to $2Q_0$, and it is $Q_0$ at $u = 0$. Training makes up for
# it: a last layer twice as large gives the old steps again. But a file that another program wrote gets other steps. The golden
# vectors name the mistake.


# %%
def half_argument(h, weights, biases, Q_0):
    y = mlp.forward(h, weights, biases)[0].y
    return 2 * Q_0 * np.maximum(expit(y), step.FLOOR / 2)


middle = (
    half_argument(np.zeros((1, 1)), [np.zeros((1, 3))], [np.array([0.0, -40, 40])], Q_0[:3])[0]
    / Q_0[:3]
)
assert middle[0] == 1 and middle[1] == step.FLOOR and middle[2] == 2
doubled = half_argument(h, [weights[0], 2 * weights[1]], [biases[0], 2 * biases[1]], Q_0)
assert np.allclose(doubled, out.q, rtol=1e-12)
report = oracle.check(half_argument, "step")
assert not report.ok and "2 psi_q" in report.first.explanation
print(report.first.id, "fails:", report.first.explanation)


# %% [markdown]
# And the printed form under the same floor? `step_floor` are golden vectors for the last line alone, $q$ from $u$. The form
# passes where $u$ is ordinary. Beside the floor they see that digits are missing, though only a few of the many that `float64`
# has; a port in `float32` has none to spare.


# %%
def printed_form(u, Q_0):
    return Q_0 * np.maximum(1 + np.tanh(u), step.FLOOR)


u32 = np.array([-3.8], np.float32)
error = {name: abs(float(form(u32)[0]) / true_share(u32[0]) - 1) for name, form in forms.items()}
assert oracle.check(printed_form, "step_floor").first.id == "step_floor/beside_the_floor"
assert error["$1 + \\tanh u$"] > 10 * error["$2\\,$sigmoid$(2u)$"]
print({name: f"{e:.1e}" for name, e in error.items()})

# %% [markdown]
# ## What a codec does with it
# A video encoder changes its quantisation parameter from block to block and sends it along. Here nothing is sent: decoder and
# encoder both compute $q$ from the grid. Below: the steps of the golden vectors' model, whose numbers were drawn, not trained.

# %%
from p4dgs_ref import decode
from p4dgs_ref.codec.inspect import float_context

model = decode((oracle.path() / "model.p4dgs").read_bytes())
share = float_context(model).q / np.array(model.design.Q_0)
assert (share >= step.FLOOR).all() and (share <= 2).all()
print(
    "steps over Q_0, smallest and largest of each group:",
    {g: f"{a:.3f} to {b:.3f}" for g, a, b in zip("fslO", share.min(axis=0), share.max(axis=0))},
)

# %% [markdown]
# ## Exercises
# **08.1** At which $u$ is the step half of $Q_0$? **08.2** Write Eq. (8) with its floor;
# `out, res = mlp.forward(x, weights, biases)` is yours to use, the network's output is `out.y`. **08.3** Write its backward,
# no slope on the floor; `mlp.backward(res, u_bar)` gives a dictionary of `"x"`, `"weights"` and `"biases"`.

# %%
answer_1 = ...


def my_forward(h, weights, biases, Q_0):
    """h (A, I), psi_q (I -> G), Q_0 (G,) -> q (A, G), not below step.FLOOR * Q_0."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"h" (A, I), "weights", "biases": lists}: gradients, from inputs as above and cotangents["q_bar"] (A, G)."""
    raise NotImplementedError


lessons.number("08.1", answer_1, np.arctanh(-0.5))
lessons.forward("08.2", my_forward, "step")
lessons.backward("08.3", my_backward, "step")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only step`. Begin with the scalar, `--only step_floor`, and mind its gradient: on the floor it
# is 0. A port that clamps the value alone, outside what its framework differentiates, lets the gradient through.


# %%
def port(u, Q_0):
    return 2 * Q_0 * np.maximum(expit(2 * u), step.FLOOR / 2)


def port_vjp(inputs, cotangents):
    s = expit(2 * inputs["u"])
    return {
        "u": 4
        * inputs["Q_0"]
        * s
        * expit(-2 * inputs["u"])
        * (s > step.FLOOR / 2)
        * cotangents["q_bar"]
    }


print(oracle.check(port, "step_floor", port_vjp))
assert oracle.check(port, "step_floor", port_vjp).ok and EQUATIONS["step"].number == "8"
on_floor = port_vjp({"u": np.array([[-4.0]]), "Q_0": np.ones(1)}, {"q_bar": np.array([[3.0]])})["u"]
assert on_floor == 0
