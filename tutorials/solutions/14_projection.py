# %% [markdown]
# # Solutions: projection

# %%
import numpy as np

from p4dgs_ref.school import lessons

# %% [markdown]
# **14.1** $J = (80/8, -80\cdot 1/8^2) = (10, -1.25)$, so $100\cdot 0.04 + 1.5625\cdot 0.16 + 0.3 = 4.55$ square pixels.

# %%
lessons.number("14.1", 4.55, np.array([80 / 8, -80 / 64]) ** 2 @ [0.04, 0.16] + 0.3)


# %% [markdown]
# **14.2** What is culled is computed at a harmless place, $(0, 0, 1)$, and set to zero afterwards: no division by zero, no NaN.
# A determinant that is not positive belongs to needles that have lost all digits, an infinite one to splats beyond all size:
# both are culled.


# %%
def steps(x, Sigma, W, T, focal, center, size):
    x_c = x @ W.T + T
    visible = x_c[:, 2] > 0.2
    x_c = np.where(visible[:, None], x_c, [0, 0, 1])
    z = x_c[:, 2:]
    ratio, limit = x_c[:, :2] / z, 1.3 * size / (2 * focal)
    m = (W[None, :2] - np.clip(ratio, -limit, limit)[:, :, None] * W[2]) * (focal / z)[:, :, None]
    cov = m @ Sigma @ m.transpose(0, 2, 1) + 0.3 * np.eye(2)
    a, b, c = cov[:, 0, 0], (cov[:, 0, 1] + cov[:, 1, 0]) / 2, cov[:, 1, 1]
    det = a * c - b * b
    visible = visible & (det > 0) & np.isfinite(det)
    conic = np.stack([c, -b, a], axis=1) / np.where(visible, det, 1)[:, None]
    return (
        visible,
        x_c,
        ratio,
        np.abs(ratio) <= limit,
        m,
        np.stack([a, b, c], axis=1),
        np.where(visible[:, None], conic, 0),
    )


def my_forward(x, Sigma, W, T, focal, center, size):
    visible, x_c, ratio, _, _, cov2d, conic = steps(x, Sigma, W, T, focal, center, size)
    keep = visible[:, None]
    return {
        "mean2d": np.where(keep, ratio * focal + center, 0),
        "cov2d": np.where(keep, cov2d, 0),
        "conic": conic,
        "depth": np.where(visible, x_c[:, 2], 0),
        "visible": visible,
    }


lessons.forward("14.2", my_forward, "projection")


# %% [markdown]
# **14.3** The steps in reverse. A culled row sends nothing back: its cotangents are set to zero at the start.


# %%
def my_backward(inputs, cotangents):
    visible, x_c, ratio, inside, m, _, conic = steps(**inputs)
    mean2d_bar, cov2d_bar, conic_bar, depth_bar = (
        np.where(visible if cotangents[n].ndim == 1 else visible[:, None], cotangents[n], 0)
        for n in ("mean2d_bar", "cov2d_bar", "conic_bar", "depth_bar")
    )
    matrix = lambda bar: (bar[:, [0, 1, 1, 2]] * [1, 0.5, 0.5, 1]).reshape(-1, 2, 2)
    Sigma, W, focal, z = inputs["Sigma"], inputs["W"], inputs["focal"], x_c[:, 2:]
    K = conic[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    D = matrix(cov2d_bar) - K @ matrix(conic_bar) @ K
    m_bar = D @ m @ (Sigma + Sigma.transpose(0, 2, 1))
    ratio_bar = -(m_bar @ W[2]) * focal / z * inside + focal * mean2d_bar
    z_bar = depth_bar[:, None] - (m_bar * m).sum(axis=(1, 2))[:, None] / z
    z_bar = z_bar - (ratio_bar * x_c[:, :2]).sum(axis=1, keepdims=True) / z**2
    return {
        "x": np.concatenate([ratio_bar / z, z_bar], axis=1) @ W,
        "Sigma": m.transpose(0, 2, 1) @ D @ m,
    }


lessons.backward("14.3", my_backward, "projection")
