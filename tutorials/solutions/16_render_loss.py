# %% [markdown]
# # Solutions to Eq. (16)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import ssim, window

# %% [markdown]
# **16.1** The brighter image has the variance of the truth, and the covariance is the same number,
# so the second factor of SSIM is 1. The blurred one has no variance and no covariance, so its
# second factor is $C_2/(0.01 + C_2)$, nearly 0.

# %%
brighter = (2 * 0.5 * 0.4 + ssim.C1) / (0.5**2 + 0.4**2 + ssim.C1)
blurred = ssim.C2 / (0.01 + ssim.C2)
mine = [0.8 * 0.1 + 0.2 * (1 - score) for score in (brighter, blurred)]
truth = np.array([0.3, 0.5])
by_moments = []
for image in (np.array([0.4, 0.6]), np.array([0.4, 0.4])):
    cov = np.mean(image * truth) - image.mean() * truth.mean()
    means = (2 * image.mean() * truth.mean() + ssim.C1) / (image.mean() ** 2 + 0.16 + ssim.C1)
    structure = (2 * cov + ssim.C2) / (image.var() + truth.var() + ssim.C2)
    by_moments.append(0.8 * np.abs(image - truth).mean() + 0.2 * (1 - means * structure))
lessons.check_number("16.1", mine, by_moments)


# %% [markdown]
# **16.2** This is a weighted mean of two numbers. With `1 - ssim.forward(...)[0]` the answer to the
# case `H-P7.nearly_equal` is accepted, but with few digits: SSIM is almost one there, and
# subtracting it from one loses them.


# %%
def my_forward(image, truth, lambda_ssim):
    L1 = np.abs(image - truth).mean()
    D_SSIM, _ = ssim.dissimilarity(image, truth)
    return (1 - lambda_ssim) * L1 + lambda_ssim * D_SSIM, L1, D_SSIM


lessons.check_forward("16.2", my_forward, "render_loss")


# %% [markdown]
# **16.3** Compute the moments, then the gradients of the moments, then apply the blur, which is its
# own transpose.


# %%
def my_backward(inputs, cotangents):
    x, y = window.to_rows(inputs["image"]), window.to_rows(inputs["truth"])
    e = x - y
    blur = window.blur
    mu_x, mu_y, mu_e = blur(x), blur(y), blur(e)
    D1 = mu_x**2 + mu_y**2 + ssim.C1
    var_x = blur(x * x) - mu_x**2
    var_y = blur(y * y) - mu_y**2
    D2 = var_x + var_y + ssim.C2
    ell = mu_e**2 / D1
    s = (blur(e * e) - mu_e**2) / D2
    share = cotangents["ssim_bar"] / x.size
    E_bar = -share * (1 - ell) / D2
    X_bar = -s * E_bar
    mu_bar = -2 * share * (1 - s) * (mu_e - ell * mu_x) / D1
    mu_bar += 2 * E_bar * (s * mu_x - mu_e)
    x_bar = blur(mu_bar) + 2 * e * blur(E_bar) + 2 * x * blur(X_bar)
    return {"image": x_bar.transpose(0, 2, 1)}


lessons.check_backward("16.3", my_backward, "ssim")

# %% [markdown]
# **Predict, then run.** L1 is measured in brightness, so it is halved. SSIM compares quotients and
# stays almost the same; only its two constants make a difference. In dark scenes, D-SSIM therefore
# has more weight.

# %%
rng = np.random.default_rng(12)
truth = rng.random((32, 32, 3))
image = truth + rng.normal(0, 0.05, truth.shape)
_, L1, D_SSIM = my_forward(image, truth, 0.2)
_, dark_L1, dark_D_SSIM = my_forward(image / 2, truth / 2, 0.2)
assert np.isclose(dark_L1, L1 / 2)
assert 0.9 * D_SSIM < dark_D_SSIM < D_SSIM
