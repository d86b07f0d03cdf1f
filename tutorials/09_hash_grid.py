# %% [markdown]
# # Eq. (9): the binary hash grid
#
# **Promise.** After this you can look an anchor up by hand, hash included, and send a gradient to a grid that knows only signs.
# **Before it:** `07_noise_and_rounding` for straight-through. **Takes** two seconds on two cores, forty minutes of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.equations import grid_nodes, hash_grid
from p4dgs_ref.school import lessons

plt = lessons.pyplot()
rng = np.random.default_rng(9)

# %% [markdown]
# ## Claim
# Steps, Eq. (8), and priors, Eq. (12), are predicted from a context that the decoder has as well:
# $$h = \mathcal{H}(x_a) \tag{9}$$
# $\mathcal{H}$ is one grid in space and three in planes ($xy$, $xz$, $yz$). Each node holds $F$ numbers, *features*, that are
# $+1$ or $-1$.

# %% [markdown]
# The paper prints no more. The rest is choice Q11, from Instant-NGP, which brought hash grids into graphics, and HAC, the codec
# of still scenes whose prior the paper follows: each grid in several resolutions, *levels*; between the nodes of a level one
# interpolates; and $h$ is what all levels say, side by side. Level $l$ says
# $$h_l(x_a) = \sum_{c} w_c(x_a)\,\mathrm{sign}\,\theta^l_{i_c(x_a)}$$

# %% [markdown]
# $c$ runs over the corners of the cell around the anchor, $w_c$ are multilinear weights, $i_c$ says in which *entry* of its
# level a corner is stored, and $\theta^l$ are that level's parameters: real numbers of which only the sign counts.

# %% [markdown]
# ## By hand
# One level in the plane with 2 nodes an axis, over the unit square. The anchor at $(0.25, 0.5)$ lies a quarter along $x$, half
# along $y$. A weight is a product of one factor an axis: 0.375, 0.125, 0.375, 0.125 for $(0,0)$, $(1,0)$, $(0,1)$, $(1,1)$.
# The parameters there are $0.3$, $-1$, $2$, $1.5$. Only signs count: $+ - + +$, and $h = 0.75$.

# %%
w = [0.75 * 0.5, 0.25 * 0.5, 0.75 * 0.5, 0.25 * 0.5]
theta = np.array([0.3, -1, 2, 1.5])
assert w == [0.375, 0.125, 0.375, 0.125] and len({0, 1}) == 2
assert sum(v * s for v, s in zip(w, np.sign(theta))) == 0.75

# %% [markdown]
# A level is a table of $T$ entries. If it has room for all nodes, node $(i, j, k)$ is in row $i + j\,res + k\,res^2$, with $res$
# nodes an axis. If not, nodes are *hashed*: each coordinate times a number of its axis ($1$, $2654435761$, $805459861$), modulo
# $2^{32}$, all joined by XOR, modulo $T$. The corner $(2, 3)$ in a table of 11: $3$ times the second number wraps to
# 3668339987, XOR with $2$ gives 3668339985, and the row is 2.

# %%
product = 3 * 2654435761 % 2**32
assert product == 3668339987 and product ^ 2 == 3668339985 and 3668339985 % 11 == 2

# %% [markdown]
# ## In code
# `x_a (A, 3)`, a box `lo, hi (3,)` around them, `grids` a list of `(T, F)` parameters, one for each level of `resolutions`,
# such as `(("xyz", 3), ("xy", 5))`: axes, and nodes an axis. Out comes `h (A, L F)`: level by level, then feature.
# A position is $u = (x_a - lo)/(hi - lo)$, between $0$ and $1$ inside the box; in units of nodes it is $u\,(res - 1)$.

# %%
square = dict(lo=np.zeros(3), hi=np.ones(3), resolutions=(("xy", 2),))
h = hash_grid.forward(np.array([[0.25, 0.5, 0.9]]), grids=[theta[:, None]], **square)[0].h
assert h.shape == (1, 1) and h[0, 0] == 0.75
hashed = grid_nodes.entries(
    np.array([[2, 3]]), np.array([[0, 0]]), 20, 11
)  # 20^2 nodes, 11 entries
assert hashed[0, 0] == 2

# %% [markdown]
# Look at `locate`: it finds all corners of all anchors in all levels at once and puts their weights into one sparse matrix,
# rows (anchor, level), columns entries. Eq. (9) is then a product, `located @ signs`. Each row adds up to 1, so $|h| \le 1$.

# %%
A, F = 40, 2
resolutions = (("xyz", 5), ("xy", 9), ("xz", 9), ("yz", 9))
tables = [40, 81, 81, 81]  # 125 nodes hashed into 40 entries
x_a, lo, hi = rng.uniform(-1, 1, (A, 3)), np.full(3, -1.0), np.full(3, 1.0)
grids = [rng.uniform(-1.2, 1.2, (T, F)) for T in tables]
out, res = hash_grid.forward(x_a, lo, hi, grids, resolutions)
L = len(resolutions)
assert out.h.shape == (A, L * F) and res.located.shape == (A * L, sum(tables))
assert np.allclose(res.located.sum(axis=1), 1, rtol=1e-14) and np.abs(out.h).max() <= 1

# %% [markdown]
# The picture of a plane: the signs on its nodes, and what any anchor there would read. Right, a level of 25 nodes that has
# 11 entries: in each circle the row of its entry. Equal rows share a parameter (three of them in colour): a *collision*.

# %%
coarse = rng.uniform(-1, 1, (25, 1))
place = np.linspace(0, 1, 161)
points = np.stack([*np.meshgrid(place, place), np.zeros((161, 161))], axis=-1).reshape(-1, 3)
seen = hash_grid.forward(points, np.zeros(3), np.ones(3), [coarse], (("xy", 5),))[0].h.reshape(
    161, 161
)
corner = np.stack(np.meshgrid(np.arange(5), np.arange(5)), axis=-1).reshape(-1, 2)
row = grid_nodes.entries(corner, np.zeros((1, 2), int), 5, 11)[:, 0]
assert len(corner) == 25 and 1 < len(set(row)) <= 11

figure, axes = plt.subplots(1, 2, figsize=(12.5, 5.4), layout="constrained")
image = axes[0].imshow(
    seen, origin="lower", extent=(0, 4, 0, 4), cmap="PuOr", vmin=-1, vmax=1, alpha=0.75
)
for sign, marker in ((1, "P"), (-1, "s")):
    axes[0].plot(
        *corner[np.where(coarse[:, 0] >= 0, 1, -1) == sign].T,
        marker,
        ms=15,
        mew=1.5,
        color="k" if sign > 0 else "w",
        mec="k",
        ls="",
        label=f"node of sign {sign:+d}",
    )
figure.colorbar(image, ax=axes[0], label="h (no unit)", shrink=0.85)
axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
axes[0].set(title="Signs on the nodes, means between them", xlim=(-0.35, 4.35), ylim=(-0.35, 4.35))
shared = np.array([np.count_nonzero(row == r) for r in row])
crowded = sorted(set(row), key=lambda r: -np.count_nonzero(row == r))[:3]
for r in set(row):
    color = lessons.COLORS[(5, 4, 3)[crowded.index(r)]] if r in crowded else "white"
    axes[1].plot(*corner[row == r].T, "o", ms=30, color=color, mec="0.3", ls="")
for (i, j), r in zip(corner, row):
    axes[1].text(i, j, r, ha="center", va="center", fontsize=13)
axes[1].set(
    title=f"25 nodes, 11 entries: {np.count_nonzero(shared > 1)} nodes share theirs",
    aspect="equal",
    xlim=(-0.6, 4.6),
    ylim=(-0.6, 4.6),
)
for ax in axes:
    ax.set(xlabel="node along x", ylabel="node along y", xticks=range(5), yticks=range(5))
    ax.grid(False)
lessons.show(figure, "09_hash_grid")

# %% [markdown]
# ## Backward by hand
# Two steps, in the order $\theta \to b = \mathrm{sign}\,\theta \to h$. The second is linear. One anchor, one feature:
# $$h = \sum_c w_c\,b_{i_c} \quad\Longrightarrow\quad \bar b_{i_c} \mathrel{+}= w_c\,\bar h$$
# An entry collects from every corner of every anchor that read it, weighted as it was read.

# %% [markdown]
# With all anchors and levels: forward is the matrix times the signs, so backward is its *transpose* times the cotangent.
# In code: `res.located.T @ h_bar.reshape(-1, F)`. Hashing needs no line of its own: a shared entry is a column with more in it.

# %%
h_bar = rng.normal(size=(A, L * F))
b_bar = [np.zeros((T, F)) for T in tables]
for level, ((axes_, res_), T) in enumerate(zip(resolutions, tables)):
    index, weight = grid_nodes.nodes(x_a, lo, hi, axes_, res_, T)  # (A, 2^D) each
    for a in range(A):
        for i, w_c in zip(index[a], weight[a]):
            b_bar[level][i] += w_c * h_bar[a, level * F : (level + 1) * F]
assert np.allclose(
    res.located.T @ h_bar.reshape(-1, F), np.concatenate(b_bar), rtol=1e-12, atol=1e-14
)

# %% [markdown]
# The first step, the sign, has slope 0 everywhere but at 0. Told the truth, a grid would never learn. So the backward tells a
# lie: it takes the sign for the identity, as long as $|\theta| \le 1$ (*straight through*, of a clipped parameter).
# $$\bar\theta = \begin{cases} \bar b & |\theta| \le 1 \\ 0 & |\theta| > 1 \end{cases}$$

# %%
bars = hash_grid.backward(res, h_bar)["grids"]
for bar, b, grid in zip(bars, b_bar, grids):
    assert np.allclose(bar, b * (np.abs(grid) <= 1), rtol=1e-12, atol=1e-14)
still = hash_grid.forward(x_a, lo, hi, [g * 1.0001 for g in grids], resolutions)[0].h
assert np.abs(still - out.h).max() == 0  # the truth: no slope

# %% [markdown]
# A lie can still be checked: it is the exact gradient of something else. `surrogate` is Eq. (9) with other numbers for signs,
# $b(\theta') = \mathrm{sign}\,\theta + \mathrm{clip}(\theta', \pm 1) - \mathrm{clip}(\theta, \pm 1)$. At
# $\theta' = \theta$ they are the signs, and our gradient is the true one in $\theta'$.

# %%
smooth = hash_grid.surrogate(x_a, lo, hi, grids, resolutions)
d = [rng.normal(size=g.shape) for g in grids]
up, down = (smooth(grids=[g + s * 1e-6 * e for g, e in zip(grids, d)]).h for s in (1, -1))
difference, gradient = (
    (h_bar * (up - down)).sum() / 2e-6,
    sum((b * e).sum() for b, e in zip(bars, d)),
)
assert np.allclose(smooth(grids=grids).h, out.h, atol=1e-14) and abs(
    difference - gradient
) < 1e-8 * abs(gradient)
print(f"surrogate by differences {difference:.8f}, by gradient {gradient:.8f}")

# %% [markdown]
# Does the lie help? Let 40 anchors wish for two numbers whose signs depend on where they stand, and descend. The squared miss
# falls below a tenth; with the true gradient nothing would move. A parameter beyond $\pm 1$ receives nothing: its sign stays.

# %%
wish = np.sign(x_a[:, :1] + 0.3 * x_a[:, 1:2]) * np.array([[0.8, -0.4]])
mix = np.tile(np.eye(F), (L, 1)) / L  # each feature: the mean over the levels
learnt, losses = [rng.uniform(-0.01, 0.01, (T, F)) for T in tables], []
for _ in range(300):
    o, r = hash_grid.forward(x_a, lo, hi, learnt, resolutions)
    miss = o.h @ mix - wish
    losses.append(np.mean(miss**2))
    learnt = [g - 0.05 * b for g, b in zip(learnt, hash_grid.backward(r, miss @ mix.T)["grids"])]
assert A == 40 and losses[-1] < losses[0] / 10
assert any((np.abs(g) > 1).any() for g in grids) and not any(
    b[np.abs(g) > 1].any() for b, g in zip(bars, grids)
)
print(f"mean squared miss: {losses[0]:.3f} at the start, {losses[-1]:.3f} after training")

# %% [markdown]
# Positions receive nothing, though $w_c(x_a)$ has a slope: when the grid starts to learn they are frozen on a 16-bit lattice,
# because the decoder must look up the very same place.

# %%
from p4dgs_ref.model import LATTICE, bounding_box, snap

assert EQUATIONS["hash_grid"].differentiable == ("grids",) and LATTICE == 2**16 - 1
symbols, snapped = snap(x_a, *bounding_box(x_a))
assert symbols.min() == 0 and symbols.max() == LATTICE


# %% [markdown]
# ## Break it
# Forget that the hash wraps at 32 bits, and multiply in 64. The program runs, and its rows still lie in the table.
# Where its size is a power of two, they are even *right*: low bits never see the wrap. With 6007 entries most rows are wrong.


# %%
def row_without_wrap(corner, table):
    return np.bitwise_xor.reduce(corner * np.array([1, 2654435761, 805459861]), axis=-1) % table


case = lessons.golden("hash_index/table_of_no_power_of_two")
right, wrong = case["out.row"], row_without_wrap(case["in.corner"], 6007)
assert (0 <= wrong).all() and (wrong < 6007).all() and np.mean(wrong != right) > 0.5
paper = lessons.golden("hash_index/paper_3d")
assert np.array_equal(row_without_wrap(paper["in.corner"], 2**13), paper["out.row"])
assert (np.int64(1).nbytes * 8, np.uint32(1).nbytes * 8) == (64, 32)

# %% [markdown]
# So a port can pass with all of HAC's table sizes, powers of two, and fail with the first other one. The vectors hold both kinds.


# %%
def wide(corner, res, table):
    D = corner.shape[1]
    return (
        corner @ res ** np.arange(D)
        if res**D <= table
        else np.bitwise_xor.reduce(corner * np.array([1, 2654435761, 805459861])[:D], axis=1)
        % table
    )


report = oracle.check(wide, "hash_index")
assert not report.ok and report.first.id == "hash_index/table_of_no_power_of_two"
print("fails:", [r.id for r in report.results if r.verdict == "fail"])

# %% [markdown]
# ## What a codec does with it
# Context from what both sides know is how CABAC works; here the context is learnt and sent, so it must be cheap. A sign
# costs at most one bit. Grids of HAC's sizes would have 1,766,224 signs: 0.21 MiB, and 32 times that as `float32`.

# %%
from p4dgs_ref.training.presets import PAPER_SYNTHETIC as paper

entries = sum(min(res**3, 2**13) for res in paper.grid_3d) + 3 * sum(
    min(res**2, 2**15) for res in paper.grid_2d
)
assert (
    entries * paper.F == 1766224
    and round(1766224 / 8 / 2**20, 2) == 0.21
    and np.float32(0).nbytes * 8 == 32
)

# %% [markdown]
# ## Exercises
# **09.1** With the parameters of the section by hand, what does an anchor at $(0.75, 0.25)$ read?
# **09.2** Write the row of a corner: dense where $res^D \le T$, else hashed, as by hand (`uint32` wraps by itself).
# **09.3** Write the backward of Eq. (9): two lines of the section above, and a cut of the rows into levels (`np.split`).

# %%
answer_1 = ...


def my_row(corner, res, table):
    """corner (N, D) of a level with res nodes an axis and a table of `table` entries -> row (N,) of integers; D is 2 or 3."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"grids": [(T, F), ...]}, from cotangents["h_bar"] (A, L F), inputs["grids"] and the other arguments of
    `hash_grid.locate`, which finds the weights (A L, sum of T); its `tables` is the list of T."""
    raise NotImplementedError


lessons.number(
    "09.1",
    answer_1,
    hash_grid.forward(np.array([[0.75, 0.25, 0]]), grids=[theta[:, None]], **square)[0].h[0, 0],
)
lessons.forward("09.2", my_row, "hash_index")
lessons.backward("09.3", my_backward, "hash_grid")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only hash_grid`, and before it `--only hash_index` and `--only grid_cell`. What goes wrong:
# $u\,res$ for $u\,(res - 1)$; planes in the order of the paper's text, $xy$, $yz$, $xz$ (here $xz$ comes before $yz$);
# and zero, which counts as $+1$.

# %%
print(oracle.check(lambda **inputs: hash_grid.forward(**inputs)[0], "hash_grid"))
assert oracle.check(lambda **inputs: hash_grid.forward(**inputs)[0], "hash_grid").ok
assert (
    hash_grid.forward(np.zeros((1, 3)), grids=[np.array([[0.0], [0], [-0.0], [0]])], **square)[0].h
    == 1
).all()
