# %% [markdown]
# # Support: from splats to a pixel's colour, and back without a division
#
# **Promise.** After this you can composite splats by hand and derive the gradient of every opacity by one sweep from the back.
# **Before it:** `14_projection`. **Takes** six seconds of machine time on two cores, an hour of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import compositing

plt, rng, h = lessons.pyplot(), np.random.default_rng(15), 1e-6
inner = lambda a, b: (a * b).sum()

# %% [markdown]
# ## Claim
# A pixel $p$ looks through all splats, nearest first. Each shows its colour as far as those before it let light through:
# $$C(p) = \sum_i c_i\,\alpha_i(p)\,T_i(p) + T_N(p)\,c_{bg},\quad T_i = \prod_{j<i}(1-\alpha_j),\quad
#   \alpha_i(p) = \min\bigl(0.99,\ \alpha_i\,e^{-\frac12 (p-\mu_i)^T K_i (p-\mu_i)}\bigr).$$

# %% [markdown]
# $T_i$ is the *transmittance* before splat $i$, $\alpha_i T_i$ its *weight*, $K_i$ the conic of `14_projection`, $\alpha_i$ the
# opacity of Eq. (3), $N$ how many splats there are. $0.99$ lets some light through to all that is behind. The paper does not
# print this sum; it is Gaussian splatting's.

# %% [markdown]
# ## By hand
# One pixel, three layers with opacities 0.5, 0.5 and 0.8 and gray values 1, 0 and 0.5 before a white background. Light before
# each layer: 1, 0.5, 0.25, and 0.05 behind the last. Weights: 0.5, 0.25, 0.2. The pixel is 0.5 + 0 + 0.1 + 0.05 = 0.65.

# %%
alpha, gray, background = np.array([0.5, 0.5, 0.8]), np.array([1, 0, 0.5]), 1
T = np.array([1, 0.5, 0.5 * 0.5, 0.5 * 0.5 * (1 - 0.8)])
weight = alpha * T[:3]
assert (
    alpha.tolist() == [0.5, 0.5, 0.8]
    and gray.tolist() == [1, 0, 0.5]
    and np.allclose(T, [1, 0.5, 0.25, 0.05])
)
assert np.allclose(weight, [0.5, 0.25, 0.2]) and np.allclose(weight * gray, [0.5, 0, 0.1])
pixel = weight @ gray + T[3] * background
assert np.isclose(pixel, 0.65) and np.isclose(weight.sum() + T[3], 1)

# %% [markdown]
# The weights and what is left for the background sum to one: nothing is lost. The same number comes from the *back*, by
# putting one layer after the other over what is behind it, and this second way will be the whole backward:
# $$B_{N-1} = c_{bg},\qquad B_{i-1} = \alpha_i c_i + (1-\alpha_i)\,B_i,\qquad C = B_{-1}.$$

# %%
behind = [background]  # B_2, B_1, B_0, B_-1
for a, c in zip(alpha[::-1], gray[::-1]):
    behind.append(a * c + (1 - a) * behind[-1])
assert np.isclose(behind[-1], pixel)
figure, (light, over) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
light.bar(range(4), T, color="0.85", label="light that arrives, $T_i$")
light.bar(
    range(4),
    [*weight, T[3]],
    color=lessons.COLORS[0],
    width=0.6,
    label=r"light that is used, $\alpha_i T_i$",
)
over.plot(
    range(-1, 3),
    behind[::-1],
    "o-",
    ms=11,
    color=lessons.COLORS[1],
    label="$B_i$, what stands behind layer i",
)
over.plot(range(3), gray, "s", ms=11, color=lessons.COLORS[2], label="$c_i$, the layer's own gray")
over.annotate("the pixel", (-1, behind[-1]), (-0.95, 0.3), arrowprops=dict(arrowstyle="->"))
light.set(
    xticks=range(4),
    xticklabels=["layer 0", "layer 1", "layer 2", "background"],
    ylabel="share of light",
    title="From the front: how much is seen",
)
over.set(
    xticks=range(-1, 3),
    xlabel="layer",
    ylabel="gray value",
    title="From the back: what is seen",
    ylim=(-0.1, 1.35),
)
light.legend(), over.legend(loc="upper left", fontsize=11)
figure.suptitle("One pixel, three layers: two ways to the same value", fontsize=16)
lessons.show(figure, "15_compositing_pixel")

# %% [markdown]
# ## In code
# For all splats at all pixels: `A (M, P)` is each visible splat's opacity at each pixel, front to back; `before (M, P)` the light
# that arrives. Then `w = A * before` and `image = w.T @ color + T[:, None] * background`. Sorting is by depth, ties by index.

# %%
height, width = 24, 32
splats = compositing.random_splats(rng, 6, height, width, sigma=(2.5, 6.0))
inputs = dict(**splats, background=np.array([0.9, 0.5, 0.2]), height=height, width=width)
out, res = compositing.forward(**inputs)
order = np.argsort(splats["depth"], kind="stable")
y, x = np.indices((height, width)).reshape(2, 1, -1)
e_x, e_y = (
    x - splats["mean2d"][order, :1],
    y - splats["mean2d"][order, 1:],
)  # from the mean to the pixel
a, b, c = splats["conic"][order].T[:, :, None]
falloff = np.exp(-0.5 * (a * e_x**2 + 2 * b * e_x * e_y + c * e_y**2))
raw = splats["alpha"][order, None] * falloff
A = np.minimum(raw, 0.99)
before = np.cumprod(np.concatenate([np.ones((1, A.shape[1])), 1 - A]), axis=0)
T_N, color = before[-1], splats["color"][order]
image = (A * before[:-1]).T @ color + T_N[:, None] * inputs["background"]
assert np.allclose(out.image, image.reshape(height, width, 3), rtol=1e-12) and np.allclose(
    out.transmittance.ravel(), T_N
)

# %% [markdown]
# ## Backward by hand
# **One layer**, gray: $C = \alpha c + (1-\alpha)B$. With $g = \bar C$: $\bar c = \alpha g$, $\bar B = (1-\alpha)g$, and
# $$\bar\alpha = (c - B)\,g.$$
# More of a layer is good only if it is better than what it hides. With $c = 0.5$, $B = 1$, $g = 2$ that is -1.

# %%
value, hidden, g = 0.5, 1, 2
one = lambda alpha: alpha * value + (1 - alpha) * hidden
assert (value - hidden) * g == -1 and np.isclose(g * (one(0.8 + h) - one(0.8 - h)) / (2 * h), -1)

# %% [markdown]
# **Many layers.** All that layer $i$ and those behind it contribute is seen through $T_i$, which does not contain $\alpha_i$:
# $$C = \sum_{j<i} c_j\alpha_jT_j \;+\; T_i\,\bigl(\alpha_i c_i + (1-\alpha_i)\,B_i\bigr)
#   \;\Longrightarrow\; \bar\alpha_i = T_i\,(c_i - B_i)\,g.$$

# %%
alpha_bar = T[:3] * (gray - np.array(behind[2::-1]))  # B_0, B_1, B_2 and g = 1
composite = lambda alpha: (
    (alpha * np.cumprod([1, *(1 - alpha)])[:3]) @ gray + np.prod(1 - alpha) * background
)
for i in range(3):
    step = h * np.eye(3)[i]
    assert np.isclose(
        (composite(alpha + step) - composite(alpha - step)) / (2 * h), alpha_bar[i], rtol=1e-8
    )
print("gradient of the three opacities:", alpha_bar.round(4))

# %% [markdown]
# No division, and one sweep from the back: keep `behind` and update it by $B_{i-1} = B_i + \alpha_i(c_i - B_i)$. With colours,
# $g$ has three entries; everything is linear in them, so the sweep carries numbers $v_i = c_i\cdot g$ in place of colours. If the
# transmittance is an output too, its $\bar T_N$ joins the background's: `behind = g @ background + h`, with $h = \bar T_N$.

# %%
image_bar, T_bar = rng.normal(size=(height, width, 3)), rng.normal(size=(height, width))
G = image_bar.reshape(-1, 3)
v, light_behind = color @ G.T, G @ inputs["background"] + T_bar.ravel()
A_bar = np.empty_like(A)
for i in reversed(range(len(A))):
    gain = v[i] - light_behind  # v_i - B_i
    light_behind = light_behind + A[i] * gain  # B_(i-1)
    A_bar[i] = before[i] * gain  # T_i (v_i - B_i)
ours = compositing.backward(res, image_bar, T_bar)
assert np.allclose(
    ours["color"][order], (A * before[:-1]) @ G, rtol=1e-10
)  # each colour: its weights
assert np.allclose(ours["background"], T_N @ G, rtol=1e-10)  # the background: what is left

# %% [markdown]
# **From $\alpha_i(p)$ to the splat**, on a line first: $\alpha(p) = \alpha\,e^{-\frac12 k e^2}$, $e = p - \mu$. Its logarithm:
# $$d\log\alpha(p) = \frac{d\alpha}{\alpha} - \tfrac12 e^2\,dk + k\,e\,d\mu$$
# The last sign is plus, since $e$ falls when $\mu$ grows. Where $0.99$ is the smaller, nothing passes.

# %%
at, k, top, p = 1.2, 0.4, 0.7, 3
fall = lambda at, k, top: np.log(top * np.exp(-0.5 * k * (p - at) ** 2))
slopes = [k * (p - at), -0.5 * (p - at) ** 2, 1 / top]
steps = [
    (fall(*(np.array([at, k, top]) + d)) - fall(*(np.array([at, k, top]) - d))) / (2 * h)
    for d in h * np.eye(3)
]
assert np.allclose(steps, slopes, rtol=1e-8)
clamped = raw > 0.99

# %% [markdown]
# In the plane the exponent is $-\frac12(a e_x^2 + 2b\,e_x e_y + c\,e_y^2)$. Write $V = \bar\alpha(p)\,\alpha(p)$. A splat serves
# all pixels, so everything is a sum over $p$; and $b$ stands twice in the exponent, so its $\frac12$ is gone:
# $$\bar\mu = \sum_p V\begin{pmatrix} a e_x + b e_y \\ b e_x + c e_y\end{pmatrix},\quad \bar a = -\tfrac12\sum_p V e_x^2,\quad
#   \bar b = -\sum_p V e_x e_y,\quad \bar c = -\tfrac12\sum_p V e_y^2,\quad \bar\alpha = \sum_p \bar\alpha(p)\,e^{\dots}$$

# %%
A_bar = np.where(clamped, 0, A_bar)
V = A_bar * raw
terms = {
    "alpha": A_bar * falloff,
    "mean2d": np.stack([V * (a * e_x + b * e_y), V * (b * e_x + c * e_y)], axis=1),
    "conic": np.stack([-0.5 * V * e_x**2, -V * e_x * e_y, -0.5 * V * e_y**2], axis=1),
}
for name, term in terms.items():
    assert np.allclose(ours[name][order], term.sum(axis=-1), rtol=1e-9, atol=1e-12)

# %% [markdown]
# All together, the adjoint identity, against differences of the forward in all five inputs.

# %%
moved = ("mean2d", "conic", "alpha", "color", "background")
d = {n: rng.normal(size=inputs[n].shape) * (0.01 if n == "conic" else 1) for n in moved}
up, down = (
    compositing.forward(**{**inputs, **{n: inputs[n] + s * h * d[n] for n in moved}})[0]
    for s in (1, -1)
)
difference = (
    inner(image_bar, up.image - down.image) + inner(T_bar, up.transmittance - down.transmittance)
) / (2 * h)
assert abs(difference - sum(inner(ours[n], d[n]) for n in moved)) < 1e-6 * abs(difference)

# %% [markdown]
# What do the pixels want of a splat? Two round splats, the front one out of place; the loss is $\frac12\|C - C^*\|^2$. Each pixel
# pulls each opacity up where more of it is missing, down where it hides what should be seen: $-T_i\,(c_i - B_i)\cdot g$. These
# pulls, each times $\alpha_i(p)\,K_i(p - \mu_i)$ as above, add up to the arrow that moves the splat.

# %%
k, front, back = (0.06, 0.02), np.array([0.9, 0.6, 0]), np.array([0, 0.45, 0.7])
pair = dict(
    mean2d=np.array([[12.0, 14], [20, 11]]),
    conic=np.outer(k, [1, 0, 1]),
    alpha=np.array([0.8, 0.9]),
    color=np.stack([front, back]),
    depth=np.array([1.0, 2]),
    visible=np.ones(2, bool),
    background=np.ones(3),
    height=height,
    width=width,
)
target = compositing.forward(**{**pair, "mean2d": np.array([[15.0, 10], [20, 11]])})[0].image
seen, residual = compositing.forward(**pair)
error, bars = seen.image - target, compositing.backward(residual, seen.image - target)
rows, columns = np.indices((height, width))
fall_0, fall_1 = (
    np.exp(-0.5 * k[i] * ((columns - m[0]) ** 2 + (rows - m[1]) ** 2))
    for i, m in enumerate(pair["mean2d"])
)
A_0, A_1 = 0.8 * fall_0[..., None], 0.9 * fall_1[..., None]
pulls = [
    -((front - (A_1 * back + 1 - A_1)) * error).sum(axis=2),
    -((1 - A_0) * (back - 1) * error).sum(axis=2),
]
assert np.allclose([-inner(pulls[0], fall_0), -inner(pulls[1], fall_1)], bars["alpha"], rtol=1e-10)
figure, panels = plt.subplots(1, 4, figsize=(14, 3.9), layout="constrained", sharey=True)
names = ("as it is", "as it should be", "pull at the front splat", "pull at the back splat")
for ax, picture, name in zip(panels, (seen.image, target, *pulls), names):
    shown = ax.imshow(picture, cmap="PuOr", vmin=-0.6, vmax=0.6)
    ax.set(title=name, xlabel="u (pixels)")
    ax.grid(False)
for i in range(2):
    panels[2 + i].quiver(
        *pair["mean2d"][i],
        *-5 * bars["mean2d"][i],
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.02,
    )
panels[0].set_ylabel("v (pixels)")
figure.colorbar(shown, ax=panels, label=r"$-\bar\alpha_i(p)$: more (+) or less", shrink=0.7)
figure.suptitle(
    r"Every pixel pulls at every splat that covers it; arrows: $-5\,\bar\mu$", fontsize=16
)
lessons.show(figure, "15_compositing")

# %% [markdown]
# ## Break it
# Another formula, with $S_i$ all that stands behind layer $i$ as the pixel sees it, is right too. It *divides*:
# $$S_i = T_i\,(1-\alpha_i)\,B_i = C - \sum_{j\le i} c_j\alpha_jT_j \Rightarrow \bar\alpha_i = T_ic_i - \frac{S_i}{1-\alpha_i}$$
# Shapes, signs and ordinary pixels look fine. An opaque layer is $0/0$, and deep layers are differences of nearly equal numbers.


# %%
def routes(alpha, gray, background, dtype):
    """d C / d alpha of one pixel: by the sweep, and by S and a division."""
    alpha, gray, one = alpha.astype(dtype), gray.astype(dtype), dtype(1)
    T = np.cumprod(np.array([one, *(one - alpha)]))
    seen = np.cumsum(alpha * T[:-1] * gray)
    B, behind = np.empty_like(gray), dtype(background)
    for i in reversed(range(len(alpha))):
        B[i], behind = behind, behind + alpha[i] * (gray[i] - behind)
    with np.errstate(invalid="ignore"):
        return T[:-1] * (gray - B), T[:-1] * gray - (
            seen[-1] + T[-1] * dtype(background) - seen
        ) / (one - alpha)


alphas, grays = rng.uniform(0.05, 0.6, 40), rng.uniform(size=40)
alphas[[10, 25]] = 0.99
exact = routes(alphas, grays, 0.5, np.float64)[0]
errors = [np.abs(route - exact) / np.abs(exact) for route in routes(alphas, grays, 0.5, np.float32)]
sweep, division = routes(np.array([0.5, 1.0]), np.array([0.3, 0.6]), 0.5, np.float64)
assert np.isfinite(sweep).all() and np.isnan(division[1])  # an opaque layer
assert errors[0].max() < 1e-4 and errors[1].max() > 0.1
figure, ax = plt.subplots(figsize=(9, 4.8))
ax.semilogy(errors[0], "o-", ms=4, label="sweep from the back")
ax.semilogy(errors[1], "s--", ms=4, label=r"division by $1-\alpha_i$")
ax.set(
    xlabel="layer, front to back",
    ylabel=r"relative error of $\bar\alpha_i$ in float32",
    title="Behind nearly opaque layers the division has no digits left",
)
(
    ax.axvline(10, color="0.6", lw=1, label="opacity 0.99"),
    ax.axvline(25, color="0.6", lw=1),
    ax.legend(loc="right"),
)
lessons.show(figure, "15_compositing_division")

# %% [markdown]
# The other mistake is to forget that an opacity also *hides*: $\bar\alpha_i = T_i\,c_i\cdot g$. The image is right, and so are
# the gradients of the colours. The adjoint identity sees it.

# %%
wrong = np.zeros(6)
wrong[order] = (np.where(clamped, 0, before[:-1] * (color @ G.T)) * falloff).sum(axis=1)
up, down = (
    compositing.forward(**{**inputs, "alpha": inputs["alpha"] + s * h * d["alpha"]})[0].image
    for s in (1, -1)
)
truth = inner(image_bar, up - down) / (2 * h)
right = compositing.backward(res, image_bar)["alpha"]
assert abs(inner(right, d["alpha"]) - truth) < 1e-7 * abs(truth) and abs(
    inner(wrong, d["alpha"]) - truth
) > 0.1 * abs(truth)
print(
    f"by differences {truth:.4f}, by gradient {inner(right, d['alpha']):.4f}, without hiding {inner(wrong, d['alpha']):.4f}"
)

# %% [markdown]
# ## What a codec does with it
# A splat that nobody sees costs bits like any other. Its light, $\sum_p \alpha_i(p)\,T_i(p)$, is what $\bar c_i$ sums for
# a cotangent of one: a backward tells it. Of 400 splats the half with the most light alone gives the image to 30 decibels.
# So children whose opacity stays small are masked for good (choice Q15), and their offsets cost no bits in the file.

# %%
many = dict(
    **compositing.random_splats(rng, 400, 48, 64, (1.5, 5), (0.1, 0.95)),
    background=np.ones(3),
    height=48,
    width=64,
)
whole, residual = compositing.forward(**many)
share = compositing.backward(residual, np.ones((48, 64, 3)))["color"][:, 0]
psnr = {}
for name, kept in (("most", share > np.median(share)), ("least", share < np.median(share))):
    part = compositing.forward(**{**many, "visible": kept})[0].image
    psnr[name] = -10 * np.log10(((part - whole.image) ** 2).mean())
print(
    f"the better half holds {100 * share[share > np.median(share)].sum() / share.sum():.0f} % of the light;",
    f"alone it gives {psnr['most']:.1f} dB, the other half alone {psnr['least']:.1f} dB",
)
assert len(share) == 400 and round(psnr["most"]) == 30 and psnr["least"] < 15

# %% [markdown]
# ## Exercises
# **15.1** In the pixel of "By hand", layer $1$ turns white. Four numbers: the pixel and, for $g = 1$, the three $\bar\alpha_i$.
# **15.2** Write the forward; `alpha_max` stands for $0.99$. **15.3** Write its backward; rows that are not visible get zeros.

# %%
answer_1 = ...


def my_forward(
    mean2d,
    conic,
    alpha,
    color,
    depth,
    visible,
    background,
    height,
    width,
    occlusion=True,
    alpha_max=0.99,
):
    """-> image (height, width, 3), transmittance (height, width); without occlusion every T is one, the last too."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"mean2d", "conic", "alpha", "color", "background"}, from cotangents["image_bar"] and ["transmittance_bar"]; `inputs`
    may lack "occlusion" and "alpha_max". Without occlusion nothing is behind anything: alpha_i_bar = c_i . g."""
    raise NotImplementedError


layers = dict(
    mean2d=np.zeros((3, 2)),
    conic=np.zeros((3, 3)),
    alpha=alpha,
    color=np.outer([1, 1, 0.5], np.ones(3)),
    depth=np.arange(3.0),
    visible=np.ones(3, bool),
    background=np.ones(3),
    height=1,
    width=1,
)
white, residual = compositing.forward(**layers)
opacities_bar = compositing.backward(residual, np.array([[[1.0, 0, 0]]]))["alpha"]
lessons.number("15.1", answer_1, [white.image[0, 0, 0], *opacities_bar])
lessons.forward("15.2", my_forward, "compositing")
lessons.backward("15.3", my_backward, "compositing")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only compositing` reads what a port wrote. Ports go wrong at equal depths, where the order must
# be that of the index, and at the clamp: here its gradient is zero, while the published kernel lets it pass.

# %%
full = lambda inputs, cotangents: compositing.backward(
    compositing.forward(**inputs)[1], **cotangents
)
verdict = oracle.check(lambda **inputs: compositing.forward(**inputs)[0], "compositing", full)
print(verdict)
assert verdict.ok and EQUATIONS["compositing"].shapes["conic"] == "N 3"
