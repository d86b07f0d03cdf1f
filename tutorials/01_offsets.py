# %% [markdown]
# # Eq. (1): where an anchor's Gaussians stand
#
# **Promise.** After this you can place the Gaussians of an anchor by hand, and send a gradient back to the anchor.
# **Before it:** nothing but NumPy. **Takes** a second of machine time on two cores, a quarter of an hour of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS
from p4dgs_ref.equations import offsets
from p4dgs_ref.school import lessons

plt = lessons.pyplot()

# %% [markdown]
# ## Claim
# P-4DGS never stores Gaussians. It stores *anchors*, and predicts a handful of Gaussians from each:
# $$\{x_0,\dots,x_{k-1}\} = x_a + \{O_0,\dots,O_{k-1}\}\cdot l_a \tag{1}$$
# $x_a$ is the anchor's place, $l_a$ one scaling per axis, $O_j$ the learned offset of child $j$, one of $k$. The dot multiplies
# axis by axis.

# %% [markdown]
# ## By hand
# One anchor at $(1, 2, 0)$ with scaling $(0.5, 0.5, 2)$ and one child with offset $(2, -1, 0.25)$.
# Axis by axis the child stands at 2.0, 1.5 and 0.5.

# %%
x_a, l_a, O = np.array([1, 2, 0]), np.array([0.5, 0.5, 2]), np.array([2, -1, 0.25])
by_hand = [float(x_a[i] + O[i] * l_a[i]) for i in range(3)]
assert by_hand == [2.0, 1.5, 0.5]
print(by_hand)

# %% [markdown]
# ## In code
# For `A` anchors with `k` children each the shapes are `x_a (A, 3)`, `O_a (A, k, 3)`, `l_a (A, 3)`; one new axis makes
# them fit. The whole of Eq. (1) is one line of `p4dgs_ref/equations/offsets.py`: `x_a[:, None] + O_a * l_a[:, None]`.

# %% [markdown]
# Every equation of the project has a file with two functions. `forward` returns the outputs by name, here `out.x`, and `res`:
# what the way back has to remember. `backward` takes `res` and gives the gradients by name.

# %%
out, res = offsets.forward(x_a[None].astype(float), O[None, None], l_a[None])
assert out.x.shape == (1, 1, 3) and np.array_equal(out.x[0, 0], by_hand)

rng = np.random.default_rng(1)
anchors = rng.uniform(-1, 1, (4, 3))
children = offsets.forward(anchors, rng.normal(size=(4, 6, 3)), np.full((4, 3), [0.25, 0.1, 0.2]))[
    0
].x
figure, axes = plt.subplots()
for a in range(4):
    axes.plot(
        *np.stack([np.broadcast_to(anchors[a], (6, 3)), children[a]])[..., :2].transpose(2, 0, 1),
        "-",
        lw=1,
        color="0.7",
    )
    axes.plot(*children[a, :, :2].T, "o", ms=7, label=f"children of anchor {a}")
    axes.plot(*anchors[a, :2], "k+", ms=16, mew=3)
axes.set(
    xlabel="x (scene units)",
    ylabel="y (scene units)",
    aspect="equal",
    title="Four anchors (+), six Gaussians each: $l_a$ is wider along x",
)
axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
lessons.show(figure, "01_offsets")

# %% [markdown]
# ## Backward by hand
# $L$ is the one number that training makes small, the loss. Write $\bar y$ for $\partial L/\partial y$, the *cotangent* of $y$:
# it arrives at outputs and is sent on to inputs. One child, one axis: $x = x_a + O\,l$. Small changes of the inputs give
# $$dx = dx_a + l\,dO + O\,dl \quad\Longrightarrow\quad \bar x_a = \bar x,\qquad \bar O = l\,\bar x,\qquad \bar l = O\,\bar x.$$
# With $\bar x = 3$ on the first axis of our child: 3 for the place, 1.5 for the offset, 6 for the scaling.

# %%
x_bar = 3.0  # l = 0.5, O = 2 on this axis
assert (x_bar, l_a[0] * x_bar, O[0] * x_bar) == (3, 1.5, 6)

# %% [markdown]
# Now shapes. Each child has its own $O_j$, so $\bar O_{aj} = \bar x_{aj}\,l_a$ keeps all three axes of the array.
# $x_a$ and $l_a$ serve every child: what is *used* $k$ times *collects* $k$ gradients, hence a sum over axis $j$:
# $$\bar x_a = \sum_j \bar x_{aj},\qquad \bar l_a = \sum_j O_{aj}\,\bar x_{aj}.$$

# %%
A, k = 5, 4
inputs = dict(
    x_a=rng.normal(size=(A, 3)), O_a=rng.normal(size=(A, k, 3)), l_a=rng.uniform(0.1, 1, (A, 3))
)
x_bar = rng.normal(size=(A, k, 3))
out, res = offsets.forward(**inputs)
ours = offsets.backward(res, x_bar)
assert np.array_equal(ours["x_a"], x_bar.sum(axis=1))  # x_a_bar = sum over children
assert np.array_equal(ours["O_a"], x_bar * inputs["l_a"][:, None])  # O_a_bar = x_bar l_a
assert np.allclose(
    ours["l_a"], (x_bar * inputs["O_a"]).sum(axis=1), rtol=1e-14
)  # l_a_bar = sum of x_bar O_a

# %% [markdown]
# Is it right? $\langle a, b\rangle$ is the sum of all products of entries. Take $L = \langle\bar x, x\rangle$, whose
# gradient at $x$ is $\bar x$. Move all inputs by $h$ times random directions $d$: per unit of $h$, $L$ must change by
# $\langle\bar x_a, d_{x_a}\rangle + \langle\bar O, d_O\rangle + \langle\bar l, d_l\rangle$. That is the *adjoint identity*.

# %%
d = {name: rng.normal(size=a.shape) for name, a in inputs.items()}
h = 1e-6
up, down = (
    offsets.forward(**{n: a + s * h * d[n] for n, a in inputs.items()})[0].x for s in (1, -1)
)
difference, gradient = (x_bar * (up - down)).sum() / (2 * h), sum((ours[n] * d[n]).sum() for n in d)
assert abs(difference - gradient) < 1e-8 * abs(gradient)
print(f"by differences {difference:.9f}, by gradient {gradient:.9f}")

# %% [markdown]
# ## Break it
# Forget the sum over the children and keep only the last one's gradient: the shape is still `(A, 3)`, and the program runs.
# The adjoint identity sees it at once.

# %%
broken = {**ours, "x_a": x_bar[:, -1]}
off = abs(sum((broken[n] * d[n]).sum() for n in d) - difference) / abs(difference)
assert broken["x_a"].shape == ours["x_a"].shape and off > 0.01
print(f"without the sum the identity is off by {100 * off:.0f} %")

# %% [markdown]
# ## What a codec does with it
# The children share place and scaling, as the pixels of a block of video share one motion vector. The offsets are $3k$ of the
# $3k + 6$ numbers in Eq. (1), so their size matters. $O$ counts in multiples of $l_a$: a small anchor and a large one of the same
# shape have the *same* offsets, and one rounding step serves both.

# %%
share = {k: 3 * k / (3 * k + 6) for k in (4, 10)}
print({k: f"{100 * s:.0f} % of the numbers in Eq. (1) are offsets" for k, s in share.items()})
O_a, l_a_of = inputs["O_a"], inputs["l_a"]
small, large = (offsets.forward(np.zeros((A, 3)), O_a, size * l_a_of)[0].x for size in (1, 100))
assert share[10] > share[4] > 0.5 and np.allclose(large, 100 * small, rtol=1e-14)

# %% [markdown]
# ## Exercises
# Replace the dots and the `raise` lines and run the cell. It compares with *golden vectors*: inputs and outputs that come with
# the project. **01.1** A second child of the anchor in "By hand" has offset $(0, 4, -0.5)$. Where is it? Give three numbers in a
# list. **01.2** Write Eq. (1) for arrays. **01.3** Write its backward; `cotangents` holds what arrives at outputs: `x_bar` at
# `x`.

# %%
answer_1 = ...


def my_forward(x_a, O_a, l_a):
    """x_a (A, 3), O_a (A, k, 3), l_a (A, 3) -> x (A, k, 3)."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"x_a", "O_a", "l_a"}: gradients, from cotangents["x_bar"] (A, k, 3)."""
    raise NotImplementedError


lessons.number("01.1", answer_1, x_a + np.array([0, 4, -0.5]) * l_a)
lessons.forward("01.2", my_forward, "offsets")
lessons.backward("01.3", my_backward, "offsets")

# %% [markdown]
# ## Check your port
# A *port* is the method written anew, in another language or framework. It reads the golden inputs and writes its outputs to a
# folder; `p4dgs-ref oracle check DIR --only offsets` judges them. From Python any function will do. The usual slip: Scaffold-GS,
# from which this equation comes, stores the logarithm of $l_a$; here $l_a$ is the scaling itself. The checker names the mistake.

# %%
from p4dgs_ref import oracle

print(oracle.check(lambda x_a, O_a, l_a: x_a[:, None] + O_a * l_a[:, None], "offsets"))
assert oracle.check(lambda x_a, O_a, l_a: x_a[:, None] + O_a * l_a[:, None], "offsets").ok
report = oracle.check(lambda x_a, O_a, l_a: x_a[:, None] + O_a * np.exp(l_a)[:, None], "offsets")
assert (
    "l_a is taken for a logarithm" in report.first.explanation
    and EQUATIONS["offsets"].number == "1"
)
print(report.first.explanation)
