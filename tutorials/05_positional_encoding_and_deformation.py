# %% [markdown]
# # Eq. (5): how far every Gaussian has moved at time t
#
# **Promise.** After this you can encode a number in waves, derive the gradient of that, and say why the pipeline does not use it.
# **Before it:** `01_offsets`, `03_opacity_and_masking`. **Takes** two seconds of machine time on two cores, forty minutes of
# yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS, PRESETS
from p4dgs_ref.equations import deformation, deformed, mlp, positional_encoding
from p4dgs_ref.school import lessons
from p4dgs_ref.training.initial import design_of

plt = lessons.pyplot()
rng = np.random.default_rng(5)

# %% [markdown]
# ## Claim
# One network $\psi_d$, the *deformation field*, moves, stretches and turns all Gaussians of the canonical space:
# $$(\Delta x, \Delta s, \Delta r) = \psi_d(\mathrm{concat}(\mathcal{E}(x), \mathcal{E}(t))) \tag{5}$$
# $x$ is where a Gaussian stands without time, $t$ the time, $\mathcal{E}$ the positional encoding.

# %% [markdown]
# The paper does not print $\mathcal{E}$. Its parent `D3DGS` has the number, then waves of $L$ doubling frequencies, without
# $\pi$:
# $$\mathcal{E}(p) = (p, \sin 2^0 p, \cos 2^0 p, \dots, \sin 2^{L-1} p, \cos 2^{L-1} p)$$

# %% [markdown]
# ## By hand
# With $L = 2$ the number $\pi/2$ becomes five: itself, sine and cosine of $\pi/2$, sine and cosine of $\pi$.
# The waves are 1, 0, 0 and -1.

# %%
p = np.pi / 2
by_hand = [p, np.sin(p), np.cos(p), np.sin(2 * p), np.cos(2 * p)]
assert np.allclose(by_hand[1:], [1, 0, 0, -1], atol=1e-15)

# %% [markdown]
# And a field by hand: no hidden layer, one frequency of time, none of place. Of all weights only one is not zero: the one from
# $\sin t$ to $\Delta x$'s first axis, 0.5. Every Gaussian then swings along x; at $t = \pi/2$ it stands 0.5 away, unstretched,
# unturned.

# %%
columns = 3 * (1 + 2 * 0) + 1 + 2 * 1  # E(x) with L_x = 0, E(t) with L_t = 1
heads = [np.zeros((columns, width)) for width in (3, 3, 4)]
heads[0][columns - 2, 0] = 0.5  # the last two columns are sin t, cos t
biases = [np.zeros(width) for width in (3, 3, 4)]
swing = deformation.forward(rng.normal(size=(2, 3)), np.pi / 2, heads, biases, L_x=0, L_t=1)[0]
assert (
    np.allclose(swing.delta_x, [[0.5, 0, 0]] * 2)
    and not swing.delta_s.any()
    and not swing.delta_r.any()
)

# %% [markdown]
# ## In code
# For vectors `p (N, D)` the columns are: all `D` raw numbers, then per frequency all sines, then all cosines. That makes
# `D (1 + 2 L)`. $\psi_d$ ends in three last layers side by side, its *heads*, of widths 3, 3 and 4. With $L_x = 10$ for places
# and $L_t = 6$ for times (choice `Q2`; the paper prints neither) it reads 63 and 13 columns.

# %%
x = rng.uniform(-1.3, 1.3, (4, 3))
E = positional_encoding.forward(x, 2)[0].E
assert np.array_equal(
    E, np.concatenate([x, np.sin(x), np.cos(x), np.sin(2 * x), np.cos(2 * x)], axis=1)
)
paper = PRESETS["paper_synthetic"]
assert (
    (paper.L_x, paper.L_t) == (10, 6) and 3 * (1 + 2 * paper.L_x) == 63 and 1 + 2 * paper.L_t == 13
)
assert [
    W[1] for W in design_of(paper, ("translation", "scaling", "rotation")).layers()["psi_d"][-3:]
] == [3, 3, 4]

# %% [markdown]
# All Gaussians of a picture share $t$. So what the first layer makes of $\mathcal{E}(t)$ is the same for every row, and the code
# computes it once, as a bias: $[\mathcal{E}(x), \mathcal{E}(t)]\,W = \mathcal{E}(x)\,W_x + \mathcal{E}(t)\,W_t$.

# %%
t, field = 0.3, deformation.random_field(rng, 2, 1, 6, 5)
out, res = deformation.forward(x, t, **field)
E_t = positional_encoding.forward(np.array([[t]]), 1)[0].E
rows = np.concatenate([E, np.repeat(E_t, 4, axis=0)], axis=1)  # what Eq. (5) prints
W, b = field["weights"], field["biases"]
printed = mlp.forward(
    rows, [*W[:-3], np.concatenate(W[-3:], axis=1)], [*b[:-3], np.concatenate(b[-3:])]
)[0].y
assert np.allclose(np.concatenate(out, axis=1), printed, rtol=1e-12)

# %% [markdown]
# What the waves are for: fit a motion that bounces, by least squares on the numbers of $\mathcal{E}(t)$ and a constant. The raw
# number alone gives a straight line. Slow waves miss the bounces, faster waves come closer, and even they round the corners off.

# %%
time = np.linspace(0, 1, 400)
height = np.abs(np.cos(3 * np.pi * time))
figure, axes = plt.subplots(1, 2, figsize=(12.5, 5), layout="constrained", width_ratios=(1, 1.35))
waves = positional_encoding.forward(time[:, None], 6)[0].E
picture = axes[0].imshow(
    waves.T, aspect="auto", cmap="cividis", extent=(0, 1, 12.5, -0.5), interpolation="nearest"
)
axes[0].set(
    xlabel="time $t$", yticks=range(13), title=r"The 13 numbers of $\mathcal{E}(t)$, $L_t = 6$"
)
axes[0].set_yticklabels(
    ["$t$"] + [rf"$\{f}\,{2**j}t$" for j in range(6) for f in ("sin", "cos")], fontsize=10
)
axes[0].grid(False)
figure.colorbar(picture, ax=axes[0], label="value")
axes[1].plot(time, height, color="0.75", lw=9, label="a bouncing motion")
misses = {}
for L, color in zip((0, 2, 4, 6), lessons.COLORS):
    basis = np.concatenate(
        [np.ones((400, 1)), positional_encoding.forward(time[:, None], L)[0].E], axis=1
    )
    fit = basis @ np.linalg.lstsq(basis, height, rcond=None)[0]
    misses[L] = np.sqrt(((fit - height) ** 2).mean())
    axes[1].plot(time, fit, color=color, label=f"$L_t = {L}$, misses by {misses[L]:.3f} (rms)")
axes[1].set(
    xlabel="time $t$",
    ylabel="height (scene units)",
    title="More waves follow sharper motion",
    ylim=(-0.1, 1.75),
)
axes[1].legend(loc="upper center", fontsize=11)
lessons.show(figure, "05_positional_encoding_and_deformation")
assert misses[0] > misses[2] > misses[4] > misses[6]

# %% [markdown]
# ## Backward by hand
# **The encoding.** One number, one frequency: $s = \sin 2^j p$ and $c = \cos 2^j p$, so $ds = 2^j c\,dp$ and
# $dc = -2^j s\,dp$. The number is used $1 + 2L$ times, so it collects as many gradients:
# $$\bar p = \bar p_{raw} + \sum_{j=0}^{L-1} 2^j\,(c_j\,\bar s_j - s_j\,\bar c_j)$$

# %%
p, L = 0.7, 3
E, encoding_res = positional_encoding.forward(np.array([[p]]), L)
E_bar = rng.normal(size=(1, 1 + 2 * L))
terms = [E_bar[0, 0]]
for j in range(L):
    s_bar, c_bar = E_bar[0, 1 + 2 * j : 3 + 2 * j]
    terms.append(2**j * (np.cos(2**j * p) * s_bar - np.sin(2**j * p) * c_bar))
assert len(terms) == 1 + L and np.isclose(
    positional_encoding.backward(encoding_res, E_bar)["p"].item(), sum(terms), rtol=1e-12
)
h = 1e-6
up, down = (positional_encoding.forward(np.array([[p + s * h]]), L)[0].E for s in (1, -1))
assert np.isclose(((up - down) * E_bar).sum() / (2 * h), sum(terms), rtol=1e-7)

# %% [markdown]
# Nothing but $\mathcal{E}$ itself must be remembered: the derivative of each sine is the cosine beside it. For vectors the
# columns are seen as `(N, L, 2, D)`: frequency, sine or cosine, axis. In the code `slopes` is the bracket and `tensordot` the
# sum with $2^j$.

# %%
N, D, L = 5, 3, 4
x = rng.normal(size=(N, D))
E, encoding_res = positional_encoding.forward(x, L)
E_bar = rng.normal(size=E.E.shape)
s, c = E.E[:, D:].reshape(N, L, 2, D).swapaxes(0, 2)  # each (L, N, D)
s_bar, c_bar = E_bar[:, D:].reshape(N, L, 2, D).swapaxes(0, 2)
assert np.array_equal(s[2], np.sin(4 * x)) and np.array_equal(c[3], np.cos(8 * x))
by_hand = E_bar[:, :D] + sum(2**j * (c[j] * s_bar[j] - s[j] * c_bar[j]) for j in range(L))
assert np.allclose(
    positional_encoding.backward(encoding_res, E_bar)["p"], by_hand, rtol=1e-12, atol=1e-13
)

# %% [markdown]
# **The field** is the network of `03_opacity_and_masking`; two things are new. Three heads on one trunk are one last layer with
# three groups of columns: their cotangents stand side by side, the gradients are cut apart. And all $N$ rows sent the same
# $\mathcal{E}(t)$ into the first layer. With $y_n$ for what that layer makes of row $n$, before its ReLU:
# $\bar W_t = \mathcal{E}(t)^T \sum_n \bar y_n = \mathcal{E}(t)^T\,\bar b$, an outer product.

# %%
x = rng.uniform(-1.3, 1.3, (N, 3))
out, res = deformation.forward(x, t, **field)
bars = dict(
    delta_x_bar=rng.normal(size=(N, 3)),
    delta_s_bar=rng.normal(size=(N, 3)),
    delta_r_bar=rng.normal(size=(N, 4)),
)
ours = deformation.backward(res, **bars)
E_x, E_x_res = positional_encoding.forward(x, field["L_x"])
rows = np.concatenate([E_x.E, np.repeat(E_t, N, axis=0)], axis=1)
_, net = mlp.forward(
    rows, [*W[:-3], np.concatenate(W[-3:], axis=1)], [*b[:-3], np.concatenate(b[-3:])]
)
printed = mlp.backward(net, np.concatenate(list(bars.values()), axis=1))
assert np.allclose(
    ours["weights"][0], printed["weights"][0], rtol=1e-11, atol=1e-13
)  # all rows of the first layer
assert np.allclose(
    ours["weights"][0][-3:], np.outer(E_t, ours["biases"][0]), rtol=1e-11
)  # those that read E(t)
assert np.allclose(
    ours["weights"][-1], printed["weights"][-1][:, 6:], rtol=1e-11, atol=1e-13
)  # the third head
through = positional_encoding.backward(E_x_res, printed["x"][:, : E_x.E.shape[1]])["p"]
assert np.allclose(ours["x"], through, rtol=1e-11, atol=1e-12)

# %% [markdown]
# **Where the pipeline stops (`Q10`).** The equation has the gradient of $x$ just computed. The pipeline, like `D3DGS`, does
# not ask for it: with `needs_x=False` the way from $\mathcal{E}(x)$ back to $x$ is closed. $x$ still learns through
# $x' = x + \Delta x$, with slope one.


# %%
def moved(x, seen):
    """x' of the pipeline: x moves by what the field says at `seen`."""
    delta = deformation.forward(seen, t, **field)[0]
    return deformed.forward(x, np.ones((N, 3)), np.eye(4)[[0] * N], *delta)[0].x_t


arrow, x_t_bar = rng.normal(size=(N, 3)), rng.normal(size=(N, 3))
closed = deformation.backward(deformation.forward(x, t, **field)[1], x_t_bar, needs_x=False)
opened = deformation.backward(deformation.forward(x, t, **field)[1], x_t_bar)["x"]
assert "x" not in closed
frozen = ((moved(x + h * arrow, x) - moved(x - h * arrow, x)) * x_t_bar).sum() / (2 * h)
full = (
    (moved(x + h * arrow, x + h * arrow) - moved(x - h * arrow, x - h * arrow)) * x_t_bar
).sum() / (2 * h)
assert np.isclose(frozen, (x_t_bar * arrow).sum(), rtol=1e-7)  # what the pipeline uses
assert np.isclose(full, ((x_t_bar + opened) * arrow).sum(), rtol=1e-6)  # the whole truth

# %% [markdown]
# What the open way would do: each wave sends its gradient multiplied by $2^j$. Below: a field of random weights with ten
# frequencies, and how strong the gradient of $x$ is that comes back through each. The fastest wave decides the sum, and its slope
# changes sign every $\pi/2^9$.

# %%
L_x, N = 10, 400
wide = deformation.random_field(rng, L_x, 6, 64, 64)
x = rng.uniform(-1.3, 1.3, (N, 3))
x_t_bar = rng.normal(size=(N, 3))
res = deformation.forward(x, t, **wide)[1]
in_bar = mlp.backward(res.mlp, np.concatenate([x_t_bar, np.zeros((N, 7))], axis=1))["x"]
s, c = res.E_x.E[:, 3:].reshape(N, L_x, 2, 3).swapaxes(0, 2)
s_bar, c_bar = in_bar[:, 3:].reshape(N, L_x, 2, 3).swapaxes(0, 2)
parts = 2.0 ** np.arange(L_x)[:, None, None] * (c * s_bar - s * c_bar)
back = deformation.backward(res, x_t_bar)["x"]
assert np.allclose(in_bar[:, :3] + parts.sum(axis=0), back, rtol=1e-9, atol=1e-9)
strength = np.sqrt((parts**2).mean(axis=(1, 2)))
direct = np.sqrt((x_t_bar**2).mean())
figure, ax = plt.subplots(figsize=(9, 5))
ax.bar(
    range(L_x),
    strength,
    color=lessons.COLORS[1],
    label=r"through wave $j$ of $\mathcal{E}(x)$: closed by Q10",
)
ax.axhline(direct, color=lessons.COLORS[0], label=r"through $x' = x + \Delta x$: used")
ax.set(
    yscale="log",
    xlabel="wave $j$ (frequency $2^j$)",
    ylabel=r"rms of its part of $\bar x$",
    xticks=range(L_x),
)
ax.set_title("Random weights: the fastest wave would decide where a Gaussian goes", fontsize=14)
ax.legend()
lessons.show(figure, "05_positional_encoding_and_deformation_gradient")
assert strength.argmax() == L_x - 1 and strength[-1] > direct
print(f"rms through all waves {np.sqrt((back**2).mean()):.1f}, direct {direct:.2f}")

# %% [markdown]
# ## Break it
# Forget the factor $2^j$ in the backward of $\mathcal{E}$. The forward is right, shapes are right, the first wave is right.
# And since the pipeline never asks for this gradient, no training run can notice. The adjoint identity of the equation does.

# %%
E, encoding_res = positional_encoding.forward(x, L_x)
E_bar = rng.normal(size=E.E.shape)
s_bar, c_bar = E_bar[:, 3:].reshape(N, L_x, 2, 3).swapaxes(0, 2)
broken = E_bar[:, :3] + (c * s_bar - s * c_bar).sum(axis=0)
right = positional_encoding.backward(encoding_res, E_bar)["p"]
arrow = rng.normal(size=x.shape)
up, down = (positional_encoding.forward(x + s * h * arrow, L_x)[0].E for s in (1, -1))
difference = ((up - down) * E_bar).sum() / (2 * h)
assert abs((right * arrow).sum() - difference) < 1e-4 * abs(difference)
assert abs((broken * arrow).sum() - difference) > 0.5 * abs(difference)
print(
    f"by differences {difference:.2f}, right {(right * arrow).sum():.2f}, without the factor {(broken * arrow).sum():.2f}"
)

# %% [markdown]
# ## What a codec does with it
# $\psi_d$ is the scene's motion vectors, and the file carries it once, in half precision, whatever the number of Gaussians, the
# number of times or the rate. As the appendix describes it that is 53770 numbers. The paper's table has 0.241 MB: the two do
# not agree (`Q1`). It is the largest of the parts that do not shrink with the rate: 0.241 of the low-rate file's 0.506 MB.

# %%
layers = design_of(paper, ("translation", "scaling", "rotation")).layers()["psi_d"]
count = sum(rows * columns + columns for rows, columns in layers)
assert count == 53770 and 0.241 / 0.506 > 0.47 and abs(2 * count / 2**20 - 0.241) > 0.1
print(
    f"{count} numbers, {2 * count} bytes; ten numbers for each of 20,000 Gaussians at 100 times: {2 * 10 * 20_000 * 100} bytes"
)

# %% [markdown]
# ## Exercises
# **05.1** $\mathcal{E}(p) = (p, \sin p, \cos p, \sin 2p, \cos 2p)$ at $p = 0$, all cotangents are one. What is $\bar p$?
# **05.2** Write the backward of $\mathcal{E}$ for vectors. **05.3** Write Eq. (5), as printed: every row with a copy of
# $\mathcal{E}(t)$, a ReLU after every layer before the heads, and then each head for itself.

# %%
answer_1 = ...


def my_encoding_backward(inputs, cotangents):
    """{"p": (N, D)} from inputs "p" (N, D), "L" and cotangents["E_bar"] (N, D (1 + 2 L))."""
    raise NotImplementedError


def my_deformation(x, t, weights, biases, L_x, L_t):
    """x (N, 3), t a number, weights and biases [trunk ..., head x, head s, head r] -> delta_x (N, 3), delta_s (N, 3),
    delta_r (N, 4). There may be no trunk, and a head may have no columns: then its delta is (N, 0)."""
    raise NotImplementedError


_, res = positional_encoding.forward(np.zeros((1, 1)), 2)
lessons.number("05.1", answer_1, positional_encoding.backward(res, np.ones((1, 5)))["p"][0, 0])
lessons.backward("05.2", my_encoding_backward, "positional_encoding")
lessons.forward("05.3", my_deformation, "deformation")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only deformation`, and the same with `positional_encoding`. The usual slip is another order of
# the columns, say sine and cosine in turn. A port that trains its own weights cannot notice: it is the same network with the
# rows of its first weight permuted. Read a file of this project with it, and everything moves elsewhere.

# %%
from p4dgs_ref import oracle

for key, module in (("positional_encoding", positional_encoding), ("deformation", deformation)):
    print(key, oracle.check(lambda module=module, **given: module.forward(**given)[0], key))
    assert oracle.check(lambda module=module, **given: module.forward(**given)[0], key).ok


def interleaved(p, L):
    raw, waves = np.split(positional_encoding.forward(p, L)[0].E, [p.shape[1]], axis=1)
    waves = waves.reshape(len(p), L, 2, p.shape[1]).swapaxes(2, 3)
    return np.concatenate([raw, waves.reshape(len(p), 2 * L * p.shape[1])], axis=1)


report = oracle.check(interleaved, "positional_encoding")
assert "sin x, cos x, sin y" in report.first.explanation
print(report.first.explanation)
assert EQUATIONS["deformation"].number == "5"
