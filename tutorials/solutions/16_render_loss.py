# %% [markdown]
# # Solutions to Eqs. (15) and (16)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import ssim, window

# %% [markdown]
# **16.1** The loss is $10^{-3}\cdot 2.4 + 0.07$. Its cotangent goes to $\mathcal{L}_{render}$ with
# the factor one, and to $\mathcal{L}_{rate}$ with the factor $\lambda_{rate}$.

# %%
case = lessons.golden("total_loss/ordinary")
bar = case["out_bar.L_total"]
names = ("out.L_total", "in_bar.L_render", "in_bar.L_rate")
lessons.check_number("16.1", [0.0724, bar, 1e-3 * bar], [case[name] for name in names])


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
