# %% [markdown]
# # Solutions: covariance

# %%
import numpy as np

from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import covariance

# %% [markdown]
# **13.1** $w = \cos 60°$: a turn by $120°$ about $(1, 1, 1)$. It carries x to y, y to z, z to x: the matrix of zeros and ones
# shows. So the variance $1$ of x goes to y, $4$ goes to z, and $9$ comes to x.

# %%
lessons.number(
    "13.1",
    np.diag([9, 1, 4]),
    covariance.forward(np.array([[1.0, 2, 3]]), np.full((1, 4), 0.5))[0].Sigma[0],
)


# %% [markdown]
# **13.2** and **13.3** The slopes of $R$ as in the text; because $R$ is quadratic, a difference over steps of one is exact too.


# %%
def matrix(r):
    w, x, y, z = r.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def my_forward(s, r):
    M = matrix(r) * s[:, None, :]
    return M @ M.transpose(0, 2, 1)


def my_backward(inputs, cotangents):
    s, r, Sigma_bar = inputs["s"], inputs["r"], cotangents["Sigma_bar"]
    R = matrix(r)
    M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ (R * s[:, None, :])
    R_bar = M_bar * s[:, None, :]
    slopes = [(matrix(r + e) - matrix(r - e)) / 2 for e in np.eye(4)]
    return {
        "s": (M_bar * R).sum(axis=1),
        "r": np.stack([(R_bar * slope).sum(axis=(1, 2)) for slope in slopes], axis=1),
    }


lessons.forward("13.2", my_forward, "covariance")
lessons.backward("13.3", my_backward, "covariance")
