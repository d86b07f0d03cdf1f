# %% [markdown]
# # Solutions to Eq. (7) and Eq. (10)

# %%
import numpy as np

from p4dgs_ref.equations import rounding
from p4dgs_ref.school import lessons

# %% [markdown]
# **07.1** The quotients are $2.5$, $-1.2$, $0.5$ and $4.4$. The first and the third are ties, and go to the even neighbour.

# %%
lessons.number(
    "07.1",
    [2, -1, 0, 4],
    rounding.forward(np.array([[0.625, -0.3, 0.125, 1.1]]), np.array([[0.25]]))[0].symbols[0],
)


# %% [markdown]
# **07.2** `np.rint` rounds ties to even. Casting to integers takes the sign off a negative zero.


# %%
def my_rounding(f, q):
    symbols = np.rint(f / q).astype(np.int64)
    return symbols, symbols * q


lessons.forward("07.2", my_rounding, "rounding")


# %% [markdown]
# **07.3** $\tilde f = f + uq$: the slope in $f$ is one, the slope in $q$ is $u$, and one $q$ serves a whole row.


# %%
def my_backward(inputs, cotangents):
    f_noisy_bar = cotangents["f_noisy_bar"]
    return {"f": f_noisy_bar, "q": (f_noisy_bar * inputs["u"]).sum(axis=1, keepdims=True)}


lessons.backward("07.3", my_backward, "noise")
