# %% [markdown]
# # Eq. (3): which Gaussians an anchor shows, and the small network that decides
#
# **Promise.** After this you can run a multilayer perceptron backward by hand, and say what a dropped Gaussian still learns.
# **Before it:** `01_offsets`, `02_view`. **Takes** two seconds of machine time on two cores, forty minutes of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS
from p4dgs_ref.equations import masking, mlp, opacity, view
from p4dgs_ref.school import lessons

plt = lessons.pyplot()

# %% [markdown]
# ## Claim
# A network $\psi_\alpha$ makes the opacities of an anchor's $k$ Gaussians from its feature and the view:
# $$\{\alpha_0,\dots,\alpha_{k-1}\} = \psi_\alpha(f_a, \delta_{vc}, d_{vc}) \tag{3}$$
# "Gaussian primitives with opacity values below a threshold ($\alpha < \tau_\alpha$) are excluded from rendering."

# %% [markdown]
# The paper does not print what bounds the opacity. Its parent Scaffold-GS uses $\tanh$, and so does this project (choice `Q4`
# of the README): values lie between $-1$ and $1$, the threshold is $\tau_\alpha = 0$, and the sign decides who is drawn.

# %% [markdown]
# ## By hand
# One anchor, a feature of one number, two hidden units, two children; the weights stand in the code. Feature, distance and
# direction in a row are the input, $(1, 2, 0, 0.6, 0.8)$. The first hidden unit becomes 1.5, the second would be negative and is
# cut to 0: that is the *ReLU*, $\max(0, \cdot)$. The last layer makes $\psi_\alpha$, 0.5 and -1: only the first child is drawn.

# %%
f_a, delta_vc, d_vc = np.array([[1.0]]), np.array([[2.0]]), np.array([[0.0, 0.6, 0.8]])
W_0 = np.array([[1.0, -2], [0.25, 0.5], [3, 1], [0, 1], [0, 0]])  # 5 inputs, 2 hidden units
b_0, W_1, b_1 = np.array([0.0, -1]), np.array([[1.0, -1], [5, 7]]), np.array([-1.0, 0.5])
z = [1 * 1 + 2 * 0.25, 1 * -2 + 2 * 0.5 + 0.6 * 1 - 1]
hidden = [max(z[0], 0), max(z[1], 0)]
psi = [hidden[0] * 1 + hidden[1] * 5 - 1, hidden[0] * -1 + hidden[1] * 7 + 0.5]
assert (
    hidden == [1.5, 0]
    and z[1] < 0
    and psi == [0.5, -1]
    and (np.tanh(psi) >= 0).tolist() == [True, False]
)
print("psi", psi, "alpha", np.tanh(psi).round(4), "drawn:", np.tanh(psi) >= 0)

# %% [markdown]
# ## In code
# A layer is $x W + b$ with samples as rows: `x (N, I)`, `W (I, J)`, `b (J,)`, and a ReLU follows every layer but the last.
# `opacity.forward` sets the columns side by side, runs `mlp.forward` and takes the $\tanh$.

# %%
out, res = opacity.forward(f_a, delta_vc, d_vc, [W_0, W_1], [b_0, b_1])
assert out.alpha.shape == (1, 2) and np.allclose(out.alpha[0], np.tanh([0.5, -1]), rtol=1e-15)
assert res.mlp.inputs[1].tolist() == [hidden]  # what entered the last layer

# %% [markdown]
# Then `masking.forward` turns children of anchors `(A, k)` into one flat list of the `N` that are kept: not below the threshold,
# so equality stays, and true in `mask`, which is false for children that training has dropped for good (choice `Q15`). `index`
# remembers where each came from: $a\,k + j$. Of three, two are kept here.

# %%
attributes = {"x": 3, "color": 3, "s": 3, "r": 4}
three = {name: np.arange(3.0 * width).reshape(1, 3, width) for name, width in attributes.items()}
kept, kept_res = masking.forward(np.array([[0.4, -0.1, 0.0]]), np.ones((1, 3), bool), 0.0, **three)
assert kept.index.tolist() == [0, 2] and kept.alpha.tolist() == [0.4, 0] and kept.x.shape == (2, 3)
assert masking.backward(kept_res, np.array([5.0, 7]))["alpha"].tolist() == [
    [5, 0, 7]
]  # what kept ones get; see below

# %% [markdown]
# The same anchor shows other Gaussians from elsewhere. Here a camera walks around one anchor; the network is random.
# Its curves bend where a ReLU switches, and a child is drawn only while its curve is above the threshold.

# %%
rng = np.random.default_rng(1103)
weights, biases = mlp.random_network(rng, 4 + 4, 16, 16, 4)
weights[0][4:] *= np.array([[0.3], [2], [2], [2]])  # little of the distance, much of the direction
walk = np.radians(np.arange(0, 361))
cameras = np.stack([3 * np.cos(walk), 3 * np.sin(walk), 1 + 0 * walk], axis=1)
seen, _ = view.forward(-cameras, np.zeros(3))  # the anchor stands at the origin
around = opacity.forward(np.tile(rng.normal(size=4), (361, 1)), *seen, weights, biases)[0].alpha
figure, ax = plt.subplots(figsize=(10, 5.2))
for j, curve in enumerate(around.T):
    ax.plot(
        np.degrees(walk),
        np.where(curve >= 0, curve, np.nan),
        color=lessons.COLORS[j],
        lw=3,
        label=f"child {j}",
    )
    ax.plot(np.degrees(walk), curve, color=lessons.COLORS[j], lw=1, ls=":")
ax.axhspan(-1, 0, color="0.92", zorder=0)
ax.text(183, -0.93, r"$\alpha < \tau_\alpha$: not drawn", fontsize=14, ha="center")
ax.set(
    xlabel="direction of the camera (degrees)",
    ylabel=r"opacity $\alpha$",
    ylim=(-1, 1),
    xlim=(0, 360),
)
ax.set_xticks(range(0, 361, 45))
ax.set_title("One anchor, four children: who is drawn depends on where you stand", fontsize=15)
ax.legend(ncols=4, loc="upper center", fontsize=12)
lessons.show(figure, "03_opacity_and_masking")
assert 0 < (around >= 0).mean() < 1 and len({tuple(row) for row in around >= 0}) > 1

# %% [markdown]
# ## Backward by hand
# Back to front: masking, $\tanh$, network. **Masking** copies, $y_n = \alpha_{i(n)}$ with `index` for $i$. So each kept number
# gives its cotangent back to the place it came from, and a dropped one receives zero: to gather is to scatter backward. Where
# $\bar y = (5, 7)$ arrives at the two kept above, $\bar\alpha$ is $(5, 0, 7)$.

# %%
A, k, d = 6, 4, 3
alpha = rng.uniform(-1, 1, (A, k))
given = {name: rng.normal(size=(A, k, width)) for name, width in attributes.items()}
mask = rng.random((A, k)) < 0.8  # children dropped for good (Q15)
kept, kept_res = masking.forward(alpha, mask, 0.0, **given)
kept_bar = rng.normal(size=kept.alpha.shape)
alpha_bar = masking.backward(kept_res, alpha_bar=kept_bar)["alpha"]
by_hand = np.zeros(A * k)
by_hand[kept.index] = kept_bar
assert np.array_equal(alpha_bar, by_hand.reshape(A, k)) and not alpha_bar[(alpha < 0) | ~mask].any()

# %% [markdown]
# **tanh.** The quotient $\sinh/\cosh$ has the slope $(\cosh^2 - \sinh^2)/\cosh^2 = 1 - \tanh^2$, so
# $\bar\psi = (1 - \alpha^2)\,\bar\alpha$. The slopes of our two children are 0.7864 and 0.42. The code has the same number
# without $1 - 1$: $1/\cosh^2\psi = 4/(e^{\psi} + e^{-\psi})^2 = 4e/(1+e)^2$ with $e = \exp(-2|\psi|)$.

# %%
e = np.exp(-2 * np.abs(psi))
slope = 1 - np.tanh(psi) ** 2
assert slope.round(4).tolist() == [0.7864, 0.42] and np.allclose(
    slope, 4 * e / (1 + e) ** 2, rtol=1e-14
)
assert np.allclose(res.slope[0], slope, rtol=1e-14)

# %% [markdown]
# The picture shows why. In single precision $\tanh$ rounds to $1$ at about 9, and there $1 - \alpha^2$ is exactly 0: such
# a child is stuck. The other formula is still right at 40.

# %%
reach = np.linspace(0, 40, 401, dtype=np.float32)
literal = (
    1 - np.tanh(reach.astype(float)).astype(np.float32) ** 2
)  # from the best tanh that single precision has
single = opacity.forward(
    reach[:, None],
    reach[:, None][:, :0],
    reach[:, None][:, :0],
    [np.ones((1, 1), np.float32)],
    [np.zeros(1, np.float32)],
)[1].slope[:, 0]
true = 1 / np.cosh(reach.astype(float)) ** 2
assert (
    abs(reach[literal == 0][0] - 9) < 0.2
    and (literal[reach > 9.1] == 0).all()
    and single.dtype == np.float32
)
assert np.abs(single[-1] / true[-1] - 1) < 1e-5 and reach[-1] == 40
figure, ax = plt.subplots(figsize=(9, 5))
ax.semilogy(reach, true, color="0.75", lw=8, label="exact")
ax.semilogy(reach, single, color=lessons.COLORS[0], label=r"$4e/(1+e)^2$, single precision")
ax.semilogy(
    reach[literal > 0],
    literal[literal > 0],
    color=lessons.COLORS[1],
    label=r"$1 - \alpha^2$, single precision",
)
ax.axvline(reach[literal == 0][0], color=lessons.COLORS[1], ls="--", label="from here on exactly 0")
ax.set(
    xlabel=r"output of the network $\psi_\alpha$",
    ylabel=r"slope $\partial\alpha/\partial\psi_\alpha$",
)
ax.set_title(r"$1 - \alpha^2$ switches the gradient off, $4e/(1+e)^2$ does not", fontsize=15)
ax.legend()
lessons.show(figure, "03_opacity_and_masking_slope")

# %% [markdown]
# **The network**, scalar case: one input, one hidden unit, $z = x w_0 + b_0$, $h = \max(0, z)$ and $y = h w_1 + b_1$. Going back,
# with $[h > 0]$ for one where that is true and zero elsewhere, the slope of the ReLU:
# $$\bar w_1 = h\,\bar y,\quad \bar b_1 = \bar y,\quad \bar h = w_1\bar y,\quad \bar z = [h > 0]\,\bar h,\quad
# \bar w_0 = x\,\bar z,\quad \bar b_0 = \bar z,\quad \bar x = w_0\bar z.$$

# %%
x, w_0, c_0, w_1, y_bar = 2.0, 1.5, -1.0, 3.0, 4.0  # c_0 is the text's b_0
h = max(0, x * w_0 + c_0)
h_bar = w_1 * y_bar
z_bar = (h > 0) * h_bar
scalar = mlp.backward(
    mlp.forward(
        np.array([[x]]), [np.array([[w_0]]), np.array([[w_1]])], [np.array([c_0]), np.zeros(1)]
    )[1],
    np.array([[y_bar]]),
)
assert [g.item() for g in scalar["weights"]] == [x * z_bar, h * y_bar] and scalar[
    "x"
].item() == w_0 * z_bar
assert [g.item() for g in scalar["biases"]] == [z_bar, y_bar] and (h, z_bar) == (2, 12)

# %% [markdown]
# Now shapes. One layer for $N$ rows is $y_{nj} = \sum_i x_{ni}W_{ij} + b_j$, its differential $dy = dx\,W + x\,dW + db$.
# Take the sum of $\bar y_{nj}\,dy_{nj}$ and read off what multiplies each differential:
# $$\bar x = \bar y\,W^T, \qquad \bar W = x^T\bar y, \qquad \bar b_j = \sum_n \bar y_{nj}.$$

# %%
N, I, J = 7, 5, 3
x, W, b, y_bar = (
    rng.normal(size=(N, I)),
    rng.normal(size=(I, J)),
    rng.normal(size=J),
    rng.normal(size=(N, J)),
)
one = mlp.backward(mlp.forward(x, [W], [b])[1], y_bar)
assert np.allclose(
    one["x"],
    [[sum(y_bar[n, j] * W[i, j] for j in range(J)) for i in range(I)] for n in range(N)],
    rtol=1e-12,
)
by_hand = [[sum(x[n, i] * y_bar[n, j] for n in range(N)) for j in range(J)] for i in range(I)]
assert np.allclose(one["weights"][0], by_hand, rtol=1e-12)
assert np.allclose(
    one["biases"][0], [sum(y_bar[n, j] for n in range(N)) for j in range(J)], rtol=1e-12
)

# %% [markdown]
# Shapes leave no choice: from $x$ `(N, I)` and $\bar y$ `(N, J)` only $x^T\bar y$ has the shape of $W$. And as in `01_offsets`,
# what $N$ rows use collects $N$ gradients: $W$ and $b$ sum over rows. Layers chain; here are the four lines of `mlp.backward`.

# %%
weights, biases = mlp.random_network(rng, d + 4, 6, 5, k)
x = rng.normal(size=(A, d + 4))
y, net = mlp.forward(x, weights, biases)
y_bar = rng.normal(size=(A, k))
ours = mlp.backward(net, y_bar)
W_bar, b_bar, bar = [None] * 3, [None] * 3, y_bar
for i in (2, 1, 0):
    W_bar[i] = net.inputs[i].T @ bar  # x^T y_bar
    b_bar[i] = bar.sum(axis=0)  # sum over rows
    bar = bar @ weights[i].T  # y_bar W^T
    bar = (
        bar * (net.inputs[i] > 0) if i else bar
    )  # the ReLU in front of this layer; none before the first
pairs = zip([*W_bar, *b_bar, bar], [*ours["weights"], *ours["biases"], ours["x"]])
assert all(np.allclose(mine, theirs, rtol=1e-12) for mine, theirs in pairs)

# %% [markdown]
# The ReLU needs no memory of its own: $h > 0$ exactly where its input was. At the kink the gradient is zero, by choice.
# **Concatenation** backward is cutting: columns of $\bar x$ go to feature, distance, direction. Eq. (3) against differences:

# %%
inputs = opacity.view_inputs(rng, A=A, d=d, k=k)
out, res = opacity.forward(**inputs)
alpha_bar = rng.normal(size=(A, k))
ours = opacity.backward(res, alpha_bar)
assert np.array_equal(
    mlp.backward(
        mlp.forward(np.zeros((1, 1)), [np.ones((1, 1))] * 2, [np.zeros(1)] * 2)[1], np.ones((1, 1))
    )["x"],
    [[0]],
)  # at the kink


def moved(h):
    """All inputs, weights included, moved by h times their directions."""
    return {
        name: [a + h * e for a, e in zip(value, move[name])]
        if isinstance(value, list)
        else value + h * move[name]
        for name, value in inputs.items()
    }


move = {
    name: [rng.normal(size=a.shape) for a in value]
    if isinstance(value, list)
    else rng.normal(size=value.shape)
    for name, value in inputs.items()
}
up, down = (opacity.forward(**moved(h))[0].alpha for h in (1e-6, -1e-6))
difference, gradient = (
    ((up - down) * alpha_bar).sum() / 2e-6,
    sum((g * e).sum() for n in move for g, e in zip(ours[n], move[n])),
)
assert abs(difference - gradient) < 1e-7 * abs(gradient)
print(f"by differences {difference:.8f}, by gradient {gradient:.8f}")

# %% [markdown]
# What no gradient can see: the threshold. Moving $\tau_\alpha$ changes the list by whole Gaussians, a step without slope; and a
# dropped child hears nothing. Only what others teach the shared network, siblings, anchors, views, can bring it back.

# %%
alone = opacity.backward(res, np.where(np.arange(k) == 1, alpha_bar, 0))  # only child 1 was drawn
last = alone["weights"][-1]
assert (
    last[:, 1].any()
    and not last[:, [0, 2, 3]].any()
    and alone["weights"][0].any()
    and alone["f_a"].any()
)

# %% [markdown]
# ## Break it
# Put the gradients of the kept list into the *first* rows instead of the rows they came from. Shapes are right; so are the
# number of entries, their sum and their norm. Only a comparison place by place sees it.

# %%
packed = np.zeros(A * k)
packed[: len(kept_bar)] = kept_bar
right = masking.backward(kept_res, alpha_bar=kept_bar)["alpha"]
assert np.isclose(packed.sum(), right.sum()) and np.isclose((packed**2).sum(), (right**2).sum())
arrow = rng.normal(size=(A, k)) * 1e-3
change = (
    (masking.forward(alpha + arrow, mask, 0.0, **given)[0].alpha - kept.alpha) * kept_bar
).sum()
assert np.isclose((right * arrow).sum(), change, rtol=1e-9, atol=0)
claimed = (packed.reshape(A, k) * arrow).sum()
assert abs(claimed - change) > 0.1 * abs(change)
print(f"packed: sum and norm agree, but the loss changes by {change:.2e}, not by {claimed:.2e}")

# %% [markdown]
# ## What a codec does with it
# Opacity is never stored: the network is, once, in half precision. Below is after how many anchors that is cheaper than
# one such number for each of their Gaussians, in the paper's sizes.

# %%
d, k, width = 16, 10, 32
count = sum(
    rows * columns + columns for rows, columns in ((d + 4, width), (width, width), (width, k))
)
print(
    f"{count} weights, {2 * count} bytes; opacities one by one {2 * k} bytes an anchor: even at {count / k:.0f} anchors"
)
assert count == sum(
    W.size + b.size for W, b in zip(*mlp.random_network(rng, d + 4, width, width, k))
)

# %% [markdown]
# ## Exercises
# **03.1** A child has $\alpha = 0.6$ and $\bar\alpha = 2$. What is $\bar\psi$? **03.2** Write Eq. (3), network and $\tanh$
# included. **03.3** Write the network's backward for any number of layers; run its forward again for what entered each layer.
# **03.4** Write the backward of masking. A Boolean array as an index, `zeros[keep] = ...`, does the scattering.

# %%
answer_1 = ...


def my_opacity(f_a, delta_vc, d_vc, weights, biases):
    """f_a (A, d), delta_vc (A, 1), d_vc (A, 3), lists of arrays -> alpha (A, k)."""
    raise NotImplementedError


def my_mlp_backward(inputs, cotangents):
    """{"x": array, "weights": list, "biases": list} from inputs of the same names and cotangents["y_bar"] (N, J)."""
    raise NotImplementedError


def my_masking_backward(inputs, cotangents):
    """{"alpha" (A, k), "x" (A, k, 3), "color", "s", "r" (A, k, 4)} from inputs of the same names and shapes, "mask" (A, k) and
    the number "tau_alpha", and from cotangents["alpha_bar"] (N,), ["x_bar"] (N, 3), ["color_bar"], ["s_bar"], ["r_bar"]."""
    raise NotImplementedError


lessons.number(
    "03.1",
    answer_1,
    opacity.forward(
        np.array([[np.arctanh(0.6)]]),
        np.zeros((1, 0)),
        np.zeros((1, 0)),
        [np.eye(1)],
        [np.zeros(1)],
    )[1].slope[0, 0]
    * 2,
)
lessons.forward("03.2", my_opacity, "opacity")
lessons.backward("03.3", my_mlp_backward, "mlp")
lessons.backward("03.4", my_masking_backward, "masking")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only opacity`, and the same with `masking` and `mlp`. Scaffold-GS keeps
# $\alpha > \tau_\alpha$, the paper $\alpha \ge \tau_\alpha$: on random inputs both agree. A golden case stands on the threshold.

# %%
from p4dgs_ref import oracle

for key, module in (("opacity", opacity), ("masking", masking), ("mlp", mlp)):
    print(oracle.check(lambda module=module, **given: module.forward(**given)[0], key))
    assert oracle.check(lambda module=module, **given: module.forward(**given)[0], key).ok
strict = lambda tau_alpha, **given: masking.forward(
    tau_alpha=np.nextafter(tau_alpha, np.inf), **given
)[0]
report = oracle.check(strict, "masking")
assert (
    report.first.id == "masking/at_the_threshold"
    and "alpha > tau_alpha" in report.first.explanation
)
print(report.first.id, "|", report.first.explanation)
assert EQUATIONS["opacity"].number == "3"
