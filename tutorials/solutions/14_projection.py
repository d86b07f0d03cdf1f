# %% [markdown]
# # Solutions: projection

# %%
import numpy as np

from p4dgs_ref import lessons

# %% [markdown]
# **14.1** $J = (80/8, -80\cdot 1/8^2) = (10, -1.25)$, so the variance is
# $100\cdot 0.04 + 1.5625\cdot 0.16 + 0.3 = 4.55$ square pixels.

# %%
J = np.array([80 / 8, -80 / 64])
variance = J**2 @ [0.04, 0.16] + 0.3
lessons.check_number("14.1", 4.55, variance)


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
    scale = (focal / z)[:, :, None]
    m = scale * (W[:2] - uv[:, :, None] * W[2])
    cov = m @ Sigma @ m.transpose(0, 2, 1)
    a = cov[:, 0, 0] + 0.3
    b = (cov[:, 0, 1] + cov[:, 1, 0]) / 2
    c = cov[:, 1, 1] + 0.3
    det = a * c - b * b
    visible = visible & (det > 0) & np.isfinite(det)
    safe_det = np.where(visible, det, 1)
    conic = np.stack([c, -b, a], axis=1) / safe_det[:, None]
    conic[~visible] = 0
    cov2d = np.stack([a, b, c], axis=1)
    inside = np.abs(ratio) <= limit
    return visible, x_c, ratio, inside, m, cov2d, conic


def my_forward(x, Sigma, W, T, focal, center, size):
    camera = W, T, focal, center, size
    visible, x_c, ratio, _, _, cov2d, conic = steps(x, Sigma, *camera)
    mean2d = ratio * focal + center
    depth = x_c[:, 2].copy()
    for rows in (mean2d, cov2d, depth):
        rows[~visible] = 0
    return mean2d, cov2d, conic, depth, visible


lessons.check_forward("14.2", my_forward, "projection")


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
    D_K = symmetric(conic_bar * halved)
    D = symmetric(cov2d_bar * halved) - K @ D_K @ K
    Sigma_bar = m.transpose(0, 2, 1) @ D @ m
    m_bar = D @ m @ (Sigma + Sigma.transpose(0, 2, 1))
    uv_bar = -(m_bar @ W[2]) * focal / z
    ratio_bar = uv_bar * inside + focal * mean2d_bar
    through_m = (m_bar * m).sum(axis=(1, 2))
    through_ratio = ratio_bar * x_c[:, :2] / z**2
    z_bar = depth_bar - through_m / x_c[:, 2] - through_ratio.sum(axis=1)
    of_camera = np.concatenate([ratio_bar / z, z_bar[:, None]], axis=1)
    return {"x": of_camera @ W, "Sigma": Sigma_bar}


lessons.check_backward("14.3", my_backward, "projection")

# %% [markdown]
# **Predict, then run.** The mean doubles and the variances grow four times, but the blur stays
# 0.3. Small splats are blurred less at the higher resolution, so a model that is trained at one
# resolution looks different at another.

# %%
x, Sigma = np.array([[0.1, 0.2, 4]]), 0.01 * np.eye(3)[None]
seen = []
for zoom in (1, 2):
    camera = np.array([80.0, 80]), np.array([32.0, 32]), np.array([64.0, 64])
    scaled = [zoom * array for array in camera]
    seen.append(my_forward(x, Sigma, np.eye(3), np.zeros(3), *scaled)[:2])
assert np.allclose(2 * seen[0][0], seen[1][0])
assert np.allclose(4 * (seen[0][1] - [0.3, 0, 0.3]), seen[1][1] - [0.3, 0, 0.3])
