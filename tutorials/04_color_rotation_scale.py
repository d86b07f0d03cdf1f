# %% [markdown]
# # Eq. (3') for colour and rotation, Eq. (4) for scale
#
# **Promise.** After this tutorial you can take a gradient through a sigmoid, through a factor that
# several outputs share, and through a normalised quaternion. **Before it:** `02_view`,
# `03_opacity_and_masking`. **Takes** four seconds of machine time on two cores, 25 minutes of
# reading and 35 of exercises.
#
# **Files:** Eq. (3') [color.py](../p4dgs_ref/equations/color.py),
# Eq. (3') [rotation.py](../p4dgs_ref/equations/rotation.py),
# Eq. (4) [scale.py](../p4dgs_ref/equations/scale.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("04_color_rotation_scale")
rng = np.random.default_rng(4)

# %% [markdown]
# ## What fails without it
# The last layer of a network can return any number. Used directly, its outputs would give colours
# outside the range from black to white, sizes that are negative or huge, and quaternions of any
# length: one of length 30 makes its Gaussian up to 1,800 times as long. The pictures show the
# trained scene, each time with one attribute as its network returns it.

# %%
from p4dgs_ref.equations import anchor_network, color, rotation, scale, view
from p4dgs_ref.scenes import simulator
from p4dgs_ref.splatting import render

model, thread = tour.MODEL, figures.THREAD
anchors, networks = model.anchors, model.networks
camera = simulator.camera_at(tour.SCENE, *np.radians((60, 26)))
gaussians = model.gaussians(None, camera)
parent = gaussians.index // model.design.k
no_view = 2 * [anchors.f_a[:, :0]]
seen, _ = view.forward(anchors.x_a, camera.center)


def output(network, width, seen):
    """What the last layer of a network gives to each Gaussian."""
    psi, _ = anchor_network.forward(anchors.f_a, *seen, *networks[network], width=width)
    return psi.reshape(-1, width)[gaussians.index]


as_it_comes = {
    "as trained": {},
    "colour": {"color": output("psi_c", 3, seen)},
    "size": {"s": anchors.s_a[parent] * output("psi_s", 3, no_view)},
    "rotation": {"r": output("psi_r", 4, no_view)},
}
assert np.linalg.norm(as_it_comes["rotation"]["r"], axis=1).max() > 29

# %%
figure, axes = plt.subplots(1, 4, figsize=(13, 3), layout="constrained")
for ax, (title, changed) in zip(axes, as_it_comes.items()):
    *drawn, _ = gaussians._replace(**changed)
    near = show.enlarged(camera, 8)
    (image, *_), _ = render.forward(*drawn, near, model.background, show.FAST, keep=False)
    show.picture(ax, np.clip(image, 0, 1), camera, title=title, **tour.VIEW)
figures.show(figure, "04_color_rotation_scale_raw")

# %% [markdown]
# ## Claim
# Colour and rotation are "predicted analogously" to the opacity of Eq. (3), which the project
# counts as Eq. (3'). For the scale, the output of the network is "a residual scaling factor
# relative to the anchor scale":
# $$\{s_0,\dots,s_{k-1}\} = s_a \cdot \mathrm{sigmoid}\bigl(\psi_s(f_a, \delta_{vc}, d_{vc})\bigr)
# \tag{4}$$
# The paper does not print the activations of the other two networks. This project uses those of
# Scaffold-GS (choice `Q4`): $c_j = \mathrm{sigmoid}(\psi_c)_j$ for the colour, and $r_j =
# \psi_{r,j} / \|\psi_{r,j}\|_2$ for the rotation. The latter is a unit *quaternion*, that is, four
# numbers $(w, x, y, z)$ of length one that describe a rotation. The real part $w$ is the cosine of
# half the angle, and $(x, y, z)$ points along the axis. `13_covariance` explains the details.

# %% [markdown]
# ## By hand
# The sigmoid $1/(1+e^{-\psi})$ of $0$, $\ln 3$ and $-\ln 3$ is 0.5, 0.75 and 0.25. With
# $s_a = (2, 1, 0.5)$, a child with these three outputs has the scale $(1, 0.75, 0.125)$. The
# quaternion $(1, 2, 2, 4)$ has the length 5, so normalising gives $(0.2, 0.4, 0.4, 0.8)$.

# %%
psi = np.array([0, np.log(3), -np.log(3)])
share = 1 / (1 + np.exp(-psi))
s_a = np.array([2, 1, 0.5])
raw = np.array([1.0, 2, 2, 4])
print("sigmoid", share, "| scale", s_a * share, "| rotation", raw / 5)

# %% [markdown]
# ## In code
# The last layer of a network is `3 k` or `4 k` numbers wide, and reshaping it to `[A, k, 3]` or
# `[A, k, 4]` reads it child by child: the first columns belong to the first child. The anchor's
# scale `s_a [A, 3]` gets an axis of length one, so that it serves all children. In the next cell
# the network is the identity and the anchor has two children, the second one with the outputs of
# the first in reverse order.

# %%
from p4dgs_ref.lab.random_inputs import random_anchor_network
from p4dgs_ref.lessons import close, inner

no_view = [np.zeros((1, 0)), np.zeros((1, 0))]  # the feature is the whole input
two_children = np.concatenate([psi, psi[::-1]])[None]
identity = [np.eye(6)], [np.zeros(6)]
both = np.array([[share, share[::-1]]])
colors, _ = color.forward(two_children, *no_view, *identity)
assert close(colors, both)
# paper, Sec. 3.2: a share of the anchor's scale; silent: Q4, the other two activations
scales, _ = scale.forward(s_a[None], two_children, *no_view, *identity)
assert close(scales, s_a * both)
turns, _ = rotation.forward(raw[None], *no_view, [np.eye(4)], [np.zeros(4)])
assert close(turns, [[[0.2, 0.4, 0.4, 0.8]]])

# %% [markdown]
# The figure shows anchor 29 and anchor 28, which is on the green ball. The grey ellipse is the
# anchor's own scale, without rotation. Its children have colours, rotations and scales of their
# own, but along each of its own axes no child is larger than the anchor, because a sigmoid is at
# most one.

# %%
assert (gaussians.s <= anchors.s_a[parent]).all()
unturned = np.tile([1.0, 0, 0, 0], (len(anchors.x_a), 1))
of_anchors = gaussians._replace(x=anchors.x_a, s=anchors.s_a, r=unturned)

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 5), layout="constrained")
for ax, a, edge in zip(axes, (thread.index, 28), (thread.color, "k")):
    own, shape, *_ = show.splats(of_anchors, camera, [a])
    children = show.splats(gaussians, camera, parent == a)
    show.ellipses(ax, own, shape, fc="0.85", ec="0.4", ls="--", lw=2)
    show.ellipses(ax, *children[:2], fc=gaussians.color[parent == a], ec=edge, lw=2)
    x, y = own[0]
    ax.set(xlim=(x - 11, x + 11), ylim=(y + 11, y - 11), title=f"anchor {a}", aspect="equal")
    ax.set(xlabel="column (pixels)", ylabel="row (pixels)")
figures.show(
    figure,
    "04_color_rotation_scale",
    title="Children have their own colours and rotations, and are smaller than their anchor",
    size=14,
)

# %% [markdown]
# ## Backward by hand
# **Sigmoid.** With $c = 1/(1+e^{-\psi})$,
# $$dc = \frac{e^{-\psi}}{(1+e^{-\psi})^2}\,d\psi = c\,(1-c)\,d\psi.$$
#
# **Scale.** One axis of one child is $s = s_a\,\varphi$ with $\varphi = \mathrm{sigmoid}(\psi)$. By
# the product rule,
# $$ds = \varphi\,ds_a + s_a\,\varphi(1-\varphi)\,d\psi \;\Rightarrow\;
# \bar s_a = \varphi\,\bar s, \quad \bar\psi = s_a\,\varphi\,(1-\varphi)\,\bar s.$$

# %%
one_child = [np.eye(3)], [np.zeros(3)]
_, saved = scale.forward(s_a[None], psi[None], *no_view, *one_child)
s_bar = np.array([3.0, -1, 2])
gradients = scale.backward(saved, s_bar[None, None])
assert close(gradients["s_a"][0], share * s_bar)
assert close(gradients["f_a"][0], s_a * share * (1 - share) * s_bar)

# %% [markdown]
# With several children, each has its own $\bar\psi$, but they share $s_a$. The gradient of $s_a$
# therefore sums over the children, as that of $l_a$ did in `01_offsets`:
# $\bar s_a = \sum_j \varphi_j\,\bar s_j$. Afterwards $\bar\psi$ is reshaped to `[A, 3 k]`, and the
# backward of the network from `03_opacity_and_masking` continues.

# %%
A, k = 3, 5
inputs = {"s_a": rng.uniform(0.1, 2, (A, 3))}
inputs |= random_anchor_network(
    rng,
    A=A,
    d=2,
    k=k,
    outputs=3,
)
s, saved = scale.forward(**inputs)
s_bar = rng.normal(size=(A, k, 3))
ours = scale.backward(saved, s_bar)

phi = s / inputs["s_a"][:, None]
s_a_bar = sum(phi[:, j] * s_bar[:, j] for j in range(k))
psi_bar = s_bar * inputs["s_a"][:, None] * phi * (1 - phi)
assert close(ours["s_a"], s_a_bar)
assert close(ours["biases"][-1], psi_bar.reshape(A, 3 * k).sum(axis=0), 1e-11)

# %% [markdown]
# **Quaternion.** Let $y$ be the four outputs of the network and $n = \sqrt{y\cdot y}$. Then
# $r = y/n$ is the direction of Eq. (2) in four dimensions, and the same derivation gives
# $$dn = \frac{y\cdot dy}{n} = r\cdot dy, \qquad
# dr = \frac{dy}{n} - \frac{y\,dn}{n^2} = \frac{1}{n}\,(I - r r^T)\,dy.$$
# The matrix is its own transpose, so $\bar y = (\bar r - r\,(r\cdot\bar r))/n$. For
# $y = (1, 2, 2, 4)$ and $\bar r = (50, 0, 0, 0)$ this is $(9.6, -0.8, -0.8, -1.6)$.

# %%
from p4dgs_ref.equations.numerics import normalise, normalise_backward, sigmoid_slope

unit, norm = normalise(raw)
raw_bar = normalise_backward(unit, norm, np.array([50.0, 0, 0, 0]))
assert close(raw_bar, [9.6, -0.8, -0.8, -1.6])

# %% [markdown]
# Here are the lines of the derivation against differences, for twenty random quaternions: first
# $dn$, then $dr$, then the transpose in the form of the adjoint identity.

# %%
y = rng.normal(size=(20, 4))
dy = rng.normal(size=(20, 4))
r_bar = rng.normal(size=(20, 4))
r, n = normalise(y)
r_up, n_up = normalise(y + 1e-6 * dy)
r_down, n_down = normalise(y - 1e-6 * dy)

dn = (r * dy).sum(axis=1, keepdims=True)
dr = (dy - r * dn) / n
y_bar = normalise_backward(r, n, r_bar)
assert close((n_up - n_down) / 2e-6, dn, 1e-6)
assert close((r_up - r_down) / 2e-6, dr, 1e-6)
assert abs(inner(y_bar, dy) - inner(r_bar, dr)) < 1e-12

# %% [markdown]
# **At zero** there is a problem, because $0/0$ is no rotation. The code therefore divides by $n =
# \sqrt{y\cdot y + \epsilon^2}$ with $\epsilon = 10^{-12}$. The formulas for $dn$, $dr$ and $\bar y$
# stay exact with this $n$. What changes is that $r$ is not quite a unit vector any more: $|r|^2 = 1
# - (\epsilon/n)^2$. At $y = 0$ the gradient is $\bar r/\epsilon$, which is large but finite. As in
# the figure of `02_view`, the gradient of a direction is perpendicular to it and fades with the
# length, so a step of gradient descent turns a long quaternion less than a short one.

# %%
tiny = 2e-12 * rng.normal(size=4)
bar = np.array([3.0, -5, 7, 11])
r, n = normalise(tiny)
assert close(n[0], np.sqrt(tiny @ tiny + 1e-24))
assert close(r @ r, 1 - (1e-12 / n[0]) ** 2)
assert r @ r < 0.99
assert close(normalise_backward(r, n, bar), (bar - r * (r @ bar)) / n)
at_zero = normalise_backward(*normalise(np.zeros(4)), bar)
assert close(at_zero, bar * 1e12)

# %% [markdown]
# ## Break it
# Suppose we divide by $n$ and forget the projector, as if the length were a constant. Gradient
# descent towards a target rotation still arrives there, so everything looks fine. But this vector
# is not the gradient of the loss. It has a component along $r$, although the loss does not depend
# on the length of the quaternion, and during the descent the length shrinks.

# %%
target, _ = normalise(rng.normal(size=4))
start = np.array([0.6, -0.3, 0.2, 0.4])


def descend(with_projector):
    """Return the raw quaternion after gradient descent on |r - target|^2 / 2."""
    y = start.copy()
    for _ in range(4000):
        r, n = normalise(y)
        r_bar = r - target
        y_bar = normalise_backward(r, n, r_bar) if with_projector else r_bar / n
        y -= 0.05 * y_bar
    return y


for name, with_projector in (("right", True), ("broken", False)):
    y = descend(with_projector)
    cosine = abs(normalise(y)[0] @ target)
    missing = np.degrees(2 * np.arccos(min(cosine, 1)))
    length = np.linalg.norm(y)
    print(f"{name}: {missing:.4f} degrees from the target, length {length:.3f}")
    assert missing < 0.1
    assert (length > np.linalg.norm(start)) == with_projector

r, n = normalise(start)
bar = r - target
assert abs(normalise_backward(r, n, bar) @ r) < 1e-14
assert abs(bar @ r / n[0]) > 0.1

# %% [markdown]
# ## What a codec does with it
# The file contains no colour, rotation or scale of any Gaussian, because the anchor's feature and
# the three numbers $s_a$ determine them all. A Gaussian written out has 14 numbers, without view
# dependence: position, scale, rotation, opacity and colour. The cell compares ten Gaussians with
# one anchor of ten children, in the paper's sizes. [See it move](viewer/demo.html#step=prediction):
# one anchor's feature, and the children that the networks make of it.

# %%
d, k = 16, 10
gaussian = 3 + 3 + 4 + 1 + 3  # x, s, r, alpha, color
anchor = d + 3 + 3 + 3 * k + 3  # f_a, s_a, l_a, O_a, x_a
print(f"ten Gaussians: {k * gaussian} numbers written out, {anchor} as an anchor")

# %% [markdown]
# Because $s_a$ is a common factor, its rounding error is common too: all children of an anchor
# become larger or smaller by the same percentage. With the paper's base step of 0.001 for $s_a$, a
# scale of 0.02 is wrong by at most 2.5 percent in every child.

# %%
step = 0.001
s_a = np.full((1, 3), 0.02)
features = rng.normal(size=(1, 15))
one_layer = [rng.normal(size=(15, 15))], [np.zeros(15)]
exact, _ = scale.forward(s_a, features, *no_view, *one_layer)
rounded, _ = scale.forward(s_a + step / 2, features, *no_view, *one_layer)
assert close(rounded / exact, 1.025)

# %% [markdown]
# ## What this idea buys
# The bars at the end of `01_offsets` show what this idea gains, too: four networks and a feature
# take the place of 59 numbers for each Gaussian. In the paper the networks of anchors and context
# together are 0.038 of 0.857 MB (Table 4). Here they are larger than all anchors, because only 199
# anchors share them; in the paper some 20,000 do (their positions have 0.12 MB, at 6 bytes each).
#
# **In short**
# - The sigmoid keeps colours between black and white, and children smaller than their anchor.
# - Rotations are directions in four dimensions; gradients along the quaternion are removed.
# - One $s_a$ serves all children: its gradient is a sum, its rounding error is common.
#
# **Often misunderstood**
# - *The network predicts the size.* It predicts a share of the anchor's size.
# - *$\psi_r$ corrects a rotation of the anchor.* An anchor has no rotation.
# - *Equal features look equal.* The direction of the camera is an input, too.

# %% [markdown]
# ## Exercises
# **04.1** ● $y = (0, 3, 0, 4)$ and $\bar r = (0, 0, 0, 25)$. What is $\bar y$? Give a list of four.
#
# **04.2** ●● Write the colours: the sigmoid of `psi [A, 3 k]`, child by child. $e^{800}$ is larger
# than any float, so think of $e^{-|\psi|}$.
#
# **04.3** ●● Write the backward of the rotation.
#
# **04.4** ●● Write the backward of the scale.
#
# In the last two, the derivations above give `psi_bar`, and the function that `network` returns
# does the rest.
#
# **Predict, then run.** A port computes $y/\sqrt{\|y\|^2 + \epsilon}$ with $\epsilon = 10^{-24}$
# in float16. What does it return for $y = 0$?

# %%
answer_1 = ...


def network(f_a, delta_vc, d_vc, weights, biases, width):
    """Return psi [A, k, width], and a function from psi_bar to the gradients of the five inputs."""
    psi, saved = anchor_network.forward(f_a, delta_vc, d_vc, weights, biases, width=width)
    return psi, lambda psi_bar: anchor_network.backward(saved, psi_bar)


def my_color(f_a, delta_vc, d_vc, weights, biases):
    """Return color [A, k, 3]; it must be right where psi is 800, -800 and -40."""
    raise NotImplementedError


def my_rotation_backward(inputs, cotangents):
    """Return the gradients of the five inputs, given cotangents["r_bar"] [A, k, 4].

    Use the length n with epsilon from the text.
    """
    raise NotImplementedError


def my_scale_backward(inputs, cotangents):
    """Return the gradients of the six inputs, given cotangents["s_bar"] [A, k, 3].

    inputs["s_a"] has the shape [A, 3].
    """
    raise NotImplementedError


lessons.check_number("04.1", answer_1)
lessons.check_forward("04.2", my_color, "color")
lessons.check_backward("04.3", my_rotation_backward, "rotation")
lessons.check_backward("04.4", my_scale_backward, "scale")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rotation` compares what a port wrote, and the same works with
# `color` and `scale`. The usual mistake is a quaternion with the real part *last*, as several
# libraries store it. Its length is still one and its numbers are the right ones, but it is another
# rotation.


# %%
def real_part_last(**inputs):
    r, _ = rotation.forward(**inputs)
    return r[..., [1, 2, 3, 0]]


lessons.passes("color", "rotation", "scale")
lessons.check_mistake(real_part_last, "rotation", "(x, y, z, w)")

# %% [markdown]
# ## For ports
# The function `numerics.sigmoid_slope` uses $\mathrm{sigmoid}(-\psi)$ for the $1 - c$ of the slope.
# It is the same number, but it keeps its digits where $c$ is almost one. At $\psi = 40$, for
# example, $c$ rounds to 1 and the textbook slope $c\,(1 - c)$ is 0, although the true slope is
# $e^{-40}$.

# %%
assert close(sigmoid_slope(psi), share * (1 - share))
c = 1 / (1 + np.exp(-40.0))
assert c * (1 - c) == 0
assert close(sigmoid_slope(40.0), np.exp(-40))
