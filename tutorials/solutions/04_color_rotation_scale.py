# %% [markdown]
# # Solutions to Eq. (3) for colour and rotation, Eq. (4)

# %%
import numpy as np

from p4dgs_ref.equations import mlp, opacity, rotation
from p4dgs_ref.school import lessons


def network(f_a, delta_vc, d_vc, weights, biases):
    """Its output psi (A, J), and a function from psi_bar (A, J) to the gradients of all five inputs."""
    psi, res = mlp.forward(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
    return psi.y, lambda psi_bar: opacity.split_view(mlp.backward(res, psi_bar), f_a.shape[1])


# %% [markdown]
# **04.1** $n = 5$, $r = (0, 0.6, 0, 0.8)$, $r\cdot\bar r = 20$, and $(\bar r - 20\,r)/5 = (0, -12, 0, 9)/5$.

# %%
raw, bar = np.array([0.0, 3, 0, 4]), np.array([0, 0, 0, 25])
lessons.number(
    "04.1", [0, -2.4, 0, 1.8], rotation.normalise_backward(*rotation.normalise(raw), bar)
)


# %% [markdown]
# **04.2** $e^{-|\psi|}$ never overflows; the sigmoid is $1/(1+e)$ on the right and $e/(1+e)$ on the left.


# %%
def my_color(**inputs):
    psi, _ = network(**inputs)
    e = np.exp(-np.abs(psi))
    return (np.where(psi >= 0, 1, e) / (1 + e)).reshape(len(psi), psi.shape[1] // 3, 3)


lessons.forward("04.2", my_color, "color")


# %% [markdown]
# **04.3** The projector over the safe length. **04.4** One factor each; the anchor's sums over its children.


# %%
def my_rotation_backward(inputs, cotangents):
    psi, pull = network(**inputs)
    r_bar = cotangents["r_bar"]
    y = psi.reshape(r_bar.shape)
    n = np.sqrt((y**2).sum(axis=2, keepdims=True) + 1e-24)
    r = y / n
    y_bar = (r_bar - r * (r * r_bar).sum(axis=2, keepdims=True)) / n
    return pull(y_bar.reshape(psi.shape))


def my_scale_backward(inputs, cotangents):
    s_a, s_bar = inputs.pop("s_a"), cotangents["s_bar"]
    psi, pull = network(**inputs)
    e = np.exp(-np.abs(psi)).reshape(s_bar.shape)
    fraction = np.where(psi.reshape(s_bar.shape) >= 0, 1, e) / (1 + e)
    psi_bar = s_bar * s_a[:, None] * e / (1 + e) ** 2
    return {"s_a": (s_bar * fraction).sum(axis=1), **pull(psi_bar.reshape(psi.shape))}


lessons.backward("04.3", my_rotation_backward, "rotation")
lessons.backward("04.4", my_scale_backward, "scale")
