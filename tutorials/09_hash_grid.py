# %% [markdown]
# # Eq. (9): the binary hash grid
#
# **Promise.** After this tutorial you can look up an anchor by hand, including the hash, and send a
# gradient to a grid of which only the signs are used. **Before it:** `07_noise_and_rounding` for
# straight-through. **Takes** two seconds of machine time on two cores, 25 minutes of reading and 30
# of exercises.
#
# **Files:** Eq. (9) [hash_grid.py](../p4dgs_ref/equations/hash_grid.py),
# [grid_nodes.py](../p4dgs_ref/equations/grid_nodes.py).

# %%
import numpy as np

from p4dgs_ref import lessons

plt = lessons.begin()
from tutorials.tools import architecture

architecture.show("09_hash_grid")
rng = np.random.default_rng(9)

# %% [markdown]
# ## Claim
# The steps of Eq. (8) and the probabilities of Eq. (12) are predicted from a context that the
# decoder has as well:
# $$h = \mathcal{H}(x_a) \tag{9}$$
# $\mathcal{H}$ is one grid in space and three grids in the planes $xy$, $xz$ and $yz$. Each node
# holds $F$ numbers, called *features*, that are $+1$ or $-1$.
#
# The paper prints no more. The rest is choice `Q11`. It follows Instant-NGP, which introduced hash
# grids to graphics, and HAC, the codec of static scenes whose entropy model the paper follows. Each
# grid exists in several resolutions, called *levels*. Within a level, values are interpolated
# between the nodes, and $h$ contains the values of all levels side by side. The value of level $l$
# is
# $$h_l(x_a) = \sum_{c} w_c(x_a)\,\mathrm{sign}\,\theta^l_{i_c(x_a)}.$$
# Here $c$ runs over the corners of the cell around the anchor, and $w_c$ are the weights of
# multilinear interpolation. $i_c$ is the *entry* of the level's table in which the corner is
# stored. $\theta^l$ are the parameters of the level: real numbers of which only the sign is used.

# %% [markdown]
# ## By hand
# Take one level in the $xy$ plane with 2 nodes along each axis, over the unit square. The anchor at
# $(0.25, 0.5)$ lies at a quarter of the way along $x$ and halfway along $y$. Each weight is a
# product of one factor per axis, which gives 0.375, 0.125, 0.375 and 0.125 for the nodes $(0,0)$,
# $(1,0)$, $(0,1)$ and $(1,1)$. Let the parameters there be $0.3$, $-1$, $2$ and $1.5$. Their signs
# are $+ - + +$, so $h = 0.375 - 0.125 + 0.375 + 0.125 = 0.75$.
#
# A level is a table of $T$ entries. If all nodes fit into the table, node $(i, j, k)$ is in row
# $i + j\,n + k\,n^2$, where $n$ is the number of nodes along an axis. If they do not, the nodes are
# *hashed*. Each coordinate is multiplied by a constant of its axis ($1$, $2654435761$, $805459861$)
# modulo $2^{32}$, the products are joined by XOR, and the row is the result modulo $T$. For the
# corner $(2, 3)$ and a table of 11 entries, $3$ times the second constant wraps around to
# 3668339987, the XOR with $2$ is 3668339985, and the row is 2.

# %%
from p4dgs_ref.equations import grid_nodes, hash_grid

theta = np.array([[0.3], [-1], [2], [1.5]])
unit_square = {"lo": np.zeros(3), "hi": np.ones(3), "resolutions": (("xy", 2),)}
h, _ = hash_grid.forward(np.array([[0.25, 0.5, 0.9]]), grids=[theta], **unit_square)
assert h == 0.75

product = 3 * 2654435761 % 2**32
print("product", product, "| XOR", product ^ 2, "| row", (product ^ 2) % 11)
corner, cell = np.array([[2, 3]]), np.array([[0, 0]])
assert grid_nodes.entries(corner, cell, 20, 11)[0, 0] == 2  # 20^2 nodes, 11 entries

# %% [markdown]
# ## In code
# The inputs are `x_a [A, 3]`, the corners `lo [3]` and `hi [3]` of a box around the anchors, and
# the list `grids` of parameters `[T, F]`, one array per level. `resolutions` describes each level
# by its axes and its number of nodes along an axis, for example `(("xyz", 3), ("xy", 5))`. The
# output is `h [A, L F]`, level by level with $F$ features each. Positions are first scaled to
# $u = (x_a - lo)/(hi - lo)$, which lies between $0$ and $1$ inside the box; in units of nodes the
# position is $u\,(n - 1)$.
#
# The function `locate` finds the corners of all anchors in all levels. It puts their weights into
# one sparse matrix with a row for each anchor and level, and a column for each entry. Eq. (9) is
# then the product of this matrix and the signs. Each row adds up to 1, so $|h| \le 1$.

# %%
from p4dgs_ref.lessons import close, moved

A, F = 40, 2
x_a = rng.uniform(-1, 1, (A, 3))
lo, hi = np.full(3, -1.0), np.full(3, 1.0)
resolutions = (("xyz", 5), ("xy", 9), ("xz", 9), ("yz", 9))
tables = [40, 81, 81, 81]  # the 125 nodes of the first level are hashed into 40 entries
grids = [rng.uniform(-1.2, 1.2, (T, F)) for T in tables]
L = len(resolutions)
h, saved = hash_grid.forward(x_a, lo, hi, grids, resolutions)
located = grid_nodes.locate(x_a, lo, hi, resolutions, tables)
signs = np.where(np.concatenate(grids) >= 0, 1, -1)
assert located.shape == (A * L, sum(tables))
assert close(located.sum(axis=1), 1)
assert close(h, (located @ signs).reshape(A, L * F))

# %% [markdown]
# The left panel of the figure shows a level in a plane: the signs on its nodes, and the value that
# an anchor would read at each place. The right panel shows a level of 25 nodes with 11 entries.
# Each circle contains the row of its entry. Nodes with the same row share a parameter, which is
# called a *collision*; three of these groups are in colour.

# %%
coarse = rng.uniform(-1, 1, (25, 1))
place = np.linspace(0, 1, 161)
u, v = np.meshgrid(place, place)
points = np.stack([u, v, 0 * u], axis=-1).reshape(161 * 161, 3)
values, _ = hash_grid.forward(points, np.zeros(3), np.ones(3), [coarse], (("xy", 5),))
corner = np.stack(np.meshgrid(np.arange(5), np.arange(5)), axis=-1).reshape(25, 2)
row = grid_nodes.entries(corner, np.zeros((1, 2), int), 5, 11)[:, 0]
assert 1 < len(set(row)) <= 11

# %%
figure, (left, right) = plt.subplots(
    1,
    2,
    figsize=(12.5, 5.4),
    layout="constrained",
)
image = left.imshow(
    values.reshape(161, 161),
    origin="lower",
    extent=(0, 4, 0, 4),
    cmap="PuOr",
    vmin=-1,
    vmax=1,
    alpha=0.75,
)
node_sign = np.where(coarse[:, 0] >= 0, 1, -1)
for sign, marker, color in ((1, "P", "k"), (-1, "s", "w")):
    i, j = corner[node_sign == sign].T
    left.plot(
        i,
        j,
        marker,
        ms=15,
        mew=1.5,
        color=color,
        mec="k",
        ls="",
        label=f"node with sign {sign:+d}",
    )
figure.colorbar(
    image,
    ax=left,
    label="h (no unit)",
    shrink=0.85,
)
lessons.finish(
    left,
    title="Signs on the nodes, weighted means between them",
    xlim=(-0.35, 4.35),
    ylim=(-0.35, 4.35),
    legend={"loc": "upper center", "bbox_to_anchor": (0.5, -0.14), "ncols": 2},
)

rows, counts = np.unique(row, return_counts=True)
crowded = rows[np.argsort(-counts)][:3]
colors = dict(zip(crowded, (lessons.COLORS[5], lessons.COLORS[4], lessons.COLORS[3])))
for r in rows:
    i, j = corner[row == r].T
    right.plot(
        i,
        j,
        "o",
        ms=30,
        color=colors.get(r, "white"),
        mec="0.3",
        ls="",
    )
for (i, j), r in zip(corner, row):
    right.text(
        i,
        j,
        r,
        ha="center",
        va="center",
        fontsize=13,
    )
right.set(
    title=f"25 nodes, 11 entries: {counts[counts > 1].sum()} nodes share theirs",
    aspect="equal",
    xlim=(-0.6, 4.6),
    ylim=(-0.6, 4.6),
)
for ax in (left, right):
    lessons.finish(
        ax,
        xlabel="node along x",
        ylabel="node along y",
        xticks=range(5),
        yticks=range(5),
        grid=False,
    )
lessons.show(figure, "09_hash_grid")

# %% [markdown]
# ## Backward by hand
# The forward has two steps, $\theta \to b = \mathrm{sign}\,\theta \to h$. The second one is linear.
# For one anchor and one feature,
# $$h = \sum_c w_c\,b_{i_c} \quad\Longrightarrow\quad
# \bar b_{i_c} \text{ receives } w_c\,\bar h \text{ from every corner } c.$$
# An entry adds up the contributions of every corner of every anchor that read it, with the same
# weight with which it was read. For all anchors and levels, the forward is the matrix times the
# signs, so the backward is the *transposed* matrix times the cotangent. Hashing needs no extra
# line, because a shared entry is merely a column with more nonzero weights. The cell compares the
# matrix product with a loop over the corners.

# %%
h_bar = rng.normal(size=(A, L * F))
b_bar = [np.zeros((T, F)) for T in tables]
for level, (axes, n) in enumerate(resolutions):
    entries, corner_weights = grid_nodes.nodes(x_a, lo, hi, axes, n, tables[level])
    of_level = h_bar[:, level * F : (level + 1) * F]
    for a in range(A):
        for i, w in zip(entries[a], corner_weights[a]):
            b_bar[level][i] += w * of_level[a]
by_matrix = located.T @ h_bar.reshape(A * L, F)
assert close(by_matrix, np.concatenate(b_bar))

# %% [markdown]
# The first step, the sign, has the slope 0 everywhere except at 0, where it has none. With this
# slope a grid would never learn. The backward therefore uses another one: it treats the sign as the
# identity as long as $|\theta| \le 1$, and as a constant beyond. This is the *straight-through*
# estimator with clipping.
# $$\bar\theta = \begin{cases} \bar b & |\theta| \le 1 \\ 0 & |\theta| > 1 \end{cases}$$

# %%
ours = hash_grid.backward(saved, h_bar)["grids"]
for gradient, b, grid in zip(ours, b_bar, grids):
    assert close(gradient, b * (np.abs(grid) <= 1))
slightly_larger = [1.0001 * grid for grid in grids]
unchanged, _ = hash_grid.forward(x_a, lo, hi, slightly_larger, resolutions)
assert np.array_equal(unchanged, h)

# %% [markdown]
# This gradient is not the derivative of Eq. (9), but we can still check it, because it is the exact
# gradient of another function. Replace the signs by
# $$b(\theta') = \mathrm{sign}\,\theta + \mathrm{clip}(\theta', \pm 1)
# - \mathrm{clip}(\theta, \pm 1),$$
# where $\theta$ are the current parameters. At $\theta' = \theta$ these are the signs, and the
# straight-through gradient is the true gradient with respect to $\theta'$. Such a function is
# called a *surrogate*.


# %%
def surrogate(parameters):
    """Return h with the surrogate of the signs, and nothing for a backward."""
    clipped = np.clip(np.concatenate(parameters), -1, 1)
    clipped_now = np.clip(np.concatenate(grids), -1, 1)
    return (located @ (signs + clipped - clipped_now)).reshape(A, L * F), None


assert close(surrogate(grids)[0], h)
_ = lessons.adjoint(rng, surrogate, {"parameters": grids}, h_bar, {"parameters": ours}, 1e-8)

# %% [markdown]
# Does such a gradient help? In the next cell, each of the 40 anchors has two target numbers whose
# signs depend on its position. Gradient descent reduces the mean squared error to less than a
# tenth. With the true gradient nothing would move.

# %%
side = np.sign(x_a[:, :1] + 0.3 * x_a[:, 1:2])
targets = side * np.array([[0.8, -0.4]])
mean_over_levels = np.tile(np.eye(F), (L, 1)) / L
learned = [rng.uniform(-0.01, 0.01, (T, F)) for T in tables]
losses = []
for _ in range(300):
    h_now, saved_now = hash_grid.forward(x_a, lo, hi, learned, resolutions)
    error = h_now @ mean_over_levels - targets
    losses.append(np.mean(error**2))
    gradients = hash_grid.backward(saved_now, error @ mean_over_levels.T)["grids"]
    learned = moved(learned, gradients, -0.05)
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
# entries, most rows are wrong. A port can therefore pass with all table sizes of HAC, which are
# powers of two, and fail with the first other size. The golden vectors contain both kinds.


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
# CABAC, the entropy coder of video standards, also takes its context from what encoder and decoder
# both know. Here the context is learned and sent, so it must be cheap. A sign costs at most one
# bit. Grids of HAC's sizes have 1,766,224 signs, which is 0.21 MiB. Stored as `float32`, they would
# take 32 times as much. [See it move](viewer/demo.html#step=6): the signs of the demo's grid.

# %%
from p4dgs_ref.training.presets import PAPER_SYNTHETIC

entries_3d = sum(min(n**3, 2**13) for n in PAPER_SYNTHETIC.grid_3d)
entries_2d = 3 * sum(min(n**2, 2**15) for n in PAPER_SYNTHETIC.grid_2d)
signs_of_hac = (entries_3d + entries_2d) * PAPER_SYNTHETIC.F
assert signs_of_hac == 1_766_224
print(f"{signs_of_hac} signs take {signs_of_hac / 8 / 2**20:.2f} MiB")

# %% [markdown]
# ## Exercises
# **09.1** ● With the parameters of the section "By hand", what does an anchor at $(0.75, 0.25)$
# read?
#
# **09.2** ●● Write the row of a corner: dense if the $n^D$ nodes fit into the table, otherwise
# hashed as in "By hand". The type `uint32` wraps around by itself.
#
# **09.3** ●● Write the backward of Eq. (9). It needs two lines of the section above, and `np.split`
# to cut the rows into levels.
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
    """Return {"grids": list of gradients [T, F]}, given cotangents["h_bar"] [A, L F].

    inputs["grids"] are the parameters. The other inputs are the arguments of
    `grid_nodes.locate(x_a, lo, hi, resolutions, tables)`, where `tables` is the list of all T. It
    returns the matrix of weights [A L, sum of all T].
    """
    raise NotImplementedError


lessons.check_number("09.1", answer_1)
lessons.check_forward("09.2", my_row, "hash_index")
lessons.check_backward("09.3", my_backward, "hash_grid")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only hash_grid` compares what a port wrote. Check
# `--only hash_index` and `--only grid_cell` first. The usual mistakes are $u\,n$ in place of
# $u\,(n - 1)$, another order of the planes (the paper's text names $xy$, $yz$, $xz$, but here $xz$
# comes before $yz$), and the sign of zero, which counts as $+1$.

# %%
lessons.passes("hash_grid")
zeros = np.array([[0.0], [0], [-0.0], [0]])
h, _ = hash_grid.forward(np.zeros((1, 3)), grids=[zeros], **unit_square)
assert h == 1
