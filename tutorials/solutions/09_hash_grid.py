# %% [markdown]
# # Solutions to Eq. (9)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import grid_nodes, hash_grid

# %% [markdown]
# **09.1** The anchor lies at three quarters along $x$ and one quarter along $y$. The weights are
# $\frac{3}{16}, \frac{9}{16}, \frac{1}{16}, \frac{3}{16}$, and the signs are $+ - + +$.

# %%
theta = np.array([[0.3], [-1], [2], [1.5]])
place = np.array([[0.75, 0.25, 0]])
by_hand, _ = hash_grid.forward(place, np.zeros(3), np.ones(3), [theta], (("xy", 2),))
lessons.check_number("09.1", 3 / 16 - 9 / 16 + 1 / 16 + 3 / 16, by_hand[0, 0])


# %% [markdown]
# **09.2** A dense row is $i + j\,\mathrm{res} + m\,\mathrm{res}^2$, so the first axis counts
# fastest. For the hash, `uint32` wraps around by itself.


# %%
PRIMES = np.array([1, 2654435761, 805459861], np.uint32)


def my_row(corner, res, table):
    D = corner.shape[1]
    if res**D <= table:
        return corner @ res ** np.arange(D)
    products = corner.astype(np.uint32) * PRIMES[:D]
    row = np.bitwise_xor.reduce(products, axis=1) % np.uint32(table)
    return row.astype(np.int64)


lessons.check_forward("09.2", my_row, "hash_index")


# %% [markdown]
# **09.3** The transposed matrix scatters what the matrix gathered. The factor $|\theta| \le 1$ is
# the clipping of the straight-through estimator.


# %%
def my_backward(inputs, cotangents):
    grids = inputs["grids"]
    tables = [len(grid) for grid in grids]
    box = inputs["lo"], inputs["hi"]
    located = grid_nodes.locate(inputs["x_a"], *box, inputs["resolutions"], tables)
    F = grids[0].shape[1]
    entries_bar = located.T @ cotangents["h_bar"].reshape(located.shape[0], F)
    levels = np.split(entries_bar, np.cumsum(tables)[:-1])
    gradients = []
    for level, grid in zip(levels, grids):
        inside = np.abs(grid) <= 1
        gradients.append(level * inside)
    return {"grids": gradients}


lessons.check_backward("09.3", my_backward, "hash_grid")

# %% [markdown]
# **Predict, then run.** Only signs count, so $h$ stays. But now every $|\theta|$ is above 1, where
# the straight-through estimator passes nothing: all gradients are 0, and the signs cannot change.

# %%
for factor, alive in ((1, [True, True, False, False]), (1000, [False] * 4)):
    box = np.zeros(3), np.ones(3)
    h, saved = hash_grid.forward(place, *box, [factor * theta], (("xy", 2),))
    assert np.array_equal(h, by_hand)
    (theta_bar,) = hash_grid.backward(saved, np.ones((1, 1)))["grids"]
    assert (theta_bar[:, 0] != 0).tolist() == alive
