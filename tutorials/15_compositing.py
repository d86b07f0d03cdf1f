# %% [markdown]
# # Support: from splats to a pixel's colour, and back in one sweep
#
# **Promise.** After this tutorial you can composite splats by hand, and derive the gradient of
# every opacity in one sweep from back to front. **Before it:** `14_projection`. **Takes** three
# seconds of machine time on two cores, 40 minutes of reading and 50 of exercises.
#
# **Files:** [compositing.py](../p4dgs_ref/splatting/compositing.py),
# [loop.py](../p4dgs_ref/splatting/loop.py), [fast.py](../p4dgs_ref/splatting/fast.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures

plt = figures.pyplot()
architecture.show("15_compositing")
rng = np.random.default_rng(15)
h = 1e-6  # step of finite differences


def inner(a, b):
    return (a * b).sum()


# %% [markdown]
# ## Claim
# A pixel $p$ sees all splats, the nearest one first. Each splat contributes its colour, dimmed by
# the splats in front of it:
# $$C(p) = \sum_i c_i\,\alpha_i(p)\,T_i(p) + T_N(p)\,c_{bg},\qquad T_i = \prod_{j<i}(1-\alpha_j),$$
# $$\alpha_i(p) = \min\bigl(0.99,\ \alpha_i\,e^{-\frac12 (p-\mu_i)^T K_i (p-\mu_i)}\bigr).$$
# $T_i$ is the *transmittance* in front of splat $i$, the share of light that the splats in front of
# it let through. The product $\alpha_i T_i$ is the splat's *weight*. $K_i$ is the conic of
# `14_projection`, $\alpha_i$ the opacity of Eq. (3), and $N$ the number of splats; $T_N$ is the
# light that is left for the background. The limit of $0.99$ guarantees that every splat lets some
# light through. The paper does not print this sum, because the sum comes unchanged from 3D Gaussian
# splatting.

# %% [markdown]
# ## By hand
# Take one pixel and three layers with opacities 0.5, 0.5 and 0.8 and gray values 1, 0 and 0.5, in
# front of a white background. The transmittances are 1, 0.5 and 0.25, and 0.05 remains behind the
# last layer. The weights are therefore 0.5, 0.25 and 0.2, and the pixel is 0.5 + 0 + 0.1 + 0.05 =
# 0.65.

# %%
alpha = np.array([0.5, 0.5, 0.8])
gray = np.array([1, 0, 0.5])
background = 1
T = np.cumprod([1, *(1 - alpha)])
weight = alpha * T[:3]
pixel = weight @ gray + T[3] * background
assert np.allclose(T, [1, 0.5, 0.25, 0.05])
assert np.allclose(weight, [0.5, 0.25, 0.2])
assert np.isclose(pixel, 0.65)
assert np.isclose(weight.sum() + T[3], 1)

# %% [markdown]
# The weights and the share that is left for the background add up to one, so no light is lost. The
# same value can be computed from the *back*, by adding one layer after another in front of the
# result so far. Let $B_i$ be the colour that is seen behind layer $i$:
# $$B_{N-1} = c_{bg},\qquad B_{i-1} = \alpha_i c_i + (1-\alpha_i)\,B_i,\qquad C = B_{-1}.$$
# We introduce this second way because the whole backward pass is built on it.

# %%
behind = [background]  # B_2, B_1, B_0, B_-1
for a, c in zip(alpha[::-1], gray[::-1]):
    behind.append(a * c + (1 - a) * behind[-1])
assert np.isclose(behind[-1], pixel)

# %%
figure, (light, over) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
light.bar(range(4), T, color="0.85")
light.bar(
    range(4),
    [*weight, T[3]],
    color=figures.COLORS[0],
    width=0.6,
)
light.text(0.5, 0.8, "light that arrives, $T_i$", color="0.4")
light.text(0.5, 0.7, r"light that is used, $\alpha_i T_i$", color=figures.COLORS[0])
figures.finish(
    light,
    xticks=range(4),
    xticklabels=["layer 0", "layer 1", "layer 2", "background"],
    ylabel="share of light",
    title="From the front: how much is seen",
)
over.plot(
    range(-1, 3),
    behind[::-1],
    "o-",
    ms=11,
    color=figures.COLORS[1],
    label="$B_i$, the colour behind layer i",
)
over.plot(
    range(3),
    gray,
    "s",
    ms=11,
    color=figures.COLORS[2],
    label="$c_i$, the layer's own gray",
)
over.annotate(
    "the pixel",
    (-1, behind[-1]),
    (-0.95, 0.3),
    arrowprops=dict(arrowstyle="->"),
)
figures.finish(
    over,
    xticks=range(-1, 3),
    xlabel="layer",
    ylabel="gray value",
    title="From the back: what is seen",
    ylim=(-0.1, 1.15),
)
figures.label(over, (0.05, 0.85), (0.1, 0.06))
figures.show(
    figure, "15_compositing_pixel", title="One pixel, three layers: two ways to the same value"
)

# %% [markdown]
# ## In code
# The next cell does the same for all splats at all pixels. `A (M, P)` holds the opacity of each
# visible splat at each pixel, sorted front to back, and `before (M, P)` holds the transmittance
# in front of it. Splats are sorted by depth; splats of equal depth keep the order of their index.

# %%
from p4dgs_ref.lab.random_inputs import random_splats
from p4dgs_ref.splatting import compositing, loop

height, width = 24, 32
splats = random_splats(rng, 6, height, width, sigma=(2.5, 6.0))
inputs = dict(
    **splats,
    background=np.array([0.9, 0.5, 0.2]),
    height=height,
    width=width,
)
order = np.argsort(splats["depth"], kind="stable")
y, x = np.indices((height, width)).reshape(2, 1, -1)
mean_x, mean_y = splats["mean2d"][order].T[:, :, None]
e_x = x - mean_x  # from the mean to the pixel
e_y = y - mean_y
a, b, c = splats["conic"][order].T[:, :, None]
form = a * e_x**2 + 2 * b * e_x * e_y + c * e_y**2
falloff = np.exp(-0.5 * form)
raw = splats["alpha"][order, None] * falloff
A = np.minimum(raw, 0.99)
full_light = np.ones((1, A.shape[1]))
all_T = np.cumprod(np.vstack([full_light, 1 - A]), axis=0)
before = all_T[:-1]
T_N = all_T[-1]
color = splats["color"][order]
by_hand = (A * before).T @ color + T_N[:, None] * inputs["background"]

(image, transmittance), saved = compositing.forward(**inputs)
assert np.allclose(image, by_hand.reshape(height, width, 3), rtol=1e-12)
assert np.allclose(transmittance.ravel(), T_N, rtol=1e-12)

# %% [markdown]
# The package contains this computation three times. Read `splatting/loop.py` first: it draws one
# Gaussian after another, front to back, each on its own rectangle of pixels, and keeps one
# transmittance per pixel. `splatting/compositing.py` is the exact version that evaluates every
# Gaussian at every pixel, as we just did. `splatting/fast.py` is the version that training uses; it
# sorts Gaussians into tiles. A test compares the three, and here the loop agrees with our array
# code.

# %%
from p4dgs_ref import SETTINGS

a_all, b_all, c_all = splats["conic"].T
det = a_all * c_all - b_all**2
cov2d = np.stack([c_all, -b_all, a_all], axis=1) / det[:, None]
(looped, _), _ = loop.forward(
    **inputs,
    cov2d=cov2d,
    settings=SETTINGS["exact"],
)
assert np.allclose(looped, image, rtol=1e-12)

# %% [markdown]
# ## Backward by hand
# **One layer**, with a gray value: $C = \alpha c + (1-\alpha)B$. Let $g = \bar C$ be the
# cotangent of the pixel. Then $\bar c = \alpha g$, $\bar B = (1-\alpha)g$, and
# $$\bar\alpha = (c - B)\,g.$$
# In words, a higher opacity helps only if the layer's colour is better than the colour that it
# hides. With $c = 0.5$, $B = 1$ and $g = 2$ the gradient is -1.

# %%
value, hidden, g = 0.5, 1, 2


def one_layer(opacity):
    return opacity * value + (1 - opacity) * hidden


by_difference = g * (one_layer(0.8 + h) - one_layer(0.8 - h)) / (2 * h)
assert np.isclose(by_difference, (value - hidden) * g)

# %% [markdown]
# **Many layers.** Layer $i$ and everything behind it are seen through the transmittance $T_i$,
# which does not depend on $\alpha_i$. The colour of the pixel can therefore be split at layer $i$:
# $$C = \sum_{j<i} c_j\alpha_jT_j \;+\; T_i\,\bigl(\alpha_i c_i + (1-\alpha_i)\,B_i\bigr)
#   \;\Longrightarrow\; \bar\alpha_i = T_i\,(c_i - B_i)\,g.$$


# %%
def composite(opacities):
    light = np.cumprod([1, *(1 - opacities)])
    return (opacities * light[:3]) @ gray + light[3] * background


alpha_bar = T[:3] * (gray - np.array(behind[2::-1]))  # B_0, B_1, B_2, and g = 1
for i in range(3):
    step = h * np.eye(3)[i]
    by_difference = (composite(alpha + step) - composite(alpha - step)) / (2 * h)
    assert np.isclose(by_difference, alpha_bar[i], rtol=1e-8)
print("gradient of the three opacities:", alpha_bar.round(4))

# %% [markdown]
# This formula needs no division and only one sweep from the back, in which `behind` is updated by
# $B_{i-1} = B_i + \alpha_i(c_i - B_i)$. With colours, $g$ has three entries. Everything is linear
# in the colours, so the sweep can use the numbers $v_i = c_i\cdot g$ instead of colours. If the
# transmittance is also an output, its cotangent $\bar T_N$ is added to the value of the background:
# the sweep then starts with `background @ g + T_bar`.

# %%
image_bar = rng.normal(size=(height, width, 3))
T_bar = rng.normal(size=(height, width))
G = image_bar.reshape(-1, 3)
v = color @ G.T
value_behind = G @ inputs["background"] + T_bar.ravel()
A_bar = np.empty_like(A)
for i in reversed(range(len(A))):
    gain = v[i] - value_behind  # v_i - B_i
    A_bar[i] = before[i] * gain  # T_i (v_i - B_i)
    value_behind = value_behind + A[i] * gain  # B_(i-1)
ours = compositing.backward(saved, image_bar, T_bar)
assert np.allclose(ours["color"][order], (A * before) @ G, rtol=1e-10)  # weights times g
assert np.allclose(ours["background"], T_N @ G, rtol=1e-10)

# %% [markdown]
# **From $\alpha_i(p)$ to the parameters of the splat.** Consider the one-dimensional case first:
# $\alpha(p) = \alpha\,e^{-\frac12 k e^2}$ with $e = p - \mu$. The differential of its logarithm
# is
# $$d\log\alpha(p) = \frac{d\alpha}{\alpha} - \tfrac12 e^2\,dk + k\,e\,d\mu.$$
# The last sign is positive because $e$ decreases when $\mu$ increases. Where the limit of $0.99$ is
# active, the gradient is zero.

# %%
at, k, top, p = 1.2, 0.4, 0.7, 3


def log_alpha(parameters):
    center, sharpness, opacity = parameters
    return np.log(opacity * np.exp(-0.5 * sharpness * (p - center) ** 2))


slopes = [k * (p - at), -0.5 * (p - at) ** 2, 1 / top]
for i in range(3):
    step = h * np.eye(3)[i]
    up = log_alpha([at, k, top] + step)
    down = log_alpha([at, k, top] - step)
    assert np.isclose((up - down) / (2 * h), slopes[i], rtol=1e-8)

# %% [markdown]
# In two dimensions the exponent is $-\frac12(a e_x^2 + 2b\,e_x e_y + c\,e_y^2)$. Write
# $V = \bar\alpha(p)\,\alpha(p)$. A splat covers many pixels, so each of its gradients is a sum
# over $p$. The factor $\frac12$ is missing in $\bar b$ because $b$ occurs twice in the exponent:
# $$\bar\mu = \sum_p V\begin{pmatrix} a e_x + b e_y \\ b e_x + c e_y\end{pmatrix},\quad
#   \bar\alpha = \sum_p \bar\alpha(p)\,e^{\dots},$$
# $$\bar a = -\tfrac12\sum_p V e_x^2,\quad \bar b = -\sum_p V e_x e_y,\quad
#   \bar c = -\tfrac12\sum_p V e_y^2.$$

# %%
A_bar = np.where(raw > 0.99, 0, A_bar)
V = A_bar * raw
terms = {
    "alpha": [A_bar * falloff],
    "mean2d": [
        V * (a * e_x + b * e_y),
        V * (b * e_x + c * e_y),
    ],
    "conic": [
        -0.5 * V * e_x**2,
        -V * e_x * e_y,
        -0.5 * V * e_y**2,
    ],
}
for name, term in terms.items():
    sums = np.sum(term, axis=2)  # over the pixels
    theirs = ours[name][order].T
    assert np.allclose(theirs, sums, rtol=1e-9, atol=1e-12)

# %% [markdown]
# Finally the adjoint identity checks all five gradients at once: the change of the outputs along
# a random direction, weighted with the cotangents, must equal the gradients times that direction.

# %%
moved = ("mean2d", "conic", "alpha", "color", "background")
sizes = dict.fromkeys(moved, 1) | {"conic": 0.01}
d = {name: sizes[name] * rng.normal(size=inputs[name].shape) for name in moved}


def loss_at(step):
    shifted = {name: inputs[name] + step * d[name] for name in moved}
    seen, light = compositing.forward(**{**inputs, **shifted})[0]
    return inner(image_bar, seen) + inner(T_bar, light)


by_difference = (loss_at(h) - loss_at(-h)) / (2 * h)
by_gradient = sum(inner(ours[name], d[name]) for name in moved)
assert abs(by_difference - by_gradient) < 1e-6 * abs(by_difference)

# %% [markdown]
# How does each pixel pull on a splat? The next picture shows two round splats. The front one is in
# the wrong place, and the loss $\frac12\|C - C^*\|^2$ compares the result with the correct picture
# $C^*$. A pixel pulls an opacity up where the pixel needs more of the splat, and down where the
# splat hides something that should be visible. The strength of this pull is
# $-T_i\,(c_i - B_i)\cdot g$. If each pull is multiplied by $\alpha_i(p)\,K_i(p - \mu_i)$, as
# derived above, the sum over all pixels is the arrow that moves the splat.

# %%
front = np.array([0.9, 0.6, 0])
back = np.array([0, 0.45, 0.7])
sharpness = np.array([0.06, 0.02])
pair = dict(
    mean2d=np.array([[12.0, 14], [20, 11]]),
    conic=np.outer(sharpness, [1, 0, 1]),
    alpha=np.array([0.8, 0.9]),
    color=np.stack([front, back]),
    depth=np.array([1.0, 2]),
    visible=np.ones(2, bool),
    background=np.ones(3),
    height=height,
    width=width,
)
right_place = {**pair, "mean2d": np.array([[15.0, 10], [20, 11]])}
target = compositing.forward(**right_place)[0][0]
(seen, _), saved_pair = compositing.forward(**pair)
error = seen - target
bars = compositing.backward(saved_pair, error)

# %%
rows, columns = np.indices((height, width))
falls = []
for (m_x, m_y), k in zip(pair["mean2d"], sharpness):
    squared = (columns - m_x) ** 2 + (rows - m_y) ** 2
    falls.append(np.exp(-0.5 * k * squared))
A_0 = 0.8 * falls[0][..., None]
A_1 = 0.9 * falls[1][..., None]
behind_front = A_1 * back + (1 - A_1)  # B_0 over white
pulls = [
    -((front - behind_front) * error).sum(axis=2),
    -((1 - A_0) * (back - 1) * error).sum(axis=2),
]
for pull, fall, gradient in zip(pulls, falls, bars["alpha"]):
    assert np.isclose(-inner(pull, fall), gradient, rtol=1e-10)

# %%
figure, panels = plt.subplots(
    2,
    2,
    figsize=(9, 7),
    layout="constrained",
    sharex=True,
    sharey=True,
)
names = ("as it is", "as it should be", "pull at the front splat", "pull at the back splat")
for ax, picture, name in zip(panels.flat, (seen, target, *pulls), names):
    shown = ax.imshow(picture, cmap="PuOr", vmin=-0.6, vmax=0.6)
    figures.finish(ax, title=name, grid=False)
for ax, mean, mean_bar, k in zip(panels[1], pair["mean2d"], bars["mean2d"], sharpness):
    ax.add_patch(
        plt.Circle(
            mean,
            k**-0.5,
            fill=False,
            ls="--",
            lw=2,
        )
    )
    ax.quiver(
        *mean,
        *(-5 * mean_bar),
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.02,
    )
figure.supxlabel("u (pixels)")
figure.supylabel("v (pixels)")
figure.colorbar(
    shown, ax=panels[1], label=r"$-\bar\alpha_i(p)$: more (+) or less", location="right"
)
figures.show(
    figure,
    "15_compositing",
    title="Every pixel pulls on every splat that covers it\n"
    r"(dashed: one sigma of the splat; arrows: $-5\,\bar\mu$)",
)

# %% [markdown]
# ## Break it
# There is another correct formula for the gradient. Let $S_i$ be the contribution of everything
# behind layer $i$ to the pixel:
# $$S_i = T_i\,(1-\alpha_i)\,B_i = \sum_{j>i} c_j\alpha_jT_j + T_N c_{bg} \quad\Longrightarrow\quad
#   \bar\alpha_i = T_ic_i - \frac{S_i}{1-\alpha_i}.$$
# gsplat 1.5.3 and `00_whole_paper` use this formula. Because of its division, an opaque layer would
# give $0/0$, but below the limit of $0.99$ the formula is as good as the sweep, *if $S_i$ is a sum
# from the back*. The kernel of 3DGS sweeps from back to front as we do, but without the background,
# whose share of the gradient is $-T_N c_{bg}/(1-\alpha_i)$. The kernels of gsplat and 3DGS keep
# only the last transmittance of the forward pass and recover the others,
# $T_i = T_{i+1}/(1-\alpha_i)$. In the pixel below, these divisions add a smaller error than the
# rounding of the forward pass. They fail behind so many opaque layers that $T_N$ is 0
# (`24_hard_cases`); published kernels stop before that.
#
# It is tempting to avoid the sum from the back: a kernel that keeps the pixel $C$ of the forward
# pass can go from front to back and subtract the contributions that it has passed,
# $S_i = C - \sum_{j\le i} c_j\alpha_jT_j$. Shapes and signs are right, and on ordinary pixels the
# result is right too. But behind opaque layers $S_i$ is much smaller than $C$, and a small
# difference between two large numbers has no correct digits.


# %%
def by_sweep(alpha, gray, T, background):
    """d C / d alpha of one pixel, from back to front."""
    slopes = np.empty_like(gray)
    behind = background
    for i in reversed(range(len(alpha))):
        gain = gray[i] - behind
        slopes[i] = T[i] * gain
        behind = behind + alpha[i] * gain
    return slopes


def by_division(alpha, gray, T, background):
    """d C / d alpha of one pixel, from S summed from the back, and a division."""
    parts = np.append(alpha * T[:-1] * gray, T[-1] * background)
    S = np.cumsum(parts[::-1])[-2::-1]
    with np.errstate(invalid="ignore"):
        return T[:-1] * gray - S / (1 - alpha)


def recovered(alpha, T_N):
    """All transmittances, from the last one and divisions."""
    T = np.full(len(alpha) + 1, T_N)
    for i in reversed(range(len(alpha))):
        T[i] = T[i + 1] / (1 - alpha[i])
    return T


def by_kernel_of_3dgs(alpha, gray, T, background):
    """The sweep without the background, and T_i and the background's share by division."""
    T_N = T[-1]
    slopes = by_sweep(alpha, gray, recovered(alpha, T_N), 0 * background)
    return slopes - T_N * background / (1 - alpha)


def by_subtraction(alpha, gray, T, background):
    """The same with S as the pixel minus everything up to layer i."""
    passed = np.cumsum(alpha * T[:-1] * gray)
    C = passed[-1] + T[-1] * background
    return T[:-1] * gray - (C - passed) / (1 - alpha)


def slopes_of(formula, alpha, gray, dtype):
    alpha, gray = alpha.astype(dtype), gray.astype(dtype)
    through = np.append(dtype(1), 1 - alpha)
    T = np.cumprod(through)
    return formula(alpha, gray, T, dtype(0.5))


alphas = rng.uniform(0.05, 0.6, 40)
grays = rng.uniform(size=40)
alphas[[10, 25]] = 0.99
exact = slopes_of(by_sweep, alphas, grays, np.float64)
errors = {}
for formula in (by_sweep, by_division, by_kernel_of_3dgs, by_subtraction):
    single = slopes_of(formula, alphas, grays, np.float32)
    errors[formula.__name__] = np.abs(single - exact) / np.abs(exact)
for name in ("by_sweep", "by_division", "by_kernel_of_3dgs"):
    print(f"{name}: at most {errors[name].max():.1e} of the gradient")
    assert errors[name].max() < 1e-4
assert errors["by_subtraction"].max() > 0.1
exact_T = np.cumprod([1, *(1 - alphas)])
single_T = np.cumprod(np.append(np.float32(1), 1 - alphas.astype(np.float32)))
by_product = np.abs(single_T / exact_T - 1).max()
divided_T = recovered(alphas.astype(np.float32), single_T[-1])
by_division_of_T = np.abs(divided_T / single_T - 1).max()
print(f"T_i in float32: off by {by_product:.1e}; division adds {by_division_of_T:.1e}")
assert by_division_of_T < by_product < 1e-5
opaque = np.array([0.5, 1.0]), np.array([0.3, 0.6])
assert np.isfinite(slopes_of(by_sweep, *opaque, np.float64)).all()
assert np.isnan(slopes_of(by_division, *opaque, np.float64)[1])

# %%
figure, ax = plt.subplots(figsize=(9, 4.8))
ax.semilogy(errors["by_sweep"], "o-", ms=4, label="sweep from the back")
ax.semilogy(errors["by_division"], "D:", ms=4, label="division, $S_i$ summed from the back")
ax.semilogy(errors["by_kernel_of_3dgs"], "x", ms=7, label="sweep and $T_i$ by division, as 3DGS")
ax.semilogy(errors["by_subtraction"], "s--", ms=4, label=r"division, $S_i = C - \dots$")
ax.axvline(10, color="0.6", lw=1, label="opacity 0.99")
ax.axvline(25, color="0.6", lw=1)
figures.finish(
    ax,
    xlabel="layer, front to back",
    ylabel=r"relative error of $\bar\alpha_i$ in float32",
    title="Behind nearly opaque layers the subtraction leaves no correct digit",
    legend={"loc": "right", "fontsize": 10},
)
figures.show(figure, "15_compositing_division")

# %% [markdown]
# A second mistake is to forget that an opacity also *hides* what is behind it, and to write
# $\bar\alpha_i = T_i\,c_i\cdot g$. The image is right, and so are the gradients of the colours.
# Only the adjoint identity reveals the mistake.

# %%
without_hiding = np.where(raw > 0.99, 0, before * v) * falloff
wrong = np.zeros(6)
wrong[order] = without_hiding.sum(axis=1)
right = compositing.backward(saved, image_bar)["alpha"]


def image_loss_at(step):
    shifted = {**inputs, "alpha": inputs["alpha"] + step * d["alpha"]}
    return inner(image_bar, compositing.forward(**shifted)[0][0])


truth = (image_loss_at(h) - image_loss_at(-h)) / (2 * h)
assert abs(inner(right, d["alpha"]) - truth) < 1e-7 * abs(truth)
assert abs(inner(wrong, d["alpha"]) - truth) > 0.1 * abs(truth)
print(f"by differences {truth:.4f}, by gradient {inner(right, d['alpha']):.4f},")
print(f"without hiding {inner(wrong, d['alpha']):.4f}")

# %% [markdown]
# ## What a codec does with it
# A splat that contributes nothing to any picture costs as many bits as any other. The contribution
# of a splat, $\sum_p \alpha_i(p)\,T_i(p)$, is the value that the backward pass returns as
# $\bar c_i$ for a cotangent of one. Of 400 random splats, the half that contributes most reproduces
# the image at about 30 dB on its own. For this reason training permanently masks children whose
# opacity stays small (choice Q15; `reference.md` lists all choices), and their offsets cost no bits
# in the file.

# %%
many = dict(
    **random_splats(rng, 400, 48, 64, (1.5, 5), (0.1, 0.95)),
    background=np.ones(3),
    height=48,
    width=64,
)
(whole, _), saved_many = compositing.forward(**many)
bars = compositing.backward(saved_many, np.ones_like(whole))
share = bars["color"][:, 0]
most = share > np.median(share)


def psnr_of(kept):
    part = compositing.forward(**{**many, "visible": kept})[0][0]
    return -10 * np.log10(((part - whole) ** 2).mean())


print(f"the better half contributes {share[most].sum() / share.sum():.0%} of the light")
print(f"PSNR: {psnr_of(most):.1f} dB from it alone, {psnr_of(~most):.1f} dB from the other half")
assert 29 < psnr_of(most) < 31
assert psnr_of(~most) < 15

# %% [markdown]
# ## Exercises
# **15.1** ●● In the pixel of "By hand", layer $1$ turns white, and as in `NeRF` every layer stores
# a thickness $\tau_i$, with $\alpha_i = 1 - e^{-\tau_i}$. What changes in the gradient? Give four
# numbers: the pixel and, for $g = 1$, the three gradients $\bar\tau_i$.
#
# **15.2** ●● Write the forward pass. The argument `alpha_max` is the limit of $0.99$. An exponent
# that rounding makes positive, far along a needle, counts as $0$.
#
# **15.3** ●●● Write its backward pass. Rows that are not visible get the gradient zero.
#
# **Predict, then run.** A port computes transmittances as products in float16, through layers of
# opacity $0.9$. After how many layers is the transmittance exactly zero? Is the error visible in
# the picture?

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
    """Return image (height, width, 3) and transmittance (height, width).

    Without occlusion every transmittance is one, the last one too.
    """
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return the gradients {"mean2d", "conic", "alpha", "color", "background"}.

    The cotangents are cotangents["image_bar"] and cotangents["transmittance_bar"]. `inputs` may
    lack "occlusion" and "alpha_max". Without occlusion no splat hides another, and
    alpha_i_bar = c_i . g.
    """
    raise NotImplementedError


lessons.check_number("15.1", answer_1)
lessons.check_forward("15.2", my_forward, "compositing")
lessons.check_backward("15.3", my_backward, "compositing")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only compositing` reads the arrays that a port wrote and compares
# them with the golden vectors. Ports go wrong at equal depths, where the index decides the order,
# and at the limit of $0.99$: above it, this project's gradient is zero, whereas the published
# kernel lets the gradient pass.

# %%
lessons.passes("compositing")
