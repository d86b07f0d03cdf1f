# %% [markdown]
# # Eq. (16): the loss of a picture
#
# **Promise.** After this tutorial you can say what SSIM sees that a mean of differences does not,
# and derive the gradient of SSIM by hand. **Before it:** `12_rate_distortion`, `15_compositing`.
# **Takes** six seconds of machine time on two cores, 20 minutes of reading and 30 of exercises.
#
# **Files:** Eq. (16) [render_loss.py](../p4dgs_ref/equations/render_loss.py),
# [ssim.py](../p4dgs_ref/equations/ssim.py), [window.py](../p4dgs_ref/equations/window.py).

# %%
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("16_render_loss")
rng = np.random.default_rng(12)

# %% [markdown]
# ## What fails without it
# Splatting has drawn a picture, and training needs one number that says how wrong it is. The mean
# absolute difference is such a number, but it adds up pixels one by one and does not see what they
# form together.
#
# The three pictures on the right are all wrong by 0.02 on average: one is too bright, one is noisy,
# and one is blurred. To the mean absolute difference they are equally good. SSIM, which this
# tutorial explains, compares their structure with that of the truth; 1 means "the same".

# %%
from p4dgs_ref import load_scene
from p4dgs_ref.equations import ssim
from p4dgs_ref.training.objective import psnr

photo = load_scene("bouncing").test[0].image[12:62, 4:58]
truth = photo.astype(float) * 0.8 + 0.1  # [50, 54, 3], away from 0 and 1
scipy_window = partial(gaussian_filter, sigma=1.5, radius=5, axes=(0, 1), mode="constant")
smooth = scipy_window(truth, mode="nearest")
changes = {
    "brighter": np.ones_like(truth),
    "noisy": rng.normal(size=truth.shape),
    "blurred": np.clip(smooth - truth, -0.1, 0.1),
}
images = {name: truth + 0.02 * c / np.abs(c).mean() for name, c in changes.items()}
scores = {name: ssim.forward(image, truth)[0] for name, image in images.items()}
for name, score in scores.items():
    print(f"{name}: SSIM {score:.3f}, PSNR {psnr(images[name], truth):.1f} dB")
assert scores["brighter"] > scores["blurred"] > scores["noisy"]

# %%
figure, axes = plt.subplots(1, 4, figsize=(14, 3.8), layout="constrained")
for ax, (name, image) in zip(axes, {"truth": truth, **images}.items()):
    ax.imshow(np.clip(image, 0, 1))
    ax.set(title=f"{name}: SSIM {scores.get(name, 1):.3f}", **show.BARE)
figures.show(figure, "16_same_difference")

# %% [markdown]
# ## Claim
# The loss of a picture therefore has a second term, which compares structure and has the weight
# $\lambda_{SSIM}$:
# $$\mathcal{L}_{render} = (1-\lambda_{SSIM})\,\mathcal{L}_1
# + \lambda_{SSIM}\,\mathcal{L}_{D-SSIM} \tag{16}$$
# With $x$ for the rendered image and $y$ for the true one, $\mathcal{L}_1$ is the mean of $|x - y|$
# over all pixels and channels. The paper does not define $\mathcal{L}_{D-SSIM}$. This project uses
# $1 - \mathrm{SSIM}$ (choice `Q13`), like Gaussian splatting. SSIM compares local means $\mu$,
# variances $\sigma^2$ and the covariance $\sigma_{xy}$, each computed with a Gaussian window around
# every pixel:
# $$\mathrm{SSIM} = \operatorname{mean}\frac{(2\mu_x\mu_y + C_1)(2\sigma_{xy} + C_2)}
#   {(\mu_x^2 + \mu_y^2 + C_1)(\sigma_x^2 + \sigma_y^2 + C_2)},$$
# where $C_1 = 0.01^2$ and $C_2 = 0.03^2$.

# %% [markdown]
# ## By hand
# Take a window of two pixels with equal weights. The truth is $(0.3, 0.5)$ and the image is
# $(0.2, 0.6)$, which has the right mean, 0.4, and twice the contrast. The variances are 0.04 for
# the image and 0.01 for the truth, and the covariance is 0.02. The first factor of SSIM is then 1,
# and the second one is $(0.04 + C_2)/(0.05 + C_2) = 0.8035$. With $\mathcal{L}_1 = 0.1$ and
# $\lambda_{SSIM} = 0.2$, the rendering loss is $0.8\cdot 0.1 + 0.2\cdot 0.1965 = 0.1193$.

# %%
second_factor = (2 * 0.02 + 0.03**2) / (0.04 + 0.01 + 0.03**2)
print(f"SSIM {second_factor:.4f}, rendering loss {0.8 * 0.1 + 0.2 * (1 - second_factor):.4f}")

# %% [markdown]
# ## In code
# Images have the shape `[H, W, C]`, and everything else is a number. The window is $11\times 11$
# pixels, Gaussian with $\sigma = 1.5$, and the image is surrounded by zeros. Each channel is
# treated separately. The function below is the formula above, with SciPy's filter as the window.

# %%
from p4dgs_ref.equations import render_loss, window
from p4dgs_ref.lessons import close, inner


# paper, Sec. 3.3: L1 and D-SSIM, weighted by lambda_SSIM
# silent: Q13, D-SSIM is 1 - SSIM, its window and constants, and lambda_SSIM = 0.2
def printed(x, y, blur=scipy_window):
    """Return the map [H, W, C] whose mean is SSIM."""
    mu_x, mu_y = blur(x), blur(y)
    var_x = blur(x * x) - mu_x**2
    var_y = blur(y * y) - mu_y**2
    cov = blur(x * y) - mu_x * mu_y
    means = (2 * mu_x * mu_y + ssim.C1) / (mu_x**2 + mu_y**2 + ssim.C1)
    structure = (2 * cov + ssim.C2) / (var_x + var_y + ssim.C2)
    return means * structure


for name, image in images.items():
    (L_render, L1, D_SSIM), _ = render_loss.forward(image, truth, 0.2)
    assert close(scores[name], printed(image, truth).mean())
    assert close(L1, 0.02)
    assert close(L_render, 0.8 * L1 + 0.2 * (1 - scores[name]))
    print(f"{name}: L_render {L_render:.4f}")

# %% [markdown]
# ## Backward by hand
# Eq. (16) is linear, so each of the two losses receives the cotangent of the sum times its weight.
# In $\mathcal{L}_1$, the slope of $|e|$ is the sign of $e$, divided by the number of values $n$:
# $\bar x = \mathrm{sign}(x - y)/n$. At the kink, where $x = y$, we choose 0.

# %%
image = truth + 0.1 * rng.normal(size=truth.shape)
image[0, 0] = truth[0, 0]
_, saved = render_loss.forward(image, truth, 0.2)
of_L1 = render_loss.backward(saved, 0.0, L1_bar=1.0)["image"]
assert close(of_L1, np.sign(image - truth) / image.size)
assert (of_L1[0, 0] == 0).all()

# %% [markdown]
# **SSIM.** First, consider the value at one pixel as a function of its moments. Let $e = x - y$.
# Each numerator is then its denominator minus a moment of $e$, because $2\mu_x\mu_y =
# \mu_x^2+\mu_y^2-\mu_e^2$ and $2\sigma_{xy}=\sigma_x^2+\sigma_y^2-\sigma_e^2$. With $D_1$ and $D_2$
# for the two denominators, including their constants,
# $$\mathrm{SSIM}_p = (1-\ell)(1-s),\quad \ell = \mu_e^2/D_1,\quad s = \sigma_e^2/D_2.$$
# This form makes the derivation short.

# %%
blur = window.blur
x, y = window.to_rows(image), window.to_rows(truth)  # [H, C, W], as ssim.py stores them
e = x - y
mu_x, mu_y, mu_e = blur(x), blur(y), blur(e)
var_x = blur(x * x) - mu_x**2
var_y = blur(y * y) - mu_y**2
D1 = mu_x**2 + mu_y**2 + ssim.C1
D2 = var_x + var_y + ssim.C2
ell = mu_e**2 / D1
s = (blur(e * e) - mu_e**2) / D2
of_formula = printed(image, truth).transpose(0, 2, 1)
assert close((1 - ell) * (1 - s), of_formula, 1e-10)

# %% [markdown]
# Only $x$ changes. Then $\mu_x$ and $\mu_e$ change *together*, by the same $d\mu$. Let $E$ be the
# local mean of $e^2$ and $X$ that of $x^2$, so that $\sigma_e^2 = E - \mu_e^2$ and
# $\sigma_x^2 = X - \mu_x^2$. By the quotient rule,
# $$d\ell = \frac{2(\mu_e - \ell\,\mu_x)}{D_1}\,d\mu,\qquad
#   ds = \frac{dE - s\,dX + 2(s\,\mu_x - \mu_e)\,d\mu}{D_2},$$
# $$d\,\mathrm{SSIM}_p = -(1-s)\,d\ell - (1-\ell)\,ds.$$
#
# For the whole image, all of these quantities are maps `[H, C, W]`, and each value has the share
# $1/n$ in the mean. Collecting the factors of $dE$, $dX$ and $d\mu$ gives
# $$\bar E = -\tfrac1n\frac{1-\ell}{D_2},\qquad \bar X = -s\,\bar E,\qquad
#   \bar\mu = -\tfrac2n\frac{(1-s)(\mu_e - \ell\,\mu_x)}{D_1} + 2\bar E\,(s\,\mu_x - \mu_e).$$
# The last step goes from the moments to the pixels. Each moment is a blur $G$ of something: of $x$,
# of $e^2$ or of $x^2$. A blur is a matrix, so its backward is the transposed matrix. This matrix is
# its own transpose, because pixel $p$ has the same weight in the window of $q$ as $q$ has in that
# of $p$. Hence
# $$\bar x = G\bar\mu + 2e\,G\bar E + 2x\,G\bar X.$$

# %%
a, b = rng.normal(size=(2, *x.shape))
assert close(inner(blur(a), b), inner(a, blur(b)), 1e-10)

n = image.size
E_bar = -(1 - ell) / D2 / n
X_bar = -s * E_bar
mu_bar = -2 / n * (1 - s) * (mu_e - ell * mu_x) / D1 + 2 * E_bar * (s * mu_x - mu_e)
x_bar = blur(mu_bar) + 2 * e * blur(E_bar) + 2 * x * blur(X_bar)
_, saved = ssim.forward(image, truth)
ours = ssim.backward(saved, 1.0)["image"]
assert close(ours, x_bar.transpose(0, 2, 1), 1e-8)

of_image = partial(ssim.forward, truth=truth)
_ = lessons.adjoint(rng, of_image, {"image": image}, 1.0, {"image": ours}, 1e-6)

# %% [markdown]
# **In the trained scene.** The left picture shows how wrong the demo's file draws one view. The two
# others show what the two parts of the loss ask of each pixel's red value: more of it where they
# are purple, less where they are orange. $\mathcal{L}_1$ pulls at a pixel that is nearly right as
# hard as at one that is wrong. SSIM divides by the local variance. It pulls hardest at errors in
# smooth places, such as the shading of the balls, and less at the strong edges of the slab. The
# purple ring is around *anchor 29*, on the highlight of the red ball.
#
# Going back through splatting (`15_compositing`), these pulls reach the colours of all Gaussians.
# For all of them together, the part of $\mathcal{L}_1$ is larger; for the three of anchor 29, that
# of SSIM.

# %%
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import FAST

model, camera, thread = tour.MODEL, tour.CAMERA, figures.THREAD
*gaussians, index = model.gaussians(tour.T, camera)
(drawn, *_), saved_picture = render.forward(*gaussians, camera, model.background, FAST)
_, saved = render_loss.forward(drawn, tour.TRUTH.astype(drawn.dtype), 0.2)
pulls = {
    "L1": render_loss.backward(saved, 0.0, L1_bar=0.8)["image"],
    "D-SSIM": render_loss.backward(saved, 0.0, D_SSIM_bar=0.2)["image"],
}
mine = index // model.design.k == thread.index
of_all, of_29 = [], []
for name, pull in pulls.items():
    color_bar = render.backward(saved_picture, pull)["color"]
    of_all.append(np.linalg.norm(color_bar))
    of_29.append(np.linalg.norm(color_bar[mine]))
    print(f"{name}: pull on all colours {of_all[-1]:.5f}, on those of anchor 29 {of_29[-1]:.5f}")
assert of_all[0] > 1.5 * of_all[1] and of_29[1] > 1.3 * of_29[0]

# %%
figure, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
maps = {"drawn minus true, red": (drawn - tour.TRUTH)[..., 0]}
maps |= {f"what {name} asks for": -drawn.size * pull[..., 0] for name, pull in pulls.items()}
ring = show.to_pixels(gaussians[0][mine].mean(axis=0), camera)
for ax, (name, values), limit in zip(axes, maps.items(), (0.2, 2, 2)):
    show.picture(ax, np.zeros_like(drawn), camera, title=name)
    place = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    shades = ax.imshow(values, cmap="PuOr", vmin=-limit, vmax=limit, extent=place)
    ax.plot(*ring, "o", ms=22, mfc="none", mec=thread.color, mew=3)
    ax.set(**tour.VIEW)
    figure.colorbar(shades, ax=ax, shrink=0.9)
figures.show(figure, "16_render_loss")

# %% [markdown]
# ## Break it
# At the border of the image, part of the window lies outside. Suppose we cut the window there and
# scale its remaining weights to a sum of one, instead of adding zeros. This is a sensible idea, but
# it is another function. Away from the border nothing changes, and training works as before. But
# the noisy image has an SSIM of 0.933 with zeros and of 0.840 without: the step to zero at the
# border is structure that both images share. Scores of the two kinds must not appear in the same
# table.


# %%
def cut_window(a):
    """Blur [H, C, W] with a window that is cut at the border."""
    return window.blur(a) / window.blur(np.ones_like(a))


def renormalised(image, truth):
    """Return the map of SSIM [H, C, W] with the cut window."""
    return printed(window.to_rows(image), window.to_rows(truth), cut_window)


def mean_of_renormalised(image, truth):
    return np.asarray(renormalised(image, truth).mean())


with_zeros = printed(images["noisy"], truth).transpose(0, 2, 1)
without = renormalised(images["noisy"], truth)
inside = np.s_[5:-5, :, 5:-5]
assert close(with_zeros[inside], without[inside], 1e-9)
print(f"SSIM with zeros {with_zeros.mean():.3f}, with a cut window {without.mean():.3f}")
assert with_zeros.mean() - without.mean() > 0.05
lessons.check_mistake(mean_of_renormalised, "ssim", "ssim-renormalised")

# %% [markdown]
# ## What this idea buys
# On `bouncing`, nothing that three trainings can show. With $\lambda_{SSIM} = 0$ and everything
# else as it is, the test views reach 33.8, 33.0 and 33.2 dB with seeds 0, 1 and 2, and with SSIM in
# the loss 33.5, 33.7 and 33.8 dB. The mean is 0.3 dB higher with it, but the first seed says the
# opposite, and even its SSIM is not better: 0.9868 with it, and 0.9871 without. The paper takes the
# loss from Gaussian splatting, and has no number for this part of it.

# %%
from tutorials import gains

without = gains.rows_of("p4dgs lambda_ssim=0", "ssim")
qualities = [
    [row["psnr_db"] for row in rows] for rows in (gains.rows_of("p4dgs", "training"), without)
]
for name, of_seeds in zip(("with SSIM", "without"), np.round(qualities, 2)):
    print(f"{name}: {of_seeds} dB, mean {of_seeds.mean():.2f}")
means = np.mean(qualities, axis=1)
assert round(means[0] - means[1], 1) == 0.3
assert qualities[0][0] < qualities[1][0] and round(without[0]["ssim"], 4) == 0.9871

# %% [markdown]
# **In short**
# - The loss of a picture is 0.8 times the mean absolute difference plus 0.2 times $1-$SSIM.
# - SSIM compares means, variances and covariance in a small window around every pixel.
# - A blur is its own transpose, so the backward of SSIM blurs gradients as the forward blurs
#   pictures.
#
# **Often misunderstood**
# - *A higher SSIM is a higher PSNR.* In the first figure, the blurred picture has a higher SSIM
#   than the noisy one (0.947 and 0.933), but a lower PSNR (30.0 and 32.0 dB).
# - *$\mathcal{L}_{D-SSIM}$ is $(1-\mathrm{SSIM})/2$.* Some programs halve it. Here and in Gaussian
#   splatting it is $1-\mathrm{SSIM}$.
# - *SSIM is one number, whatever program computes it.* Window, border and constants differ, and
#   with them the score.

# %% [markdown]
# ## Exercises
# **16.1** ● In the window of "By hand", two other images have $\mathcal{L}_1 = 0.1$: $(0.4, 0.6)$,
# which is brighter, and $(0.4, 0.4)$, which is blurred. Give the rendering losses of both, as a
# list of two numbers. ($C_1 = 0.01^2$ matters in the first, $C_2 = 0.03^2$ in the second.)
#
# **16.2** ● Write Eq. (16). `ssim.dissimilarity(image, truth)[0]` is $1 - \mathrm{SSIM}$ with all
# its digits. Subtracting a rounded SSIM from $1$ loses digits, and one golden case has nearly equal
# images.
#
# **16.3** ●●● Write the backward of SSIM, with `window.blur`.
#
# **Predict, then run.** Both pictures are made half as bright. What happens to $\mathcal{L}_1$, and
# what to $1 - \mathrm{SSIM}$?

# %%
answer_1 = ...


def my_forward(image, truth, lambda_ssim):
    """Return L_render, L1 and D_SSIM for two images [H, W, C]."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return {"image": gradient [H, W, C]}.

    `inputs` holds "image" and "truth", and cotangents["ssim_bar"] is a number.
    """
    raise NotImplementedError


lessons.check_number("16.1", answer_1)
lessons.check_forward("16.2", my_forward, "render_loss")
lessons.check_backward("16.3", my_backward, "ssim")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only render_loss` compares what a port wrote, and the same works
# with `ssim`. Ports halve $1 - \mathrm{SSIM}$, use constants for images from $0$
# to $255$, or take a sum where the mean is meant. The checker knows these mistakes by name.


# %%
lessons.passes("render_loss", "ssim")

# %% [markdown]
# ## For ports
# SSIM is almost 1 where two pictures are nearly equal, and $1 - \mathrm{SSIM}$ then loses its
# digits. In the form $(1-\ell)(1-s)$ of "Backward by hand", $\ell = s = 0$ where the pictures are
# equal, and nothing cancels. `ssim.dissimilarity` computes it in this way.

# %%
nearly = truth + 1e-9
print(1 - ssim.forward(nearly, truth)[0], ssim.dissimilarity(nearly, truth)[0])
