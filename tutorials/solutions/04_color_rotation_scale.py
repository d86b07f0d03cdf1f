# %% [markdown]
# # Solutions to Eq. (3') for colour and rotation, Eq. (4)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import anchor_network
from p4dgs_ref.equations.numerics import normalise, normalise_backward


def network(f_a, delta_vc, d_vc, weights, biases, width):
    """Return psi [A, k, width], and a function from psi_bar to the gradients of the five inputs."""
    psi, saved = anchor_network.forward(f_a, delta_vc, d_vc, weights, biases, width=width)
    return psi, lambda psi_bar: anchor_network.backward(saved, psi_bar)


# %% [markdown]
# **04.1** Here $n = 5$, $r = (0, 0.6, 0, 0.8)$ and $r\cdot\bar r = 20$, so
# $(\bar r - 20\,r)/5 = (0, -12, 0, 9)/5$.

# %%
raw = np.array([0.0, 3, 0, 4])
bar = np.array([0, 0, 0, 25])
unit, norm = normalise(raw)
lessons.check_number("04.1", [0, -2.4, 0, 1.8], normalise_backward(unit, norm, bar))


# %% [markdown]
# **04.2** The number $e = e^{-|\psi|}$ lies between 0 and 1 and never overflows. The sigmoid is
# $1/(1+e)$ for positive $\psi$ and $e/(1+e)$ for negative $\psi$.


# %%
def my_color(**inputs):
    psi, _ = network(**inputs, width=3)
    e = np.exp(-np.abs(psi))
    return np.where(psi >= 0, 1, e) / (1 + e)


lessons.check_forward("04.2", my_color, "color")


# %% [markdown]
# **04.3** This is the projector divided by the length with $\epsilon$.
#
# **04.4** Each of the two gradients is a factor times $\bar s$, and that of the anchor sums over
# its children. The slope of the sigmoid is $e/(1+e)^2$ on both sides.


# %%
ANCHOR = ("f_a", "delta_vc", "d_vc", "weights", "biases")


def my_rotation_backward(inputs, cotangents):
    y, backward_of_network = network(**inputs, width=4)
    r_bar = cotangents["r_bar"]
    n = np.sqrt((y**2).sum(axis=2, keepdims=True) + 1e-24)
    r = y / n
    along = (r * r_bar).sum(axis=2, keepdims=True)
    return backward_of_network((r_bar - r * along) / n)


def my_scale_backward(inputs, cotangents):
    s_a, *of_network = (inputs[name] for name in ("s_a", *ANCHOR))
    s_bar = cotangents["s_bar"]
    psi, backward_of_network = network(*of_network, width=3)
    e = np.exp(-np.abs(psi))
    share = np.where(psi >= 0, 1, e) / (1 + e)
    psi_bar = s_bar * s_a[:, None] * e / (1 + e) ** 2
    s_a_bar = (s_bar * share).sum(axis=1)
    return {"s_a": s_a_bar, **backward_of_network(psi_bar)}


lessons.check_backward("04.3", my_rotation_backward, "rotation")
lessons.check_backward("04.4", my_scale_backward, "scale")

# %% [markdown]
# **Predict, then run.** NaN. The smallest positive float16 is $6\cdot 10^{-8}$, so $\epsilon$
# becomes 0 and the port divides 0 by 0. In float32 the formula returns 0.

# %%
for kind, is_nan in ((np.float16, True), (np.float32, False)):
    zero = np.zeros(4, kind)
    with np.errstate(invalid="ignore"):
        r = zero / np.sqrt((zero**2).sum() + kind(1e-24))
    assert r.dtype == kind and np.isnan(r).all() == is_nan
