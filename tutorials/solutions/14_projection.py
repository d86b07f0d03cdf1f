# %% [markdown]
# # Solutions: projection

# %%
import numpy as np

from p4dgs_ref.school import lessons

# %% [markdown]
# **14.1** $J = (80/8, -80\cdot 1/8^2) = (10, -1.25)$, so the variance is
# $100\cdot 0.04 + 1.5625\cdot 0.16 + 0.3 = 4.55$ square pixels.

# %%
lessons.number("14.1", 4.55, np.array([80 / 8, -80 / 64]) ** 2 @ [0.04, 0.16] + 0.3)


# %% [markdown]
# **14.2** Gaussians that are too near are moved to $(0, 0, 1)$, so that nothing divides by zero,
# and their rows are set to zero afterwards. A determinant that is not positive belongs to a needle
# that has lost all its digits, and an infinite one to a splat that is too large for floats. Both
# are culled as well. The function `steps` returns everything that the backward needs.


# %%
def symmetric(numbers):
    """Return the matrices [[a, b], [b, c]] of (a, b, c) [N, 3]."""
    return numbers[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def steps(x, Sigma, W, T, focal, center, size):
    """Return the intermediate results of the forward."""
    x_c = x @ W.T + T
    visible = x_c[:, 2] > 0.2
    x_c = np.where(visible[:, None], x_c, [0, 0, 1])
    z = x_c[:, 2:]
    ratio = x_c[:, :2] / z
    limit = 1.3 * size / (2 * focal)
    uv = np.clip(ratio, -limit, limit)
    m = (W[:2] - uv[:, :, None] * W[2]) * (focal / z)[:, :, None]
    cov = m @ Sigma @ m.transpose(0, 2, 1) + 0.3 * np.eye(2)
    a, c = cov[:, 0, 0], cov[:, 1, 1]
    b = (cov[:, 0, 1] + cov[:, 1, 0]) / 2
    det = a * c - b * b
    visible = visible & (det > 0) & np.isfinite(det)
    conic = np.stack([c, -b, a], axis=1) / np.where(visible, det, 1)[:, None]
    conic = np.where(visible[:, None], conic, 0)
    cov2d = np.stack([a, b, c], axis=1)
    return visible, x_c, ratio, np.abs(ratio) <= limit, m, cov2d, conic


def my_forward(x, Sigma, W, T, focal, center, size):
    visible, x_c, ratio, _, _, cov2d, conic = steps(x, Sigma, W, T, focal, center, size)
    keep = visible[:, None]
    mean2d = np.where(keep, ratio * focal + center, 0)
    depth = np.where(visible, x_c[:, 2], 0)
    return mean2d, np.where(keep, cov2d, 0), conic, depth, visible


lessons.forward("14.2", my_forward, "projection")


# %% [markdown]
# **14.3** These are the steps of the text in reverse. A culled row has no gradient, so its
# cotangents are set to zero first.


# %%
def my_backward(inputs, cotangents):
    visible, x_c, ratio, inside, m, _, conic = steps(**inputs)
    keep = visible[:, None]
    mean2d_bar = np.where(keep, cotangents["mean2d_bar"], 0)
    cov2d_bar = np.where(keep, cotangents["cov2d_bar"], 0)
    conic_bar = np.where(keep, cotangents["conic_bar"], 0)
    depth_bar = np.where(visible, cotangents["depth_bar"], 0)
    halved = [1, 0.5, 1]

    Sigma, W, focal = inputs["Sigma"], inputs["W"], inputs["focal"]
    z = x_c[:, 2:]
    K = symmetric(conic)
    D = symmetric(cov2d_bar * halved) - K @ symmetric(conic_bar * halved) @ K
    m_bar = D @ m @ (Sigma + Sigma.transpose(0, 2, 1))
    uv_bar = -(m_bar @ W[2]) * focal / z
    ratio_bar = uv_bar * inside + focal * mean2d_bar
    z_bar = depth_bar[:, None] - (m_bar * m).sum(axis=(1, 2))[:, None] / z
    z_bar = z_bar - (ratio_bar * x_c[:, :2]).sum(axis=1, keepdims=True) / z**2
    x_bar = np.concatenate([ratio_bar / z, z_bar], axis=1) @ W
    return {"x": x_bar, "Sigma": m.transpose(0, 2, 1) @ D @ m}


lessons.backward("14.3", my_backward, "projection")
