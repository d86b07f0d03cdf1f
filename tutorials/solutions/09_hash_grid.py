# %% [markdown]
# # Solutions to Eq. (9)

# %%
import numpy as np

from p4dgs_ref.equations import hash_grid
from p4dgs_ref.school import lessons

# %% [markdown]
# **09.1** Three quarters along $x$, one along $y$: weights $\frac{3}{16}, \frac{9}{16}, \frac{1}{16}, \frac{3}{16}$, with the
# signs $+ - + +$.

# %%
theta, square = (
    np.array([[0.3], [-1], [2], [1.5]]),
    dict(lo=np.zeros(3), hi=np.ones(3), resolutions=(("xy", 2),)),
)
lessons.number(
    "09.1",
    3 / 16 - 9 / 16 + 1 / 16 + 3 / 16,
    hash_grid.forward(np.array([[0.75, 0.25, 0]]), grids=[theta], **square)[0].h[0, 0],
)


# %% [markdown]
# **09.2** `uint32` wraps by itself. A dense row is $i + j\,res + k\,res^2$: the first axis counts fastest.


# %%
def my_row(corner, res, table):
    D = corner.shape[1]
    if res**D <= table:
        return corner @ res ** np.arange(D)
    primes = np.array([1, 2654435761, 805459861], np.uint32)[:D]
    return (
        np.bitwise_xor.reduce(corner.astype(np.uint32) * primes, axis=1) % np.uint32(table)
    ).astype(np.int64)


lessons.forward("09.2", my_row, "hash_index")


# %% [markdown]
# **09.3** The transposed matrix scatters what the matrix gathered; the window $|\theta| \le 1$ is the straight-through part.


# %%
def my_backward(inputs, cotangents):
    grids = inputs["grids"]
    located = hash_grid.locate(
        inputs["x_a"], inputs["lo"], inputs["hi"], inputs["resolutions"], [len(g) for g in grids]
    )
    entries_bar = located.T @ cotangents["h_bar"].reshape(located.shape[0], grids[0].shape[1])
    levels = np.split(entries_bar, np.cumsum([len(g) for g in grids])[:-1])
    return {"grids": [level * (np.abs(g) <= 1) for level, g in zip(levels, grids)]}


lessons.backward("09.3", my_backward, "hash_grid")
