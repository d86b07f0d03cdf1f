# %% [markdown]
# # Solutions: compositing

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.splatting import compositing

# %% [markdown]
# **15.1** From the back: $B_2 = 1$, $B_1 = 0.8\cdot 0.5 + 0.2\cdot 1 = 0.6$ and
# $B_0 = 0.5\cdot 1 + 0.5\cdot 0.6 = 0.8$. The pixel is $0.5\cdot 1 + 0.5\cdot 0.8 = 0.9$. The
# gradients of the opacities are $1\,(1 - 0.8) = 0.2$, $0.5\,(1 - 0.6) = 0.2$ and
# $0.25\,(0.5 - 1) = -0.125$. A thickness has the slope $d\alpha/d\tau = e^{-\tau} = 1 - \alpha$, so
# its gradients are $0.1$, $0.1$ and $-0.025$. In place of the light $T_i$ in front of a layer they
# have the light $T_{i+1}$ behind it: a layer that is opaque learns nothing.

# %%
layers = dict(
    mean2d=np.zeros((3, 2)),
    conic=np.zeros((3, 3)),
    alpha=np.array([0.5, 0.5, 0.8]),
    depth=np.arange(3.0),
    color=np.outer([1, 1, 0.5], np.ones(3)),
    visible=np.ones(3, bool),
    background=np.ones(3),
    height=1,
    width=1,
)
(white, _), saved = compositing.forward(**layers)
g = np.array([[[1.0, 0, 0]]])
alpha_bar = compositing.backward(saved, g)["alpha"]
tau_bar = alpha_bar * (1 - layers["alpha"])


def of_thickness(tau):
    (image, _), saved = compositing.forward(**{**layers, "alpha": 1 - np.exp(-tau)})
    return image, saved


tau = {"tau": -np.log(1 - layers["alpha"])}
_ = lessons.adjoint(np.random.default_rng(15), of_thickness, tau, g, {"tau": tau_bar})
lessons.check_number("15.1", [0.9, 0.1, 0.1, -0.025], [white[0, 0, 0], *tau_bar])


# %% [markdown]
# **15.2** A stable sort keeps splats of equal depth in the order of their index. The transmittances
# have one more row than there are splats: the last row is the light that reaches the background.
# Far along a needle, rounding can make the exponent positive; it counts as 0 then.


# %%
def front_to_back(given):
    visible = np.flatnonzero(given["visible"])
    by_depth = np.argsort(given["depth"][visible], kind="stable")
    return visible[by_depth]


def falloffs(given, order):
    """The falloff of each splat at each pixel (M, P), and the way from its mean to the pixel."""
    y, x = np.indices((given["height"], given["width"])).reshape(2, 1, -1)
    mean_x, mean_y = given["mean2d"][order].T[:, :, None]
    e_x = x - mean_x
    e_y = y - mean_y
    a, b, c = given["conic"][order].T[:, :, None]
    exponent = -0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y
    return np.exp(np.minimum(exponent, 0)), e_x, e_y


def transmittances(A, given):
    """The light in front of each splat and, in the last row, of the background (M + 1, P)."""
    through = np.vstack([np.ones((1, A.shape[1])), 1 - A])
    if given.get("occlusion", True):
        return np.cumprod(through, axis=0)
    return np.ones_like(through)


def my_forward(**given):
    order = front_to_back(given)
    falloff, _, _ = falloffs(given, order)
    raw = given["alpha"][order, None] * falloff
    A = np.minimum(raw, given.get("alpha_max", 0.99))
    T = transmittances(A, given)
    weights = A * T[:-1]
    image = weights.T @ given["color"][order]
    image += T[-1][:, None] * given["background"]
    shape = given["height"], given["width"]
    return image.reshape(*shape, 3), T[-1].reshape(shape)


lessons.check_forward("15.2", my_forward, "compositing")


# %% [markdown]
# **15.3** The sweep from the back. Without occlusion no splat hides another, so nothing is
# subtracted from the gain.


# %%
def my_backward(given, cotangents):
    order = front_to_back(given)
    falloff, e_x, e_y = falloffs(given, order)
    raw = given["alpha"][order, None] * falloff
    alpha_max = given.get("alpha_max", 0.99)
    A = np.minimum(raw, alpha_max)
    T = transmittances(A, given)

    G = cotangents["image_bar"].reshape(-1, 3)
    gain = given["color"][order] @ G.T
    behind = G @ given["background"] + cotangents["transmittance_bar"].ravel()
    if given.get("occlusion", True):
        for i in reversed(range(len(order))):
            gain[i] -= behind
            behind = behind + A[i] * gain[i]
    A_bar = T[:-1] * gain * (raw <= alpha_max)

    V = A_bar * raw
    a, b, c = given["conic"][order].T[:, :, None]
    mean_terms = [
        V * (a * e_x + b * e_y),
        V * (b * e_x + c * e_y),
    ]
    conic_terms = [
        -0.5 * V * e_x**2,
        -V * e_x * e_y,
        -0.5 * V * e_y**2,
    ]
    visible_rows = {
        "mean2d": np.sum(mean_terms, axis=2).T,
        "conic": np.sum(conic_terms, axis=2).T,
        "alpha": (A_bar * falloff).sum(axis=1),
        "color": (A * T[:-1]) @ G,
    }
    bars = {"background": T[-1] @ G}
    for name, values in visible_rows.items():
        bars[name] = np.zeros_like(given[name])
        bars[name][order] = values
    return bars


lessons.check_backward("15.3", my_backward, "compositing")

# %% [markdown]
# **Predict, then run.** The smallest positive float16 is $6\cdot 10^{-8}$, so the product is 0
# after eight layers. The error is not visible, because everything farther back has a weight of
# $10^{-8}$. But a backward that divides by transmittances divides by zero.

# %%
through = np.float16(1)
layers_passed = 0
while through > 0:
    through = through * np.float16(0.1)
    layers_passed += 1
assert layers_passed == 8
