# %% [markdown]
# # Eq. (9): the binary hash grid
#
# **Promise.** After this tutorial you can look up the context of an anchor by hand, including the
# hash, and send a gradient to a grid of which only the signs are used. **Before it:**
# `07_noise_and_rounding` for straight-through. **Takes** four seconds of machine time on two cores,
# 25 minutes of reading and 30 of exercises.
#
# **Files:** Eq. (9) [hash_grid.py](../p4dgs_ref/equations/hash_grid.py),
# [grid_nodes.py](../p4dgs_ref/equations/grid_nodes.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, panels, show, tour

plt = figures.pyplot()
architecture.show("09_hash_grid")
rng = np.random.default_rng(9)

# %% [markdown]
# ## What fails without it
# Without a context, the decoder must expect the same of every anchor: one guess for each number,
# and a spread as wide as that of all anchors together. The file then pays for differences between
# places. But the decoder knows where every anchor is, so it could have expected them.
#
# The left side shows one number of the features of the trained scene, number 14, over all anchors.
# The grey bell is what a decoder without context expects. The purple bell is what it expects of
# *anchor 29* with the context there. The bits are those of Eq. (11), which
# `10_prior_and_likelihood` explains. The right side shows the same number in space: anchors of one
# object are often alike.

# %%
from p4dgs_ref.equations import likelihood
from p4dgs_ref.report.inspect import float_context

model, thread, j = tour.MODEL, figures.THREAD, 14
context, numbers = float_context(model), model.anchors.f_a
mu, sigma = (values[:, : model.design.d] for values in context[1:])
q = np.repeat(context.q[:, :1], model.design.d, axis=1)
all_mu, all_sigma = 0 * q + numbers.mean(axis=0), 0 * q + numbers.std(axis=0)
without, _ = likelihood.forward(numbers, all_mu, all_sigma, q)
given, _ = likelihood.forward(numbers, mu, sigma, q)
print(
    f"{thread.name}: {without[thread.index, j]:.1f} bits, {given[thread.index, j]:.1f} with context"
)
print(f"all features: {without.sum() / 8:.0f} bytes, {given.sum() / 8:.0f} with context")
assert given.sum() < 0.8 * without.sum()

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
x = np.linspace(-2.5, 3, 300)
left.hist(numbers[:, j], 30, density=True, color=show.PALE)
for m, deviation, color in ((all_mu, all_sigma, show.GREY), (mu, sigma, thread.color)):
    z = (x - m[thread.index, j]) / deviation[thread.index, j]
    left.plot(x, np.exp(-(z**2) / 2) / deviation[thread.index, j] / np.sqrt(2 * np.pi), color=color)
left.axvline(numbers[thread.index, j], color=thread.color, ls=":")
left.set(xlabel="number 14 of a feature", ylabel="density", title="dotted: the number of anchor 29")
places = right.scatter(*model.anchors.x_a.T[:2], c=numbers[:, j], cmap="PuOr")
right.plot(*model.anchors.x_a[thread.index, :2], "s", ms=12, mfc="none", mec=thread.color, mew=3)
right.set(xlabel="x (scene units)", ylabel="y (scene units)", title="the same number in space")
figure.colorbar(places, ax=right)
figures.show(figure, "09_without_context")

# %% [markdown]
# ## Claim
# The steps of Eq. (8) and the probabilities of Eq. (12) are predicted from a context $h$, which the
# decoder can compute as well:
# $$h = \mathcal{H}(x_a) \tag{9}$$
# $\mathcal{H}$ is one grid in space and three grids in the planes $xy$, $xz$ and $yz$. Each node
# holds $F$ numbers, called *features*, that are $+1$ or $-1$.
#
# The paper says no more (Sec. 3.3). The rest is choice `Q11`, which follows two earlier methods:
# Instant-NGP, which introduced hash grids to graphics, and HAC, the codec of static scenes whose
# entropy model the paper follows. Each grid exists in several resolutions, called *levels*. Within
# a level, values are interpolated between the nodes, and $h$ contains the values of all levels side
# by side. The value of one level is
# $$h(x_a) = \sum_{c} w_c(x_a)\,\mathrm{sign}\,\theta_{i_c(x_a)}.$$
# Here $c$ runs over the corners of the cell around the anchor, and $w_c$ are the weights of
# multilinear interpolation. $i_c$ is the *entry* of the level's table in which the corner is
# stored. $\theta$ are the parameters of the level: real numbers of which only the sign is used.

# %% [markdown]
# ## By hand
# Take one level in the $xy$ plane with 2 nodes along each axis, over the unit square. The anchor at
# $(0.25, 0.5)$ lies at a quarter of the way along $x$ and halfway along $y$. Each weight is a
# product of one factor per axis, which gives 0.375, 0.125, 0.375 and 0.125 for the nodes $(0,0)$,
# $(1,0)$, $(0,1)$ and $(1,1)$. Let the parameters there be $0.3$, $-1$, $2$ and $1.5$. Their signs
# are $+ - + +$, so $h = 0.375 - 0.125 + 0.375 + 0.125 = 0.75$.
#
# A level is a table of $T$ entries. If all nodes fit into the table, node $(i, j, m)$ is in row
# $i + j\,\mathrm{res} + m\,\mathrm{res}^2$, where $\mathrm{res}$ is the number of nodes along an
# axis. If they do not fit, the nodes are *hashed*: each coordinate is multiplied by a constant of
# its axis ($1$, $2654435761$, $805459861$) modulo $2^{32}$, the products are joined by XOR, and the
# row is the result modulo $T$. For example, take the corner $(2, 3)$ and a table of 11 entries: $3$
# times the second constant wraps around to 3668339987, the XOR with $2$ is 3668339985, and the row
# is 2. Nodes with the same row share a parameter, which is called a *collision*.

# %%
from p4dgs_ref.equations import grid_nodes, hash_grid

theta = np.array([[0.3], [-1], [2], [1.5]])
unit_square = {"lo": np.zeros(3), "hi": np.ones(3), "resolutions": (("xy", 2),)}
h, _ = hash_grid.forward(np.array([[0.25, 0.5, 0.9]]), grids=[theta], **unit_square)
assert h == 0.75

product = 3 * 2654435761 % 2**32
print("product", product, "| XOR", product ^ 2, "| row", (product ^ 2) % 11)
corner, cell = np.array([[2, 3]]), np.array([[0, 0]])
assert grid_nodes.table_rows(corner, cell, 20, 11)[0, 0] == 2  # 20^2 nodes, 11 entries

# %% [markdown]
# ## In code
# The inputs are `x_a [A, 3]`, the corners `lo [3]` and `hi [3]` of a box around the anchors, and
# the list `grids` of parameters `[T, F]`, one array per level. `resolutions` describes each level
# by its axes and its number of nodes along an axis, for example `(("xyz", 3), ("xy", 5))`. The
# output is `h [A, I]`, level by level with $F$ features each, so $I$ is the number of levels times
# $F$. Positions are first scaled to their share of the box, $(x_a - lo)/(hi - lo)$, which lies
# between $0$ and $1$; in units of nodes the position is the share times $\mathrm{res} - 1$.
#
# The function `locate` finds the corners of all anchors in all levels. It puts their weights into
# one sparse matrix with a row for each anchor and level, and a column for each entry. Eq. (9) is
# then the product of this matrix and the signs. Each row adds up to 1, so $|h| \le 1$.

# %%
from p4dgs_ref.lessons import close, shift

# paper, Sec. 3.3: one grid in space, three in planes, of signs
# silent: Q11, how many nodes, how they are interpolated and hashed, and in which order
A, F = 40, 2
x_a = rng.uniform(-1, 1, (A, 3))
lo, hi = np.full(3, -1.0), np.full(3, 1.0)
resolutions = (("xyz", 5), ("xy", 9), ("xz", 9), ("yz", 9))
tables = [40, 81, 81, 81]  # the 125 nodes of the first level are hashed into 40 entries
grids = [rng.uniform(-1.2, 1.2, (T, F)) for T in tables]
levels = len(resolutions)
h, saved = hash_grid.forward(x_a, lo, hi, grids, resolutions)
located = grid_nodes.locate(x_a, lo, hi, resolutions, tables)
signs = np.where(np.concatenate(grids) >= 0, 1, -1)
assert located.shape == (A * levels, sum(tables))
assert close(located.sum(axis=1), 1)
assert close(h, (located @ signs).reshape(A, levels * F))

# %% [markdown]
# The figure shows the trained grid of `demo.p4dgs`, which has four levels: 8 nodes along each axis
# in space, and 16 along each axis of a plane. No two nodes share an entry. On the left is the first
# feature of the plane $xy$: the signs on its nodes, and the value that an anchor would read at each
# place. Anchor 29 is purple, with the four nodes of its cell. On the right is its $h$, two numbers
# for each level; "xy, 1" is what the left panel shows at its place.

# %%
x_29 = model.anchors.x_a[thread.index]
h_29, _ = hash_grid.forward(x_29[None], *model.box, model.grids, model.design.grid)
(x_0, y_0, z_0), (x_1, y_1, _) = model.box
x, y = np.meshgrid(np.linspace(x_0, x_1, 161), np.linspace(y_0, y_1, 161))
plane = np.stack([x, y, 0 * x + z_0], axis=-1).reshape(-1, 3)
values, _ = hash_grid.forward(plane, *model.box, model.grids, model.design.grid)

# %%
panels.signs_of_grid(model, x_29, values[:, 2].reshape(161, 161), h_29)

# %% [markdown]
# ## Backward by hand
# The forward has two steps, $\theta \to B = \mathrm{sign}\,\theta \to h$. The second one is linear.
# For one anchor and one feature,
# $$h = \sum_c w_c\,B_{i_c} \quad\Longrightarrow\quad
# \bar B_{i_c} \text{ receives } w_c\,\bar h \text{ from every corner } c.$$
# An entry adds up the contributions of all corners of all anchors that read it, each with the
# weight with which it was read. For all anchors and levels, the forward is the matrix times the
# signs, so the backward is the *transposed* matrix times the cotangent. Hashing needs no extra
# line, because a shared entry is merely a column with more nonzero weights.

# %%
h_bar = rng.normal(size=(A, levels * F))
B_bar = np.split(located.T @ h_bar.reshape(A * levels, F), np.cumsum(tables)[:-1])

# %% [markdown]
# The first step, the sign, has the slope 0 everywhere except at 0, where it has none. With this
# slope a grid would never learn. The backward therefore uses another one: it treats the sign as the
# identity as long as $|\theta| \le 1$, and as a constant beyond. This is the *straight-through*
# estimator with clipping.
# $$\bar\theta = \begin{cases} \bar B & |\theta| \le 1 \\ 0 & |\theta| > 1 \end{cases}$$

# %%
ours = hash_grid.backward(saved, h_bar)["grids"]
for gradient, bar, grid in zip(ours, B_bar, grids):
    assert close(gradient, bar * (np.abs(grid) <= 1))
slightly_larger = [1.0001 * grid for grid in grids]
unchanged, _ = hash_grid.forward(x_a, lo, hi, slightly_larger, resolutions)
assert np.array_equal(unchanged, h)

# %% [markdown]
# This gradient is not the derivative of Eq. (9), but we can still check it, because it is the exact
# gradient of another function. Replace the signs by
# $$B(\theta') = \mathrm{sign}\,\theta + \mathrm{clip}(\theta', \pm 1)
# - \mathrm{clip}(\theta, \pm 1),$$
# where $\theta$ are the current parameters. At $\theta' = \theta$ these are the signs, and the
# straight-through gradient is the true gradient with respect to $\theta'$. Such a function is
# called a *surrogate*.


# %%
def surrogate(parameters):
    """Return h with the surrogate of the signs, and nothing for a backward."""
    clipped = np.clip(np.concatenate(parameters), -1, 1)
    clipped_now = np.clip(np.concatenate(grids), -1, 1)
    return (located @ (signs + clipped - clipped_now)).reshape(A, levels * F), None


assert close(surrogate(grids)[0], h)
_ = lessons.adjoint(rng, surrogate, {"parameters": grids}, h_bar, {"parameters": ours}, 1e-8)

# %% [markdown]
# Does such a gradient help? In the next cell, each of the 40 anchors has two target numbers whose
# signs depend on its position. Gradient descent reduces the mean squared error to less than a
# tenth. With the true gradient, which is 0, nothing would change.

# %%
side = np.sign(x_a[:, :1] + 0.3 * x_a[:, 1:2])
targets = side * np.array([[0.8, -0.4]])
mean_over_levels = np.tile(np.eye(F), (levels, 1)) / levels
learned = [rng.uniform(-0.01, 0.01, (T, F)) for T in tables]
losses = []
for _ in range(500):
    h_now, saved_now = hash_grid.forward(x_a, lo, hi, learned, resolutions)
    error = h_now @ mean_over_levels - targets
    losses.append(np.mean(error**2))
    gradients = hash_grid.backward(saved_now, error @ mean_over_levels.T)["grids"]
    learned = shift(learned, gradients, -0.05)
print(f"mean squared error: {losses[0]:.3f} at the start, {losses[-1]:.3f} after training")
assert losses[-1] < losses[0] / 10

# %% [markdown]
# The positions receive no gradient, although the weights $w_c(x_a)$ have a slope. When the grid
# starts to learn, the positions are already rounded to their 16-bit grid and no longer change,
# because the decoder must look up exactly the same places.

# %%
from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.model import LATTICE, bounding_box, snap

assert EQUATIONS["hash_grid"].gradients == ("grids",)
symbols, _ = snap(x_a, *bounding_box(x_a))
assert symbols.min() == 0
assert symbols.max() == LATTICE == 2**16 - 1


# %% [markdown]
# ## Break it
# Suppose we forget that the hash wraps around at 32 bits, and multiply in 64 bits. The program
# runs, and its rows still lie in the table. If the size of the table is a power of two, the rows
# are even *right*, because the low bits are the same with and without wrapping. In a table of 6007
# entries, most rows are wrong. With HAC's table sizes, which are powers of two, a port with this
# mistake passes; with the first other size it fails. The golden vectors contain both kinds.


# %%
PRIMES = np.array([1, 2654435761, 805459861])


def without_wrapping(corner, res, table):
    D = corner.shape[1]
    if res**D <= table:
        return corner @ res ** np.arange(D)
    return np.bitwise_xor.reduce(corner * PRIMES[:D], axis=1) % table


case = lessons.golden("hash_index/table_of_no_power_of_two")
rows = without_wrapping(case["in.corner"], 10**6, 6007)
assert (rows >= 0).all()
assert (rows < 6007).all()
assert np.mean(rows != case["out.row"]) > 0.5

report = oracle.check(without_wrapping, "hash_index")
print("fails:", [r.id for r in report.results if r.verdict == "fail"])
assert report.first.id == "hash_index/table_of_no_power_of_two"
assert "hash_index/paper_3d" not in [r.id for r in report.results if r.verdict == "fail"]

# %% [markdown]
# ## What a codec does with it
# CABAC, the entropy coder of video standards, also takes its context from data that encoder and
# decoder both know. Here the grid is learned and is part of the file, so it must be cheap. A sign
# costs at most one bit. Grids of HAC's sizes have 1,766,224 signs, which is 0.21 MiB. Stored as
# `float32`, they would take 32 times as much. [See it move](viewer/demo.html#step=context): the
# signs of the demo's grid.

# %%
from p4dgs_ref.training.presets import PAPER_SYNTHETIC

entries_3d = sum(min(n**3, 2**13) for n in PAPER_SYNTHETIC.grid_3d)
entries_2d = 3 * sum(min(n**2, 2**15) for n in PAPER_SYNTHETIC.grid_2d)
signs_of_hac = (entries_3d + entries_2d) * PAPER_SYNTHETIC.F
assert signs_of_hac == 1_766_224
print(f"{signs_of_hac} signs take {signs_of_hac / 8 / 2**20:.2f} MiB")

# %% [markdown]
# ## What this idea buys
# In the figure, "one guess for all" is a grid with a single node: each number has one mean, one
# deviation and one step for all anchors. With the context, the anchors take 4,569 bytes instead of
# 5,126. But the grid and wider networks take 541 bytes more, so the whole file is as large as
# before, and the PSNR differs by less than it does between seeds: here the context buys nothing. (A
# file without grid, $\psi_p$ and $\psi_q$ would even be smaller, as the viewer says.) In the
# paper's T-Rex (Table 4), the grid takes 0.7 to 2.0 percent of the file, because it serves some
# hundred times as many anchors. The paper does not say how large the file would be without it.

# %%
from tutorials import gains

rows = {"one guess for all": "global prior", "context": "+ quantisation and entropy coding"}
assert [round(gains.mean(label, "gaussians_bytes")) for label in rows.values()] == [5126, 4569]
gains.show(
    "09_hash_grid",
    rows,
    {
        "hash grid, low rate": (0.003, "of 0.506 MB"),
        "hash grid, high rate": (0.018, "of 0.857 MB"),
    },
)

# %% [markdown]
# **In short**
# - The context $h$ of an anchor is read at its position, so the decoder has it before any bit of
#   its numbers is decoded.
# - Only signs are stored, one bit each at most; training moves real numbers behind them, with a
#   straight-through gradient.
# - Nodes that share an entry add their gradients to it. The backward needs no extra line for this.
#
# **Often misunderstood**
# - *The grid stores $h$.* It stores signs, and $h$ is interpolated between them, so neighbours get
#   similar contexts.
# - *The grid stores the scene.* It only says what to expect at a place, and how finely to round
#   there. The numbers of the anchors are coded apart from it.
# - *A collision is an error.* Encoder and decoder have the same collisions. The guesses become less
#   precise, but nothing is decoded wrongly.

# %% [markdown]
# ## Exercises
# **09.1** ● With the parameters of the section "By hand", what does an anchor at $(0.75, 0.25)$
# read?
#
# **09.2** ●● Write the row of a corner: dense if the $\mathrm{res}^D$ nodes fit into the table,
# otherwise hashed as in "By hand". The type `uint32` wraps around by itself.
#
# **09.3** ●● Write the backward of Eq. (9). It needs two lines of "Backward by hand", and
# `np.split` to cut the rows into levels.
#
# **Predict, then run.** All parameters of the grid are multiplied by $1000$. What happens to $h$,
# and what to the gradients?

# %%
answer_1 = ...


def my_row(corner, res, table):
    """Return the row [N], as integers, of each corner [N, D] of a level, where D is 2 or 3.

    The level has `res` nodes along each axis and a table of `table` entries.
    """
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return {"grids": list of gradients [T, F]}, given cotangents["h_bar"] [A, I].

    inputs["grids"] are the parameters. The other inputs are the arguments of
    `grid_nodes.locate(x_a, lo, hi, resolutions, tables)`, where `tables` is the list of all T. It
    returns the matrix of weights, with a row for each anchor and level [A levels, sum of all T].
    """
    raise NotImplementedError


lessons.check_number("09.1", answer_1)
lessons.check_forward("09.2", my_row, "hash_index")
lessons.check_backward("09.3", my_backward, "hash_grid")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only hash_grid` compares what a port wrote. Check `--only
# hash_index` and `--only grid_cell` first. The usual mistakes are $\mathrm{res}$ times the share of
# the box in place of $\mathrm{res} - 1$ times, another order of the planes (the paper's text names
# $xy$, $yz$, $xz$, but here $xz$ comes before $yz$), and the sign of zero, which counts as $+1$.

# %%
lessons.passes("hash_grid")
zeros = np.array([[0.0], [0], [-0.0], [0]])
h, _ = hash_grid.forward(np.zeros((1, 3)), grids=[zeros], **unit_square)
assert h == 1
