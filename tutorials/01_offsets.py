# %% [markdown]
# # Eq. (1): where an anchor's Gaussians are
#
# **Promise.** After this tutorial you can compute the positions of an anchor's Gaussians by hand,
# and send a gradient back from the Gaussians to the anchor. **Before it:** nothing but NumPy.
# **Takes** four seconds of machine time on two cores, 20 minutes of reading and 25 of exercises.
#
# **File:** Eq. (1) [offsets.py](../p4dgs_ref/equations/offsets.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, panels, show, tour

plt = figures.pyplot()
architecture.show("01_offsets")
rng = np.random.default_rng(1)

# %% [markdown]
# ## What fails without it
# Without anchors, every Gaussian stores 59 numbers of its own: position, size, rotation, opacity
# and colour. Its neighbours may lie on the same ball and look nearly the same, and still each of
# them stores 59 more. A scene needs hundreds of thousands of Gaussians: the paper's T-Rex takes
# 56.7 MB in this way (Table 3).
#
# The left side shows the trained scene of `demo.p4dgs` with three of its Gaussians in purple. They
# belong to *anchor 29*, which leads through the tutorials from the picture to its bytes, always in
# this colour. The right side counts the numbers of three such Gaussians (above) and those of the
# anchor (below).

# %%
from p4dgs_ref.scenes import simulator

model, thread = tour.MODEL, figures.THREAD
camera = simulator.camera_at(tour.SCENE, *np.radians((60, 26)))
gaussians = model.gaussians(0.3, camera)
mine = gaussians.index // model.design.k == thread.index
assert mine.sum() == 3
splats = show.splats(gaussians, camera, mine)[:2]
free = {"position": 3, "size": 3, "rotation": 4, "opacity": 1, "colour by direction": 48}
anchor = {
    "position": 3,
    "$l_a$": 3,
    "offsets": 3 * model.design.k,
    "size": 3,
    "feature": model.design.d,
}
assert sum(free.values()) == 59
assert sum(anchor.values()) == 37

# %%
panels.free_and_anchor(model, camera, tour.VIEW, splats, free, anchor)

# %% [markdown]
# ## Claim
# P-4DGS stores no Gaussians. It stores *anchors* and predicts a few Gaussians from each, its
# *children*:
# $$\{x_0,\dots,x_{k-1}\} = x_a + \{O_0,\dots,O_{k-1}\}\cdot l_a \tag{1}$$
# Here $x_a$ is the position of the anchor, $l_a$ is a scaling for each axis, and $O_j$ is the
# learned offset of child $j$, one of $k$ children. The dot multiplies axis by axis. Size, rotation,
# opacity and colour of the children follow from the *feature* $f_a$ of the anchor, a row of $d$
# numbers, and from its *scale* $s_a$ (`02_view` to `04_color_rotation_scale`).

# %% [markdown]
# ## By hand
# Take an anchor at $(1, 2, 0)$ with the scaling $(0.5, 0.5, 2)$, and one child with the offset
# $(2, -1, 0.25)$. The offset times the scaling is $(1, -0.5, 0.5)$, so the child is at
# $(2, 1.5, 0.5)$.

# %%
x_a = np.array([1.0, 2, 0])
l_a = np.array([0.5, 0.5, 2])
O_a = np.array([2, -1, 0.25])
by_hand = [1 + 2 * 0.5, 2 - 1 * 0.5, 0 + 0.25 * 2]
print(by_hand)

# %% [markdown]
# ## In code
# For $A$ anchors with $k$ children each, the arrays have the shapes `x_a [A, 3]`, `O_a [A, k, 3]`
# and `l_a [A, 3]`. With one new axis they broadcast, so all of Eq. (1) is one line of
# `p4dgs_ref/equations/offsets.py`: `x_a[:, None, :] + O_a * l_a[:, None, :]`.
#
# Every equation of the project has a file like this one, with two functions. `forward` returns a
# pair: the output, and a tuple `saved` with everything that `backward` will need. `backward` takes
# `saved` and the gradient of the output, and returns a dictionary with the gradient of each input.

# %%
from p4dgs_ref.equations import offsets
from p4dgs_ref.lessons import close

# paper, Sec. 3.2: an anchor stores k offsets, and l_a says how far they reach
# silent: Q5, whether l_a or its logarithm is meant; here l_a itself
x, saved = offsets.forward(x_a[None], O_a[None, None], l_a[None])
assert x.shape == (1, 1, 3)
assert np.array_equal(x[0, 0], by_hand)

# %% [markdown]
# The next cell applies this line to the trained anchors. Anchor 29 sits on the highlight of the red
# ball, and its children lie around it. A fourth child is not drawn; the reason is the subject of
# `03_opacity_and_masking`. The picture shows the *canonical* scene, which has no time yet. [See it
# move](viewer/demo.html#step=children): the viewer draws the children of each anchor of the demo.

# %%
anchors = model.anchors
places, _ = offsets.forward(anchors.x_a, anchors.O_a, anchors.l_a)
canonical = model.gaussians(None, camera)
assert close(places.reshape(-1, 3)[canonical.index], canonical.x)
print(f"{len(anchors.x_a)} anchors, {len(canonical.x)} children that are drawn")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
image = 0.6 + 0.4 * show.frame(model, camera, None, 20)
for ax in (left, right):
    show.picture(ax, image, camera, **tour.VIEW)
    show.families(ax, model, camera, thread.index)
left.set_title("all anchors (black) and their children")
x, y = show.to_pixels(anchors.x_a[thread.index], camera)
right.set(xlim=(x - 6, x + 6), ylim=(y + 5, y - 5), title="anchor 29: $x_a$, and $x_a + O_j l_a$")
figures.show(figure, "01_offsets")

# %% [markdown]
# ## Backward by hand
# Training minimises one number $\mathcal{L}$, the loss. For any quantity $y$ we write $\bar y$ for
# $\partial\mathcal{L}/\partial y$ and call it the *cotangent* of $y$. A backward function receives
# the cotangents of the outputs and returns those of the inputs.
#
# First consider one child and one axis, where $x = x_a + O\,l$ is an equation between numbers.
# Small changes of the inputs change $x$ by
# $$dx = dx_a + l\,dO + O\,dl \quad\Longrightarrow\quad
# \bar x_a = \bar x,\qquad \bar O = l\,\bar x,\qquad \bar l = O\,\bar x.$$
# On the first axis of our child, $l = 0.5$ and $O = 2$. A cotangent $\bar x = 3$ therefore becomes
# 3 for the position, 1.5 for the offset and 6 for the scaling.

# %%
gradients = offsets.backward(saved, np.array([[[3.0, 0, 0]]]))
assert gradients["x_a"][0, 0] == 3
assert gradients["O_a"][0, 0, 0] == 1.5
assert gradients["l_a"][0, 0] == 6

# %% [markdown]
# Now the arrays. Each child has its own offset, so $\bar O_{aj} = \bar x_{aj}\,l_a$ keeps all three
# axes of the array. The position and the scaling are shared by all children of the anchor. A number
# that is used $k$ times receives $k$ gradients, which add up:
# $$\bar x_a = \sum_j \bar x_{aj},\qquad \bar l_a = \sum_j O_{aj}\,\bar x_{aj}.$$
# The next cell writes these sums as loops and compares them with `offsets.backward`.

# %%
from p4dgs_ref.lessons import inner, random_like, shift

A, k = 5, 4
inputs = {
    "x_a": rng.normal(size=(A, 3)),
    "O_a": rng.normal(size=(A, k, 3)),
    "l_a": rng.uniform(0.1, 1, (A, 3)),
}
x_bar = rng.normal(size=(A, k, 3))
x, saved = offsets.forward(**inputs)
ours = offsets.backward(saved, x_bar)

x_a_bar = np.zeros((A, 3))
l_a_bar = np.zeros((A, 3))
for a in range(A):
    for j in range(k):
        x_a_bar[a] += x_bar[a, j]
        l_a_bar[a] += inputs["O_a"][a, j] * x_bar[a, j]
        assert np.array_equal(ours["O_a"][a, j], x_bar[a, j] * inputs["l_a"][a])
assert close(ours["x_a"], x_a_bar)
assert close(ours["l_a"], l_a_bar)

# %% [markdown]
# How can we check a gradient without deriving it twice? Write $\langle a, b\rangle$ for the sum of
# all products of entries, and take the loss $\mathcal{L} = \langle\bar x, x\rangle$, whose gradient
# with respect to $x$ is $\bar x$. If all inputs move by $\epsilon$ times random numbers
# $\dot x_a, \dot O, \dot l$, which are called *tangents*, then the loss must change, per unit of
# $\epsilon$, by
# $$\langle\bar x_a, \dot x_a\rangle + \langle\bar O, \dot O\rangle
# + \langle\bar l, \dot l\rangle.$$
# This is the *adjoint identity*. It tests all gradients of an equation with two evaluations of its
# forward, and most tutorials use it. The module `lessons` therefore has short functions for its
# parts: `random_like` draws the tangents, `shift` adds $\epsilon$ times the tangents to the inputs,
# `inner` is $\langle a, b\rangle$, and `close` compares two results up to a relative tolerance.
# Later tutorials call `lessons.adjoint`, which does what the next cell does.

# %%
tangents = random_like(rng, inputs)
epsilon = 1e-6
up, _ = offsets.forward(**shift(inputs, tangents, epsilon))
down, _ = offsets.forward(**shift(inputs, tangents, -epsilon))
difference = inner(x_bar, up - down) / (2 * epsilon)
gradient = inner(ours, tangents)
assert close(difference, gradient, 1e-8)
print(f"by differences {difference:.9f}, by gradient {gradient:.9f}")

# %% [markdown]
# ## Break it
# Suppose we forget the sum over the children and keep only the gradient of the last child. The
# result still has the shape `[A, 3]`, so the program runs. The adjoint identity finds the mistake
# immediately.

# %%
broken = {**ours, "x_a": x_bar[:, -1]}
assert broken["x_a"].shape == ours["x_a"].shape
off = abs(inner(broken, tangents) - difference) / abs(difference)
assert off > 0.01
print(f"without the sum, the identity is off by {100 * off:.0f} %")

# %% [markdown]
# ## What a codec does with it
# The children of an anchor share a position and a scaling, as the pixels of a block of video share
# one motion vector. The offsets are not shared: they are $3k$ of the $3k + 6$ numbers in Eq. (1).
# How many bytes they take depends on how coarsely the file is rounded. In the demo's file they are
# the largest part of an anchor; in the paper's small file of T-Rex they take 0.024 MB beside 0.121
# MB of positions, in its large one 0.188 beside 0.118 MB (Table 4). Eq. (1) measures offsets in
# multiples of $l_a$. A small anchor and a large one of the same shape therefore have the *same*
# offsets, and one step of rounding is right for both.

# %%
for k in (4, 10):
    share = 3 * k / (3 * k + 6)
    print(f"k = {k}: {100 * share:.0f} % of the numbers in Eq. (1) are offsets")

at_origin = np.zeros((A, 3))
small, _ = offsets.forward(at_origin, inputs["O_a"], inputs["l_a"])
large, _ = offsets.forward(at_origin, inputs["O_a"], 100 * inputs["l_a"])
assert close(large, 100 * small)

# %% [markdown]
# ## What this idea buys
# In the paper, anchors in place of free Gaussians take T-Rex from 56.7 to 7.27 MB, 87 percent less
# (Table 3). Here they save 85 percent of the Gaussians' bytes, but little of the file, as the bars
# show: about 2 MB of both files are the network of Eq. (5), which moves the Gaussians. There are up
# to 800 of them here, and some 220,000 in T-Rex (inferred from its bytes). With 200 anchors our
# pictures are also worse than with free Gaussians, as the PSNR beside the bars says; twice as many
# make up for most of that. The paper's pictures are not worse.

# %%
from tutorials import gains

of_free, of_anchors = (gains.mean(x, "gaussians_bytes") for x in ("D3DGS", "+ spatial prediction"))
print(f"{of_free:,.0f} bytes of free Gaussians, {of_anchors:,.0f} of anchors")
assert 0.84 < 1 - of_anchors / of_free < 0.86
gains.show(
    "01_offsets",
    {
        "free Gaussians": "D3DGS",
        "200 anchors": "+ spatial prediction",
        "400 anchors": "+ spatial prediction, 400 anchors",
    },
    {"free Gaussians": (56.7, "38.04 dB"), "anchors": (7.27, "38.36 dB")},
)

# %% [markdown]
# **In short**
# - A child's position is that of its anchor plus its offset, in multiples of the anchor's $l_a$.
# - What all children share gets the sum of their gradients.
# - Anchors save what neighbouring Gaussians have in common. They do not make the networks smaller.
#
# **Often misunderstood**
# - *The file contains Gaussians.* It contains anchors and networks. The Gaussians are computed anew
#   for every picture.
# - *An anchor is a Gaussian.* It is never drawn, and no child needs to be at its position.
# - *$l_a$ is the size of the children.* It says how far they may be from the anchor; their size is
#   that of Eq. (4).

# %% [markdown]
# ## Exercises
# Replace each `...` below, then run the cell. Later tutorials also ask for functions, whose bodies
# are `raise` lines; they compare yours with *golden vectors*: inputs and outputs that come with the
# project. `lessons.hint("01.2")` prints a hint, and a second call prints another one. The last
# question of a tutorial has no blank: write down what you expect and why, then test it with a few
# lines of code. The solutions also answer this question.
#
# **01.1** ● A second child of the anchor in "By hand" has the offset $(0, 4, -0.5)$. Where is it?
# Give a list of three numbers.
#
# **01.2** ● The file rounds every offset, by at most $0.1$. How far can that move the child of "By
# hand" along each axis? And how far if $l_a$ is doubled and all offsets are halved, which leaves
# every child in its place? Give a list of two lists of three numbers.
#
# **01.3** ●● Four children of an anchor have the offsets $2, -1, -1, 0$ along x, where $l = 0.5$,
# and the cotangents $1, 1, -2, 0$. Does gradient descent move the anchor, and does it pull the
# children together or apart? Give $\bar x_a$, $\bar l$ and the gradient of $\log l$, which
# Scaffold-GS trains.
#
# **Predict, then run.** A port keeps all numbers in float16. An anchor is at $x = 1000$, with
# $l_a = 0.1$. Which of the offsets $1, 2, 3, \dots$ is the first that moves its child?

# %%
answer_1 = ...
answer_2 = ...
answer_3 = ...

lessons.check_number("01.1", answer_1)
lessons.check_number("01.2", answer_2)
lessons.check_number("01.3", answer_3)

# %% [markdown]
# ## Check your port
# A *port* is a new implementation of the method, in another language or framework. It reads the
# inputs of the golden vectors, writes its outputs to a folder, and
# `p4dgs-ref oracle check DIR --only offsets` compares them. From Python, any function can be
# checked directly, as below.
#
# A common mistake comes from Scaffold-GS, from which this equation is taken. Scaffold-GS stores the
# logarithm of $l_a$, whereas $l_a$ here is the scaling itself. The checker recognises the wrong
# results and names the mistake. `lessons.check_mistake` prints what the checker says of a port with
# a mistake. Later tutorials call `lessons.passes` to check a port that is right.

# %%
from p4dgs_ref import oracle


def port(x_a, O_a, l_a):
    return offsets.forward(x_a, O_a, l_a)[0]


def port_of_scaffold(x_a, O_a, l_a):
    return offsets.forward(x_a, O_a, np.exp(l_a))[0]


report = oracle.check(port, "offsets")
print(report)
assert report.ok
lessons.check_mistake(port_of_scaffold, "offsets", "logarithm")
