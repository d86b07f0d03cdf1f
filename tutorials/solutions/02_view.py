# %% [markdown]
# # Solutions to Eq. (2)

# %%
import numpy as np

from p4dgs_ref.equations import view
from p4dgs_ref.school import lessons

x_a, x_c = np.array([3.0, -1, 7]), np.array([1.0, 2, 1])

# %% [markdown]
# **02.1** The gradient of a length is the direction: $d_{vc} = (2, -3, 6)/7$, and $d_{vc}\cdot(0.7, 0, 0) = 0.2$.

# %%
lessons.number(
    "02.1",
    2 / 7 * 0.7,
    view.backward(view.forward(x_a[None], x_c)[1], np.ones((1, 1)))["x_a"][0] @ [0.7, 0, 0],
)


# %% [markdown]
# **02.2** Dividing by the largest component first keeps every square in range; where it is zero, so is the direction.
# **02.3** The gradient of the length along the ray, plus what of $\bar d_{vc}$ lies across, over the length.


# %%
def my_forward(x_a, x_c):
    v = x_a - x_c
    largest = np.abs(v).max(axis=1, keepdims=True)
    unit = v / np.where(largest > 0, largest, 1)
    delta_vc = largest * np.sqrt((unit**2).sum(axis=1, keepdims=True))
    return delta_vc, v / np.where(delta_vc > 0, delta_vc, 1)


def my_backward(inputs, cotangents):
    delta_vc, d_vc = my_forward(**inputs)
    d_bar = cotangents["d_vc_bar"]
    # (d_bar . d_j) minors instead of d_bar - d (d . d_bar): nothing cancels where the ray follows an axis
    minors = d_bar[:, :, None] * d_vc[:, None, :] - d_vc[:, :, None] * d_bar[:, None, :]
    across = (minors * d_vc[:, None, :]).sum(axis=2) / np.where(delta_vc > 0, delta_vc, np.inf)
    return {"x_a": d_vc * cotangents["delta_vc_bar"] + across}


lessons.forward("02.2", my_forward, "view")
lessons.backward("02.3", my_backward, "view")
