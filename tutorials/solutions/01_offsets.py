# %% [markdown]
# # Solutions to Eq. (1)

# %%
import numpy as np

from p4dgs_ref.school import lessons

x_a = np.array([1, 2, 0])
l_a = np.array([0.5, 0.5, 2])

# %% [markdown]
# **01.1** Axis by axis, the position is $1 + 0\cdot 0.5$, $2 + 4\cdot 0.5$ and $0 - 0.5\cdot 2$.

# %%
lessons.number("01.1", [1, 4, -1], x_a + np.array([0, 4, -0.5]) * l_a)


# %% [markdown]
# **01.2** The indexing with `None` adds an axis of length one, and NumPy repeats the array along
# it, once for each child.
#
# **01.3** The backward of repeating is summing, so `x_a` and `l_a` sum over the axis of the
# children.


# %%
def my_forward(x_a, O_a, l_a):
    return x_a[:, None] + O_a * l_a[:, None]


def my_backward(inputs, cotangents):
    x_bar = cotangents["x_bar"]
    return {
        "x_a": x_bar.sum(axis=1),
        "O_a": x_bar * inputs["l_a"][:, None],
        "l_a": (x_bar * inputs["O_a"]).sum(axis=1),
    }


lessons.forward("01.2", my_forward, "offsets")
lessons.backward("01.3", my_backward, "offsets")
