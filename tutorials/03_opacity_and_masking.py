# %% [markdown]
# # Eq. (3): which Gaussians an anchor shows, and the small network that decides it
#
# **Promise.** After this tutorial you can run a multilayer perceptron backward by hand, and explain
# how a Gaussian that is not drawn can come back. **Before it:** `01_offsets`, `02_view`. **Takes**
# four seconds of machine time on two cores, 30 minutes of reading and 35 of exercises.
#
# **Files:** Eq. (3) [opacity.py](../p4dgs_ref/equations/opacity.py),
# [masking.py](../p4dgs_ref/equations/masking.py), [mlp.py](../p4dgs_ref/equations/mlp.py),
# [anchor_network.py](../p4dgs_ref/equations/anchor_network.py).

# %%
from dataclasses import replace

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, panels, show, tour

plt = figures.pyplot()
architecture.show("03_opacity_and_masking")
rng = np.random.default_rng(1103)

# %% [markdown]
# ## What fails without it
# Every anchor has $k$ children, whether its place needs one or four. Some children are therefore
# superfluous, and others should be half transparent. The right picture draws all of them opaque:
# there are flecks on the balls, and bright beams at the edges of the slab.

# %%
from p4dgs_ref.scenes import simulator

model, thread = tour.MODEL, figures.THREAD
camera = simulator.camera_at(tour.SCENE, *np.radians((60, 26)))
whole = model.anchors._replace(mask=np.ones_like(model.anchors.mask))
weights, biases = model.networks["psi_alpha"]
always_one = weights, [*biases[:-1], biases[-1] + 20]  # tanh of it is 1
opaque = replace(model, anchors=whole, networks={**model.networks, "psi_alpha": always_one})

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 5), layout="constrained")
for ax, (title, shown) in zip(axes, (("the trained scene", model), ("all opaque", opaque))):
    show.picture(ax, show.frame(shown, camera, 0.3), camera, title=title, **tour.VIEW)
figures.show(figure, "03_opacity_and_masking_cloud")

# %% [markdown]
# ## Claim
# A network $\psi_\alpha$ computes the opacities of an anchor's $k$ Gaussians from its feature, its
# distance and its direction:
# $$\{\alpha_0,\dots,\alpha_{k-1}\} = \psi_\alpha(f_a, \delta_{vc}, d_{vc}) \tag{3}$$
# "Gaussian primitives with opacity values below a threshold ($\alpha < \tau_\alpha$) are excluded
# from rendering."
#
# The paper does not say which function bounds the opacity. Scaffold-GS, on which the paper builds,
# uses $\tanh$, and so does this project (choice `Q4` in `reference.md`). Opacities therefore lie
# between $-1$ and $1$. With the threshold $\tau_\alpha = 0$, the sign of $\alpha$ decides whether a
# Gaussian is drawn.

# %% [markdown]
# ## By hand
# Take one anchor with a feature of one number, a network with two hidden units, and two children.
# The input is a row with the feature, the distance and the direction, here $(1, 2, 0, 0.6, 0.8)$.
# With the weights of the next cell, the hidden units have the values 1.5 and $-1.4$. A *ReLU*,
# which is $\max(0, \cdot)$, replaces the second one by 0. The last layer then gives
# $\psi_\alpha = (0.5, -1)$. Since $\tanh$ keeps the sign, only the first child is drawn.

# %%
f_a = np.array([[1.0]])
delta_vc = np.array([[2.0]])
d_vc = np.array([[0.0, 0.6, 0.8]])
W_0 = np.array([[1.0, -2], [0.25, 0.5], [3, 1], [0, 1], [0, 0]])  # 5 inputs, 2 hidden units
b_0 = np.array([0.0, -1])
W_1 = np.array([[1.0, -1], [5, 7]])
b_1 = np.array([-1.0, 0.5])

z = [1 * 1 + 2 * 0.25, 1 * -2 + 2 * 0.5 + 0.6 * 1 - 1]
hidden = [max(z[0], 0), max(z[1], 0)]
psi = [hidden[0] * 1 + hidden[1] * 5 - 1, hidden[0] * -1 + hidden[1] * 7 + 0.5]
print("hidden units", hidden, "| psi", psi, "| alpha", np.tanh(psi).round(4))

# %% [markdown]
# ## In code
# One layer is $x W + b$ with weights $W$ and biases $b$, where each row of $x$ is one sample: `x
# [N, I]`, `W [I, J]`, `b [J]`. A ReLU follows every layer except the last. `opacity.forward` puts
# the three inputs side by side, applies this network with `mlp.forward`, and takes the $\tanh$.

# %%
from p4dgs_ref.equations import masking, mlp, opacity
from p4dgs_ref.lessons import close, inner, random_like

# paper, Sec. 3.2: psi_alpha sees the feature, the distance and the direction
# silent: Q3, its layers, and Q4, what bounds the opacity
alpha, saved = opacity.forward(f_a, delta_vc, d_vc, [W_0, W_1], [b_0, b_1])
assert close(alpha, [np.tanh(psi)])

# %% [markdown]
# `masking.forward` then turns the children of all anchors, `[A, k]`, into one list of the $N$
# Gaussians that are drawn. It keeps a child if its opacity is at least the threshold and its entry
# in `mask` is true. Training sets this entry to false for children that it has removed for good
# (choice `Q15`). The output `index` records where each Gaussian came from, as $a\,k + j$. Of the
# three children below, the second one is dropped, and the third one is kept because its opacity
# equals the threshold.

# %%
WIDTHS = {"x": 3, "s": 3, "r": 4, "color": 3}
three = {name: np.arange(3.0 * width).reshape(1, 3, width) for name, width in WIDTHS.items()}
all_three = np.ones((1, 3), bool)
opacities = np.array([[0.4, -0.1, 0.0]])
kept, _ = masking.forward(**three, alpha=opacities, mask=all_three, tau_alpha=0.0)
kept_alpha, kept_x, kept_color, kept_s, kept_r, index = kept
assert index.tolist() == [0, 2]
assert kept_alpha.tolist() == [0.4, 0]
assert np.array_equal(kept_x, three["x"][0, [0, 2]])

# %% [markdown]
# Now consider anchor 29 of the trained scene. The network gives its child 0 the opacity $-0.03$, so
# the threshold drops it. This child was also so faint for so long in training that it has been
# masked for good. Of all 796 children of the scene, 36 are masked. Since then the network has
# changed, and the opacities of masked children no longer matter to it: 18 of them are now below the
# threshold, 13 are within 0.1 of it, and 3 would be nearly opaque. In the paper, $\psi_\alpha$ sees
# the camera, so an anchor may show other children to other cameras. In the demo's scene only colour
# depends on the view, and opacities are the same from all sides.

# %%
everyone = replace(model, anchors=whole, design=replace(model.design, tau_alpha=-1.0))
gaussians = everyone.gaussians(0.3, camera)
masked = ~model.anchors.mask.ravel()
own = np.flatnonzero(gaussians.index // model.design.k == thread.index)
splats = show.splats(gaussians, camera, own)
alphas = gaussians.alpha[own]
assert alphas[0] < 0 < alphas[1:].min()
assert masked[own].tolist() == [True, False, False, False]
now = gaussians.alpha[masked]
assert [len(now), sum(now < 0), sum(abs(now) < 0.1), sum(now > 0.98)] == [36, 18, 13, 3]
print(
    "opacities of anchor 29:",
    alphas.round(2),
    "| of all children below 0:",
    sum(gaussians.alpha < 0),
)

# %%
panels.opacities(model, camera, splats, alphas, gaussians.alpha[~masked], now)

# %% [markdown]
# ## Backward by hand
# We go backwards: first masking, then $\tanh$, then the network.
#
# **Masking** copies numbers: Gaussian $n$ of the list gets $y_n = \alpha_{i(n)}$, where $i(n)$ is
# `index`. The cotangent of each kept number therefore goes back to the place where the number came
# from, and a dropped number receives zero. In other words, the backward of gathering is scattering.

# %%
A, k, d = 6, 4, 3
opacities = rng.uniform(-1, 1, (A, k))
mask = rng.random((A, k)) < 0.8
given = {name: rng.normal(size=(A, k, width)) for name, width in WIDTHS.items()}
kept, masking_saved = masking.forward(**given, alpha=opacities, mask=mask, tau_alpha=0.0)
*attributes, index = kept  # index holds integers and has no cotangent
kept_bars = random_like(rng, attributes)
alpha_bar = masking.backward(masking_saved, *kept_bars)["alpha"]

by_hand = np.zeros(A * k)
by_hand[index] = kept_bars[0]
assert np.array_equal(alpha_bar, by_hand.reshape(A, k))
assert not alpha_bar[(opacities < 0) | ~mask].any()

# %% [markdown]
# **tanh.** The quotient $\sinh/\cosh$ has the slope $(\cosh^2 - \sinh^2)/\cosh^2 = 1 - \tanh^2$, so
# $\bar\psi = (1 - \alpha^2)\,\bar\alpha$.

# %%
slopes = [1 - np.tanh(0.5) ** 2, 1 - np.tanh(-1) ** 2]
last_bias_bar = opacity.backward(saved, np.ones((1, 2)))["biases"][-1]
assert close(last_bias_bar, slopes)

# %% [markdown]
# **The network**, first with numbers: one input, one hidden unit and one output, $z = x w_0 + b_0$,
# $x_1 = \max(0, z)$ and $y = x_1 w_1 + b_1$. The ReLU has the slope 1 where $x_1 > 0$ and 0
# elsewhere, which we write as $[x_1 > 0]$. Going backward,
# $$\bar w_1 = x_1\,\bar y,\quad \bar b_1 = \bar y,\quad \bar x_1 = w_1\bar y,\quad
# \bar z = [x_1 > 0]\,\bar x_1,\quad
# \bar w_0 = x\,\bar z,\quad \bar b_0 = \bar z,\quad \bar x = w_0\bar z.$$
# For $x = 2$, $w_0 = 1.5$, $b_0 = -1$, $w_1 = 3$ and $\bar y = 4$ we get $x_1 = 2$ and $\bar z =
# 12$, so the weights receive 24 and 8, and the input receives 18.

# %%
one_by_one = [np.array([[1.5]]), np.array([[3.0]])]
_, net = mlp.forward(np.array([[2.0]]), one_by_one, [np.array([-1.0]), np.zeros(1)])
gradients = mlp.backward(net, np.array([[4.0]]))
assert gradients["weights"] == [24, 8]
assert gradients["biases"] == [12, 4]
assert gradients["x"] == 18

# %% [markdown]
# Now the arrays. One layer for $N$ rows is $y_{nj} = \sum_i x_{ni}W_{ij} + b_j$, and its
# differential is $dy = dx\,W + x\,dW + db$. To find the gradients, write the sum of
# $\bar y_{nj}\,dy_{nj}$ and read off the factor of each differential:
# $$\bar x = \bar y\,W^T, \qquad \bar W = x^T\bar y, \qquad \bar b_j = \sum_n \bar y_{nj}.$$
# The shapes help to remember these formulas: of all products of $x$ `[N, I]` and $\bar y$ `[N, J]`,
# only $x^T\bar y$ has the shape of $W$. As in `01_offsets`, a parameter that all $N$ rows use
# receives $N$ gradients, so the gradients of $W$ and $b$ are sums over the rows. For several
# layers, the cotangent of one layer's input becomes that of the output of the layer before it,
# after passing the ReLU. The loop below is all of `mlp.backward`.

# %%
from p4dgs_ref.lab.random_inputs import random_anchor_network, random_network

weights, biases = random_network(rng, d + 4, 6, 5, k)
x = rng.normal(size=(A, d + 4))
y_bar = rng.normal(size=(A, k))
_, net = mlp.forward(x, weights, biases)
ours = mlp.backward(net, y_bar)

inputs_of_layers = [x]
for W, b in zip(weights[:-1], biases[:-1]):
    inputs_of_layers.append(np.maximum(inputs_of_layers[-1] @ W + b, 0))
bar = y_bar
for i in (2, 1, 0):
    assert close(ours["weights"][i], inputs_of_layers[i].T @ bar)
    assert close(ours["biases"][i], bar.sum(axis=0))
    bar = bar @ weights[i].T
    if i > 0:
        bar = bar * (inputs_of_layers[i] > 0)  # the ReLU in front of layer i
assert close(ours["x"], bar)

# %% [markdown]
# The ReLU does not need to save its input, because $x_1 > 0$ exactly where its input was positive.
# At its kink we choose the gradient zero.

# %%
_, at_the_kink = mlp.forward(np.zeros((1, 1)), [np.ones((1, 1))] * 2, [np.zeros(1)] * 2)
assert mlp.backward(at_the_kink, np.ones((1, 1)))["x"] == 0

# %% [markdown]
# Finally, the backward of concatenating columns is splitting them: the columns of $\bar x$ go to
# the feature, the distance and the direction. The next cell checks Eq. (3) by finite differences,
# with all inputs and weights moving at once:

# %%
inputs = random_anchor_network(rng, A=A, d=d, k=k)
_, saved = opacity.forward(**inputs)
cotangent = rng.normal(size=(A, k))
ours = opacity.backward(saved, cotangent)
_ = lessons.adjoint(rng, opacity.forward, inputs, cotangent, ours)

# %% [markdown]
# The threshold itself has no gradient. Moving $\tau_\alpha$ adds or removes whole Gaussians, and a
# Gaussian that is not drawn receives the gradient zero. It can come back only because the network
# is shared: what the network learns from other children, other anchors and other views also changes
# the opacity of this Gaussian. In the next cell only child 1 of each anchor is drawn. Its gradient
# reaches the first layer and the feature, which all children share, but not the columns of the last
# layer that belong to other children.

# %%
only_child_1 = np.where(np.arange(k) == 1, cotangent, 0)
alone = opacity.backward(saved, only_child_1)
last_layer = alone["weights"][-1]
assert last_layer[:, 1].any()
assert not last_layer[:, [0, 2, 3]].any()
assert alone["weights"][0].any()
assert alone["f_a"].any()

# %% [markdown]
# ## Break it
# Suppose the backward of masking writes the gradients of the kept Gaussians into the *first* rows
# instead of the rows they came from. The shape is right, and so are the number of nonzero entries,
# their sum and their norm. Only a comparison of single entries shows the mistake, and the adjoint
# identity makes such a comparison.

# %%
right = alpha_bar
packed = np.zeros(A * k)
packed[: len(index)] = kept_bars[0]
assert close(packed.sum(), right.sum())
assert close(np.linalg.norm(packed), np.linalg.norm(right))

step = 1e-6 * rng.normal(size=(A, k))
stepped, _ = masking.forward(**given, alpha=opacities + step, mask=mask, tau_alpha=0.0)
change = inner(kept_bars[0], stepped[0] - kept[0])
claimed = inner(packed.reshape(A, k), step)
assert close(inner(right, step), change, 1e-6)
assert abs(claimed - change) > 0.1 * abs(change)
print(f"the loss changes by {change:.2e}; packed into the first rows, it would be {claimed:.2e}")

# %% [markdown]
# ## What a codec does with it
# The file does not contain the opacities. It contains the network, once, in half precision. The
# next cell counts the network's weights for the paper's sizes, and compares them with the
# alternative: one opacity in half precision for each Gaussian. The network takes fewer bytes if
# there are enough anchors.

# %%
d, k, width = 16, 10, 32
weights, biases = random_network(rng, d + 4, width, width, k)
count = sum(a.size for a in [*weights, *biases])
layers = [(d + 4, width), (width, width), (width, k)]
assert count == sum((rows + 1) * columns for rows, columns in layers)
print(f"{count} weights take {2 * count} bytes, opacities {2 * k} bytes per anchor")
print(f"the network is cheaper from {count / k:.0f} anchors on")

# %% [markdown]
# ## What this idea buys
# Without masks, trainings of `bouncing` give 38,666 bytes instead of 38,649. This difference is
# negligible, because an anchor keeps 3.8 of its four children. The paper has no number for it, but
# says that of ten children 3 to 4 are left. Without masks, an anchor there would store some 20
# useless numbers, and a renderer would sort 6 or 7 useless Gaussians.

# %%
from tutorials import gains

here = {"without masks": "no masking", "with masks": "+ quantisation and entropy coding"}
assert [round(gains.mean(label)) for label in here.values()] == [38_666, 38_649]
assert round(model.anchors.mask.sum(axis=1).mean(), 1) == 3.8
gains.show("03_opacity_and_masking", here, {})

# %% [markdown]
# **In short**
# - One network, stored once, computes the opacities of all children of all anchors.
# - A child below the threshold is not drawn and gets no gradient of its own.
# - A parameter that many rows use receives the sum of their gradients.
#
# **Often misunderstood**
# - *A child below the threshold is deleted.* It comes back as soon as the network gives it a higher
#   opacity. Only a mask is for good.
# - *Masks are the paper's.* The paper says that $k$ decreases, but not how. The mask, one bit for
#   each child in the file, is our choice (`Q15`).
# - *A negative opacity removes light.* It means nothing but "not drawn".

# %% [markdown]
# ## Exercises
# **03.1** ● A Gaussian has $\alpha = 0.6$ and $\bar\alpha = 2$. What is $\bar\psi$?
#
# **03.2** ●● Write Eq. (3), including the network and the $\tanh$.
#
# **03.3** ●●● Write the backward of the network for any number of layers. Repeat its forward first,
# to have the input of each layer.
#
# **03.4** ●● Write the backward of masking. A Boolean array as an index, `zeros[keep] = ...`, does
# the scattering.
#
# **Predict, then run.** The opacities of all children of an anchor fall just below $\tau_\alpha$.
# Which gradient does the anchor's feature get from the next picture?

# %%
answer_1 = ...


def my_opacity(f_a, delta_vc, d_vc, weights, biases):
    """Return alpha [A, k] for f_a [A, d], delta_vc [A, 1], d_vc [A, 3] and two lists of arrays."""
    raise NotImplementedError


def my_mlp_backward(inputs, cotangents):
    """Return the gradients {"x": array, "weights": list, "biases": list}.

    `inputs` has the same names, and cotangents["y_bar"] has the shape [N, J].
    """
    raise NotImplementedError


def my_masking_backward(inputs, cotangents):
    """Return the gradients {"x", "s", "r", "alpha", "color"} in the shapes of these inputs.

    `inputs` contains "x" and "s" [A, k, 3], "r" [A, k, 4], "alpha" [A, k], "color" [A, k, 3],
    "mask" [A, k] and the number "tau_alpha". `cotangents` contains "x_bar" and "s_bar" [N, 3],
    "r_bar" [N, 4], "alpha_bar" [N] and "color_bar" [N, 3].
    """
    raise NotImplementedError


lessons.check_number("03.1", answer_1)
lessons.check_forward("03.2", my_opacity, "opacity")
lessons.check_backward("03.3", my_mlp_backward, "mlp")
lessons.check_backward("03.4", my_masking_backward, "masking")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only opacity` checks what a port wrote; `masking` and `mlp` are
# checked in the same way. Scaffold-GS keeps a Gaussian if $\alpha > \tau_\alpha$, but the paper if
# $\alpha \ge \tau_\alpha$. On random inputs both give the same result, so one of the golden cases
# has an opacity exactly at the threshold.


# %%
def strict_masking(tau_alpha, **given):
    just_above = np.nextafter(tau_alpha, np.inf)
    return masking.forward(tau_alpha=just_above, **given)[0]


lessons.passes("opacity", "masking", "mlp")
lessons.check_mistake(strict_masking, "masking", "at_the_threshold", "alpha > tau_alpha")

# %% [markdown]
# ## For ports
# The slope $1 - \alpha^2$ loses its digits where $\alpha$ is nearly 1. The code computes it without
# the subtraction:
# $$1 - \tanh^2\psi = \frac{1}{\cosh^2\psi} = \frac{4}{(e^{\psi} + e^{-\psi})^2}
# = \frac{4e}{(1+e)^2} \qquad\text{with } e = e^{-2|\psi|}.$$
# The figure shows the difference. In single precision, $\tanh$ rounds to 1 at about $\psi = 9$, and
# from there on $1 - \alpha^2$ is exactly 0. A Gaussian with such an opacity would never change
# again. The other form is still accurate at 40.

# %%
from p4dgs_ref.equations.numerics import tanh_slope

assert close(tanh_slope(np.array(psi)), slopes)
reach = np.linspace(0, 40, 401, dtype=np.float32)
best_tanh = np.tanh(reach.astype(np.float64)).astype(np.float32)
textbook = 1 - best_tanh**2
stable = tanh_slope(reach)
exact = 1 / np.cosh(reach.astype(np.float64)) ** 2
stuck = reach[textbook == 0][0]
assert 8.8 < stuck < 9.2
assert stable.dtype == np.float32
assert abs(stable[-1] / exact[-1] - 1) < 1e-5

# %%
panels.slopes_of_tanh(reach, exact, stable, textbook)
