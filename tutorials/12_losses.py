# %% [markdown]
# # Eqs. (15) and (16): what training minimises
#
# **Promise.** After this you can derive the gradient of SSIM by hand, and say what the rate weight trades for what.
# **Before it:** `01_offsets`. **Takes** six seconds of machine time on two cores, forty minutes of yours.

# %%
import numpy as np
from scipy.ndimage import gaussian_filter

from p4dgs_ref import EQUATIONS, load_scene, oracle
from p4dgs_ref.equations import render_loss, ssim, total_loss, window
from p4dgs_ref.school import lessons

plt, rng, h = lessons.pyplot(), np.random.default_rng(12), 1e-6
inner = lambda a, b: (a * b).sum()
truth = (
    load_scene("bouncing").test[0].image[12:62, 4:58].astype(float) * 0.8 + 0.1
)  # (50, 54, 3), away from 0 and 1

# %% [markdown]
# ## Claim
# Training weighs bits against pictures, and in the picture absolute differences against structure:
# $$\mathcal{L}_{total} = \lambda_{rate}\,\mathcal{L}_{rate} + \mathcal{L}_{render} \tag{15}$$
# $$\mathcal{L}_{render} = (1-\lambda_{SSIM})\,\mathcal{L}_1 + \lambda_{SSIM}\,\mathcal{L}_{D-SSIM} \tag{16}$$

# %% [markdown]
# $x$ is the rendered picture, $y$ the true one; $\mathcal{L}_1$ is the mean of $|x - y|$ over pixels and channels. The paper does
# not define $\mathcal{L}_{D-SSIM}$; we take $1 - \mathrm{SSIM}$ (choice Q13), as Gaussian splatting does. SSIM compares means
# $\mu$, variances $\sigma^2$ and the covariance $\sigma_{xy}$, all weighted by a Gaussian window round each pixel:

# %% [markdown]
# $$\mathrm{SSIM} = \operatorname{mean}\frac{(2\mu_x\mu_y + C_1)(2\sigma_{xy} + C_2)}
#   {(\mu_x^2 + \mu_y^2 + C_1)(\sigma_x^2 + \sigma_y^2 + C_2)},\qquad C_1 = 0.01^2,\quad C_2 = 0.03^2.$$

# %% [markdown]
# ## By hand
# Take a window of two pixels with equal weights. The truth is 0.3 and 0.5, the picture 0.2 and 0.6: the right mean, 0.4, and
# twice the contrast. Variances 0.04 and 0.01, covariance 0.02. The first factor is 1; the second, and so SSIM, is 0.8035.
# With $\mathcal{L}_1$ of 0.1 and $\lambda_{SSIM} = 0.2$ the render loss is 0.1193.

# %%
x, y = np.array([0.2, 0.6]), np.array([0.3, 0.5])
cov = (x * y).mean() - x.mean() * y.mean()
assert (
    x.tolist() == [0.2, 0.6] and y.tolist() == [0.3, 0.5] and np.allclose([x.mean(), y.mean()], 0.4)
)
assert np.allclose([x.var(), y.var(), cov], [0.04, 0.01, 0.02])
first = (2 * x.mean() * y.mean() + ssim.C1) / (x.mean() ** 2 + y.mean() ** 2 + ssim.C1)
second = (2 * cov + ssim.C2) / (x.var() + y.var() + ssim.C2)
L1 = np.abs(x - y).mean()
assert np.isclose(first, 1) and round(first * second, 4) == 0.8035 and np.isclose(L1, 0.1)
assert round(0.8 * L1 + 0.2 * (1 - first * second), 4) == 0.1193

# %% [markdown]
# ## In code
# Images are `(H, W, C)`; everything else is a number. The window is $11\times 11$, Gaussian of $\sigma = 1.5$, and around the
# image lie zeros. Channels are treated apart. Here is the formula above in SciPy's words, beside ours.


# %%
def printed(x, y, blur=lambda a: gaussian_filter(a, 1.5, radius=5, mode="constant", axes=(0, 1))):
    """The map (H, W, C) whose mean is SSIM."""
    mu_x, mu_y = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - mu_x**2, blur(y * y) - mu_y**2, blur(x * y) - mu_x * mu_y
    first = (2 * mu_x * mu_y + ssim.C1) / (mu_x**2 + mu_y**2 + ssim.C1)
    return first * (2 * cov + ssim.C2) / (var_x + var_y + ssim.C2)


unit = lambda a: a / np.abs(a).mean()  # so that L1 is one
smooth = gaussian_filter(truth, 1.5, radius=5, mode="nearest", axes=(0, 1))
damages = {
    "all brighter": np.ones_like(truth),
    "noisy": unit(rng.normal(size=truth.shape)),
    "blurred": unit(np.where(smooth < truth, -1, 1) * np.minimum(np.abs(smooth - truth), 0.1)),
}
images = {name: truth + 0.02 * change for name, change in damages.items()}
scores = {name: ssim.forward(image, truth)[0].ssim for name, image in images.items()}
for name, image in images.items():
    out, _ = render_loss.forward(image, truth, 0.2)
    assert np.isclose(scores[name], printed(image, truth).mean(), rtol=1e-12) and np.isclose(
        out.L1, 0.02
    )
    assert np.isclose(out.L_render, 0.8 * out.L1 + 0.2 * (1 - scores[name]), rtol=1e-12)
    total = total_loss.forward(out.L_render, np.array(2.4), 1e-3)[0].L_total
    print(
        f"{name}: L1 {out.L1:.3f}, SSIM {scores[name]:.4f}, L_render {out.L_render:.4f}, at 2.4 bits L_total {total:.4f}"
    )
assert scores["all brighter"] > scores["blurred"] > scores["noisy"]

# %% [markdown]
# Three damages with one and the same $\mathcal{L}_1$. For SSIM they are far apart, and it asks the pixels for different things:
# of the brighter picture for almost nothing. Below each is $-n\,\partial(1-\mathrm{SSIM})/\partial x$ of the red channel, the way
# a descent would go ($n$ is how many numbers a picture has); bottom left, where the blurred picture loses its SSIM.

# %%
figure, panels = plt.subplots(2, 4, figsize=(14, 7), layout="constrained")
panels[0, 0].imshow(truth)
panels[0, 0].set_title("truth")
for column, (name, image) in enumerate(images.items(), 1):
    wish = -ssim.backward(ssim.forward(image, truth)[1], -1.0)["image"][..., 0] * image.size
    panels[0, column].imshow(np.clip(image, 0, 1))
    panels[0, column].set_title(f"{name}: SSIM {scores[name]:.3f}")
    shown = panels[1, column].imshow(wish, cmap="PuOr", vmin=-8, vmax=8)
    panels[1, column].set_title(r"what $1-$SSIM wants")
panels[1, 0].imshow(1 - printed(images["blurred"], truth).mean(axis=2), cmap="cividis", vmin=0)
panels[1, 0].set_title(r"blurred: map of $1-$SSIM")
for ax in panels.ravel():
    ax.set(xticks=[0, 25, 50], yticks=[0, 25])
    ax.grid(False)
panels[1, 0].set(xlabel="u (pixels)", ylabel="v (pixels)")
figure.colorbar(shown, ax=panels[1], label="a pixel shall be brighter (+) or darker", shrink=0.9)
figure.suptitle(r"The same $\mathcal{L}_1$ of 0.02, three different pictures for SSIM", fontsize=16)
lessons.show(figure, "12_losses")

# %% [markdown]
# ## Backward by hand
# Eqs. (15) and (16) are linear: each loss receives the gradient of the sum times its weight. In $\mathcal{L}_1$ the slope of
# $|e|$ is its sign, shared among $n$ numbers: $\bar x = \mathrm{sign}(x - y)/n$. At the kink, $x = y$, we choose 0.

# %%
image = truth + 0.1 * rng.normal(size=truth.shape)
image[0, 0] = truth[0, 0]
out, res = render_loss.forward(image, truth, 0.2)
of_L1 = render_loss.backward(res, L1_bar=1.0)["image"]
assert np.array_equal(of_L1, np.sign(image - truth) / image.size) and (of_L1[0, 0] == 0).all()
bars = total_loss.backward(total_loss.forward(out.L_render, np.array(2.4), 1e-3)[1], 5.0)
assert bars["L_rate"] == 1e-3 * 5 and bars["L_render"] == 5

# %% [markdown]
# **SSIM**, first one pixel's value as a function of its moments. A trick makes it short. With $e = x - y$, each numerator is
# the denominator less a moment of $e$: $2\mu_x\mu_y = \mu_x^2+\mu_y^2-\mu_e^2$, $2\sigma_{xy}=\sigma_x^2+\sigma_y^2-\sigma_e^2$.
# $$\mathrm{SSIM}_p = (1-\ell)(1-s),\quad \ell = \mu_e^2/D_1,\quad s = \sigma_e^2/D_2,$$
# with $D_1$, $D_2$ the two denominators, constants included. Where pictures are equal, $\ell = s = 0$, and nothing cancels.

# %%
blur = window.blur
x, y = window.to_rows(image), window.to_rows(truth)  # (H, C, W), as ssim.py keeps them
mu_x, mu_y, mu_e = blur(x), blur(y), blur(x - y)
var_y = blur(y * y) - mu_y**2
D1, D2 = mu_x**2 + mu_y**2 + ssim.C1, blur(x * x) - mu_x**2 + var_y + ssim.C2
ell, s = mu_e**2 / D1, (blur((x - y) ** 2) - mu_e**2) / D2
assert np.allclose((1 - ell) * (1 - s), printed(image, truth).transpose(0, 2, 1), rtol=1e-10)
assert ssim.dissimilarity(truth, truth)[0] == 0

# %% [markdown]
# Only $x$ moves. Then $\mu_x$ and $\mu_e$ move *together*, by the same $d\mu$. Let $E$ be the mean of $e^2$, $X$ that of $x^2$,
# so $\sigma_e^2 = E - \mu_e^2$, $\sigma_x^2 = X - \mu_x^2$. By the rule for quotients
# $$d\ell = \frac{2(\mu_e - \ell\,\mu_x)}{D_1}\,d\mu,\qquad
#   ds = \frac{dE - s\,dX + 2(s\,\mu_x - \mu_e)\,d\mu}{D_2},\quad d\,\mathrm{SSIM}_p = -(1-s)\,d\ell - (1-\ell)\,ds.$$


# %%
def at(mu, E, X, y=0.4, var=0.02):
    ell = (mu - y) ** 2 / (mu**2 + y**2 + ssim.C1)
    return ell, (E - (mu - y) ** 2) / (X - mu**2 + var + ssim.C2)


m, E, X = 0.5, 0.03, 0.3
l_0, s_0 = at(m, E, X)
d1, d2 = m**2 + 0.4**2 + ssim.C1, X - m**2 + 0.02 + ssim.C2
slopes = np.array(
    [[2 * ((m - 0.4) - l_0 * m) / d1, 2 * (s_0 * m - (m - 0.4)) / d2], [0, 1 / d2], [0, -s_0 / d2]]
)
steps = [
    np.subtract(at(*(np.array([m, E, X]) + d)), at(*(np.array([m, E, X]) - d))) / (2 * h)
    for d in h * np.eye(3)
]
assert np.allclose(steps, slopes, rtol=1e-7, atol=1e-9)

# %% [markdown]
# Now shapes: all are maps, `(H, C, W)`; in the mean each entry has a share of $1/n$. Collect what multiplies $dE$, $dX$, $d\mu$:
# $$\bar E = -\tfrac1n\frac{1-\ell}{D_2},\qquad \bar X = -s\,\bar E,\qquad
#   \bar\mu = -\tfrac2n\frac{(1-s)(\mu_e - \ell\,\mu_x)}{D_1} + 2\bar E\,(s\,\mu_x - \mu_e).$$
# In `ssim.py` these are `square_e_bar`, `square_x_bar` and `mu_bar`, in this order.

# %%
n = image.size
E_bar = -(1 - ell) / D2 / n
X_bar = -s * E_bar
mu_bar = -2 / n * (1 - s) * (mu_e - ell * mu_x) / D1 + 2 * E_bar * (s * mu_x - mu_e)

# %% [markdown]
# Last, from the moments to the pixels. Each moment is a blur $G$: of $x$, of $e^2$, of $x^2$. A blur is a matrix, so its backward
# is its transpose, and this one is its own: pixel $p$ weighs $q$ as $q$ weighs $p$, zeros around the image or not. Hence
# $$\bar x = G\bar\mu + 2e\,G\bar E + 2x\,G\bar X.$$

# %%
a, b = rng.normal(size=(2, *x.shape))
assert np.isclose(inner(blur(a), b), inner(a, blur(b)), rtol=1e-10)  # G is its own transpose
x_bar = blur(mu_bar) + 2 * (x - y) * blur(E_bar) + 2 * x * blur(X_bar)
ours = ssim.backward(ssim.forward(image, truth)[1], 1.0)["image"]
assert np.allclose(ours, x_bar.transpose(0, 2, 1), rtol=1e-8, atol=1e-14)
d = rng.normal(size=image.shape)
difference = (
    ssim.forward(image + h * d, truth)[0].ssim - ssim.forward(image - h * d, truth)[0].ssim
) / (2 * h)
assert abs(difference - inner(ours, d)) < 1e-6 * abs(difference)
print(f"by differences {difference:.8f}, by gradient {inner(ours, d):.8f}")

# %% [markdown]
# ## Break it
# At the border part of the window lies outside. Cut it and bring its weights back to one, instead of padding with zeros: a
# sensible idea, and another function. Away from the border nothing differs, and training goes on. But the noisy picture has
# SSIM 0.933 with zeros and 0.840 without: the edge to the zeros is structure that all pictures share. Such scores must not
# stand in one table.


# %%
def careless(image, truth):
    """The map of SSIM (H, C, W) with a window that is cut at the border and weighs one again."""
    cut = lambda a: window.blur(a) / window.blur(np.ones_like(a))
    return printed(window.to_rows(image), window.to_rows(truth), cut)


ours, theirs = printed(images["noisy"], truth).transpose(0, 2, 1), careless(images["noisy"], truth)
assert np.allclose(ours[5:-5, :, 5:-5], theirs[5:-5, :, 5:-5], rtol=1e-9)  # the same inside
assert round(ours.mean(), 3) == 0.933 and round(theirs.mean(), 3) == 0.840
verdict = oracle.check(lambda image, truth: np.asarray(careless(image, truth).mean()), "ssim")
assert not verdict.ok and "ssim-renormalised" in verdict.first.explanation
print("the checker:", verdict.first.explanation)

# %% [markdown]
# ## What a codec does with it
# Eq. (15) is what video encoders minimise: distortion plus $\lambda$ times rate. $\lambda$ is a price, loss per bit. Take the
# simplest codec, pixels rounded to a step $q$ and coded at their entropy. For each price one step is best: the point where a
# line of slope $-\lambda$ touches the curve from below.

# %%
points = []
for q in np.geomspace(0.01, 0.6, 40):
    symbols = np.round(truth / q)
    share = np.unique(symbols, return_counts=True)[1] / symbols.size
    points.append(
        (-(share * np.log2(share)).sum(), render_loss.forward(symbols * q, truth, 0.2)[0].L_render)
    )
rate, distortion = np.array(points).T
figure, ax = plt.subplots(figsize=(9, 5))
ax.plot(rate, distortion, "o", ms=5, color="0.6", label="one step q each")
best = {}
for price, color in zip((0.003, 0.01, 0.03, 0.1), lessons.COLORS):
    best[price] = i = np.argmin(price * rate + distortion)
    assert (
        distortion >= distortion[i] - price * (rate - rate[i]) - 1e-15
    ).all()  # the line touches from below
    reach = rate[i] + np.array([-1, 1]) * 0.8
    ax.plot(
        reach,
        distortion[i] - price * (reach - rate[i]),
        color=color,
        label=rf"slope $-\lambda$, $\lambda$ = {price}",
    )
    ax.plot(rate[i], distortion[i], "o", ms=11, color=color)
ax.set(
    xlabel="rate (bits per number)",
    ylabel=r"$\mathcal{L}_{render}$",
    ylim=(-0.01, None),
    title=r"$\lambda_{rate}$ picks a point: where its line touches the curve",
)
ax.legend()
lessons.show(figure, "12_losses_rate")
assert all(
    rate[best[low]] >= rate[best[high]] for low, high in ((0.003, 0.01), (0.01, 0.03), (0.03, 0.1))
)

# %% [markdown]
# Our $\mathcal{L}_{rate}$ is in bits per parameter (Q12), so that a $\lambda_{rate}$ means the same for small and large scenes.
# The paper's Eq. (17) is a plain sum of bits. With it the same $\lambda_{rate}$ would cost a scene of ten times the anchors ten
# times as much, beside a $\mathcal{L}_{render}$ that is a mean.

# %% [markdown]
# ## Exercises
# **12.1** For the golden case printed below, with $\lambda_{rate} = 10^{-3}$, three numbers: $\mathcal{L}_{total}$,
# $\bar{\mathcal{L}}_{render}$, $\bar{\mathcal{L}}_{rate}$; `out_bar.L_total` is $\bar{\mathcal{L}}_{total}$.
# **12.2** Write Eq. (16); `ssim.dissimilarity(image, truth)[0]` is $1 - \mathrm{SSIM}$ with all its digits, which $1$ less
# a rounded SSIM is not: one golden case has nearly equal images. **12.3** Write the backward of SSIM, with `window.blur`.

# %%
given = lessons.golden("total_loss/ordinary")
print({name: float(given[name]) for name in ("in.L_render", "in.L_rate", "out_bar.L_total")})
answer_1 = ...


def my_forward(image, truth, lambda_ssim):
    """image, truth (H, W, C) -> L_render, L1, D_SSIM."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"image": gradient (H, W, C)}, from inputs["image"], inputs["truth"] and the number cotangents["ssim_bar"]."""
    raise NotImplementedError


lessons.number(
    "12.1", answer_1, [given[name] for name in ("out.L_total", "in_bar.L_render", "in_bar.L_rate")]
)
lessons.forward("12.2", my_forward, "render_loss")
lessons.backward("12.3", my_backward, "ssim")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only render_loss`, and the same with `total_loss` and `ssim`. Ports halve $1 - \mathrm{SSIM}$,
# take the constants of pictures from $0$ to $255$, or sum where the mean is meant. The checker knows these by name.

# %%
for key, equation in (("total_loss", total_loss), ("render_loss", render_loss), ("ssim", ssim)):
    verdict = oracle.check(
        lambda **inputs: equation.forward(**inputs)[0],
        key,
        lambda inputs, cotangents: equation.backward(equation.forward(**inputs)[1], **cotangents),
    )
    print(key, verdict)
    assert verdict.ok
assert EQUATIONS["total_loss"].number == "15" and EQUATIONS["render_loss"].number == "16"
