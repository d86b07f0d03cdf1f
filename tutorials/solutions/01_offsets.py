# %% [markdown]
# # Solutions to Eq. (1)

# %%
import numpy as np

from p4dgs_ref import lessons

x_a = np.array([1, 2, 0])
l_a = np.array([0.5, 0.5, 2])

# %% [markdown]
# **01.1** Axis by axis, the position is $1 + 0\cdot 0.5$, $2 + 4\cdot 0.5$ and $0 - 0.5\cdot 2$.

# %%
lessons.check_number("01.1", [1, 4, -1], x_a + np.array([0, 4, -0.5]) * l_a)


# %% [markdown]
# **01.2** The indexing with `None` adds an axis of length one, and NumPy repeats the array along
# it, once for each child.
#
# **01.3** The backward of repeating is summing, so the gradients of `x_a` and `l_a` are sums over
# the children's axis.


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


lessons.check_forward("01.2", my_forward, "offsets")
lessons.check_backward("01.3", my_backward, "offsets")

# %% [markdown]
# **Predict, then run.** Between 512 and 1024, numbers in float16 are 0.5 apart. A child moves if
# the product is more than half of that, so the first offset is 3. This is why positions are computed
# in float32. In the file they are 16-bit integers, in steps of 1/65,535 of the anchors' box.

# %%
offsets = np.arange(1, 6).astype(np.float16)
children = np.float16(1000) + offsets * np.float16(0.1)
assert np.spacing(np.float16(1000)) == 0.5
assert children.tolist() == [1000, 1000, 1000.5, 1000.5, 1000.5]
