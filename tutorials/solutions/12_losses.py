# %% [markdown]
# # Solutions to Eqs. (15) and (16)

# %%
import numpy as np

from p4dgs_ref.equations import ssim, window
from p4dgs_ref.school import lessons

given = lessons.golden("total_loss/ordinary")

# %% [markdown]
# **12.1** Linear: $10^{-3}\cdot 2.4 + 0.07$, and the cotangent times one and times $\lambda_{rate}$.

# %%
bar = given["out_bar.L_total"]
lessons.number(
    "12.1",
    [0.0724, bar, 1e-3 * bar],
    [given[n] for n in ("out.L_total", "in_bar.L_render", "in_bar.L_rate")],
)


# %% [markdown]
# **12.2** A weighted mean of two numbers. With `1 - ssim.forward(...)` the case `H-P7.nearly_equal` fails: of a number near one,
# rounded, little is left after subtracting one.


# %%
def my_forward(image, truth, lambda_ssim):
    L1, D_SSIM = np.abs(image - truth).mean(), ssim.dissimilarity(image, truth)[0]
    return (1 - lambda_ssim) * L1 + lambda_ssim * D_SSIM, L1, D_SSIM


lessons.forward("12.2", my_forward, "render_loss")


# %% [markdown]
# **12.3** The moments, the three gradients of the moments, and the blur as its own transpose.


# %%
def my_backward(inputs, cotangents):
    x, y = window.to_rows(inputs["image"]), window.to_rows(inputs["truth"])
    e, blur, share = x - y, window.blur, cotangents["ssim_bar"] / x.size
    mu_x, mu_y, mu_e = blur(x), blur(y), blur(e)
    D1 = mu_x**2 + mu_y**2 + ssim.C1
    D2 = blur(x * x) - mu_x**2 + blur(y * y) - mu_y**2 + ssim.C2
    ell, s = mu_e**2 / D1, (blur(e * e) - mu_e**2) / D2
    E_bar = -share * (1 - ell) / D2
    mu_bar = -2 * share * (1 - s) * (mu_e - ell * mu_x) / D1 + 2 * E_bar * (s * mu_x - mu_e)
    x_bar = blur(mu_bar) + 2 * e * blur(E_bar) - 2 * x * blur(s * E_bar)
    return {"image": x_bar.transpose(0, 2, 1)}


lessons.backward("12.3", my_backward, "ssim")
