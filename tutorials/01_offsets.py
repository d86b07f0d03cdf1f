# %% [markdown]
# # Eq. (1): where an anchor's Gaussians are
#
# **Promise.** After this tutorial you can compute the positions of an anchor's Gaussians by hand,
# and send a gradient back from the Gaussians to the anchor. **Before it:** nothing but NumPy.
# **Takes** a second of machine time on two cores, 15 minutes of reading and 25 of exercises.
#
# **File:** Eq. (1) [offsets.py](../p4dgs_ref/equations/offsets.py).

# %%
import numpy as np

from p4dgs_ref import lessons

plt = lessons.begin()
from tutorials.tools import architecture

architecture.show("01_offsets")
rng = np.random.default_rng(1)

# %% [markdown]
# ## Claim
# P-4DGS never stores Gaussians. It stores *anchors* and predicts a handful of Gaussians from each:
# $$\{x_0,\dots,x_{k-1}\} = x_a + \{O_0,\dots,O_{k-1}\}\cdot l_a \tag{1}$$
# Here $x_a$ is the position of the anchor, $l_a$ is a scaling for each axis, and $O_j$ is the
# learned offset of child $j$, one of $k$ children. The dot multiplies axis by axis.

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

x, saved = offsets.forward(x_a[None], O_a[None, None], l_a[None])
assert x.shape == (1, 1, 3)
assert np.array_equal(x[0, 0], by_hand)

# %% [markdown]
# The next cell draws four random anchors with six children each. All anchors have the same scaling,
# which is largest along x, so their children spread further along x than along y.
# [See it move](viewer/demo.html#step=2): the viewer draws the children of each anchor of the demo.

# %%
anchors = rng.uniform(-1, 1, (4, 3))
spread = np.tile([0.25, 0.1, 0.2], (4, 1))
children, _ = offsets.forward(anchors, rng.normal(size=(4, 6, 3)), spread)

figure, axes = plt.subplots()
for a in range(4):
    for child in children[a]:
        line_x, line_y, _ = np.stack([anchors[a], child], axis=1)
        axes.plot(
            line_x,
            line_y,
            "-",
            lw=1,
            color="0.7",
            zorder=0,
        )
    axes.plot(
        children[a, :, 0],
        children[a, :, 1],
        "o",
        ms=7,
        label=f"anchor {a}",
    )
    axes.plot(
        anchors[a, 0],
        anchors[a, 1],
        "k+",
        ms=16,
        mew=3,
    )
lessons.finish(
    axes,
    xlabel="x (scene units)",
    ylabel="y (scene units)",
    aspect="equal",
    title="Four anchors (+) with six Gaussians each: $l_a$ is larger along x",
)
lessons.label(
    axes,
    (0.1, 0.97),
    (1.0, -0.58),
    (0.2, -0.02),
    (-0.8, 0.6),
)
lessons.show(figure, "01_offsets")

# %% [markdown]
# ## Backward by hand
# Training minimises one number $L$, the loss. For any quantity $y$ we write $\bar y$ for
# $\partial L/\partial y$ and call it the *cotangent* of $y$. A backward function receives the
# cotangents of the outputs and returns those of the inputs.
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
# axes of the array. The position and the scaling are different, because all children of the anchor
# share them. A number that is used $k$ times receives $k$ gradients, which add up:
# $$\bar x_a = \sum_j \bar x_{aj},\qquad \bar l_a = \sum_j O_{aj}\,\bar x_{aj}.$$
# The next cell writes these sums as loops and compares them with `offsets.backward`.

# %%
from p4dgs_ref.lessons import close, inner, moved, random_like

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
# all products of entries, and take the loss $L = \langle\bar x, x\rangle$, whose gradient with
# respect to $x$ is $\bar x$. If all inputs move by $h$ times random directions $d$, then the loss
# must change, per unit of $h$, by
# $$\langle\bar x_a, d_{x_a}\rangle + \langle\bar O, d_O\rangle + \langle\bar l, d_l\rangle.$$
# This is the *adjoint identity*. It tests all gradients of an equation with two evaluations of its
# forward, and most tutorials use it. The module `lessons` therefore has short functions for its
# parts: `random_like` draws the directions, `moved` adds $h$ times the directions to the inputs,
# `inner` is $\langle a, b\rangle$, and `close` compares two results up to a relative tolerance.
# Later tutorials call `lessons.adjoint`, which does what the next cell does.

# %%
d = random_like(rng, inputs)
h = 1e-6
up, _ = offsets.forward(**moved(inputs, d, h))
down, _ = offsets.forward(**moved(inputs, d, -h))
difference = inner(x_bar, up - down) / (2 * h)
gradient = inner(ours, d)
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
off = abs(inner(broken, d) - difference) / abs(difference)
assert off > 0.01
print(f"without the sum, the identity is off by {100 * off:.0f} %")

# %% [markdown]
# ## What a codec does with it
# The children of an anchor share a position and a scaling, as the pixels of a block of video share
# one motion vector. The offsets are not shared: they are $3k$ of the $3k + 6$ numbers in Eq. (1),
# so they take most of the bits, and their range matters. Eq. (1) measures offsets in multiples of
# $l_a$. A small anchor and a large one of the same shape therefore have the *same* offsets, and one
# quantisation step is right for both.

# %%
for k in (4, 10):
    share = 3 * k / (3 * k + 6)
    print(f"k = {k}: {100 * share:.0f} % of the numbers in Eq. (1) are offsets")

at_origin = np.zeros((A, 3))
small, _ = offsets.forward(at_origin, inputs["O_a"], inputs["l_a"])
large, _ = offsets.forward(at_origin, inputs["O_a"], 100 * inputs["l_a"])
assert close(large, 100 * small)

# %% [markdown]
# ## Exercises
# Replace each `...` and the `raise` lines below, then run the cell. It compares your functions with
# *golden vectors*, which are inputs and outputs that come with the project. `lessons.hint("01.2")`
# prints a hint, and a second call prints another one. The last question of a tutorial has no blank:
# write down what you expect and why, then test it with a few lines of code. The solutions also
# answer this question.
#
# **01.1** ● A second child of the anchor in "By hand" has the offset $(0, 4, -0.5)$. Where is it?
# Give a list of three numbers.
#
# **01.2** ● Write Eq. (1) for arrays.
#
# **01.3** ●● Write its backward. The dictionary `cotangents` holds the cotangents of the outputs,
# here `x_bar` for the output `x`.
#
# **Predict, then run.** A port keeps all numbers in float16. An anchor is at $x = 1000$, with
# $l_a = 0.1$. Which of the offsets $1, 2, 3, \dots$ is the first that moves its child?

# %%
answer_1 = ...


def my_forward(x_a, O_a, l_a):
    """Return x [A, k, 3] for x_a [A, 3], O_a [A, k, 3] and l_a [A, 3]."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return the gradients {"x_a", "O_a", "l_a"}, given cotangents["x_bar"] [A, k, 3]."""
    raise NotImplementedError


lessons.check_number("01.1", answer_1)
lessons.check_forward("01.2", my_forward, "offsets")
lessons.check_backward("01.3", my_backward, "offsets")

# %% [markdown]
# ## Check your port
# A *port* is a new implementation of the method, in another language or framework. It reads the
# inputs of the golden vectors, writes its outputs to a folder, and
# `p4dgs-ref oracle check DIR --only offsets` compares them. From Python, any function can be
# checked directly, as below.
#
# A common mistake comes from Scaffold-GS, from which this equation is taken. Scaffold-GS stores the
# logarithm of $l_a$, whereas $l_a$ here is the scaling itself. The checker recognises the wrong
# results and names the mistake. `lessons.caught` prints what the checker says of a port with a
# mistake. Later tutorials call `lessons.passes` to check a port that is right.

# %%
from p4dgs_ref import oracle


def port(x_a, O_a, l_a):
    return offsets.forward(x_a, O_a, l_a)[0]


def port_of_scaffold(x_a, O_a, l_a):
    return offsets.forward(x_a, O_a, np.exp(l_a))[0]


report = oracle.check(port, "offsets")
print(report)
assert report.ok
lessons.caught(port_of_scaffold, "offsets", "logarithm")
