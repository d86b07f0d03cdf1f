# %% [markdown]
# # Solutions: compositing

# %%
import numpy as np

from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import compositing

# %% [markdown]
# **15.1** From the back: $B_2 = 1$, $B_1 = 0.8\cdot 0.5 + 0.2\cdot 1 = 0.6$, $B_0 = 0.5\cdot 1 + 0.5\cdot 0.6 = 0.8$.
# The pixel is $0.5\cdot 1 + 0.5\cdot 0.8 = 0.9$. The gradients are $1\,(1 - 0.8)$, $0.5\,(1 - 0.6)$ and $0.25\,(0.5 - 1)$.

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
white, residual = compositing.forward(**layers)
alpha_bar = compositing.backward(residual, np.array([[[1.0, 0, 0]]]))["alpha"]
lessons.number("15.1", [0.9, 0.2, 0.2, -0.125], [white.image[0, 0, 0], *alpha_bar])


# %% [markdown]
# **15.2** A stable sort keeps equal depths in order of index. `T` is appended once more at the end: what is left.


# %%
def alphas(given):
    order = np.flatnonzero(given["visible"])
    order = order[np.argsort(given["depth"][order], kind="stable")]
    y, x = np.indices((given["height"], given["width"])).reshape(2, 1, -1)
    e = x - given["mean2d"][order, :1], y - given["mean2d"][order, 1:]
    a, b, c = given["conic"][order].T[:, :, None]
    falloff = np.exp(-0.5 * (a * e[0] ** 2 + c * e[1] ** 2) - b * e[0] * e[1])
    raw, alpha_max = given["alpha"][order, None] * falloff, given.get("alpha_max", 0.99)
    A = np.minimum(raw, alpha_max)
    light = np.cumprod(np.concatenate([np.ones((1, A.shape[1])), 1 - A]), axis=0)
    return (
        order,
        e,
        falloff,
        raw,
        raw <= alpha_max,
        A,
        light if given.get("occlusion", True) else np.ones_like(light),
    )


def my_forward(**given):
    order, _, _, _, _, A, light = alphas(given)
    shape = given["height"], given["width"]
    image = (A * light[:-1]).T @ given["color"][order] + light[-1][:, None] * given["background"]
    return image.reshape(*shape, 3), light[-1].reshape(shape)


lessons.forward("15.2", my_forward, "compositing")


# %% [markdown]
# **15.3** The sweep from the back; without occlusion nothing stands behind anything, so nothing is taken away.


# %%
def my_backward(inputs, cotangents):
    order, (e_x, e_y), falloff, raw, free, A, light = alphas(inputs)
    G, color = cotangents["image_bar"].reshape(-1, 3), inputs["color"][order]
    behind = G @ inputs["background"] + cotangents["transmittance_bar"].ravel()
    gain = color @ G.T
    if inputs.get("occlusion", True):
        for i in reversed(range(len(order))):
            gain[i] -= behind
            behind = behind + A[i] * gain[i]
    A_bar = light[:-1] * gain * free
    V = A_bar * raw
    a, b, c = inputs["conic"][order].T[:, :, None]
    rows = {
        "color": (A * light[:-1]) @ G,
        "alpha": (A_bar * falloff).sum(axis=1),
        "mean2d": np.stack([V * (a * e_x + b * e_y), V * (b * e_x + c * e_y)], axis=1).sum(axis=2),
        "conic": np.stack([-0.5 * V * e_x**2, -V * e_x * e_y, -0.5 * V * e_y**2], axis=1).sum(
            axis=2
        ),
    }
    bars = {name: np.zeros_like(inputs[name]) for name in rows}
    for name, values in rows.items():
        bars[name][order] = values
    return {**bars, "background": light[-1] @ G}


lessons.backward("15.3", my_backward, "compositing")
