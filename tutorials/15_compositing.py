# %% [markdown]
# # Support: from splats to a pixel's colour, and back in one sweep
#
# **Promise.** After this tutorial you can composite splats by hand, and derive the gradient of
# every opacity in one sweep from back to front. **Before it:** `14_projection`. **Takes** six
# seconds of machine time on two cores, 40 minutes of reading and 50 of exercises.
#
# **Files:** [compositing.py](../p4dgs_ref/splatting/compositing.py),
# [loop.py](../p4dgs_ref/splatting/loop.py), [fast.py](../p4dgs_ref/splatting/fast.py).

# %%
from functools import partial

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour, without

plt = figures.pyplot()
architecture.show("15_compositing")
rng = np.random.default_rng(15)
thread = figures.THREAD
h = 1e-6  # step of finite differences

# %% [markdown]
# ## What fails without it
# Some twenty splats lie over a pixel of the red ball: those of the side that we see, those of its
# far side, and those of what is behind. The pixel has to show the front ones, let some of what is
# behind shine through where they are thin, and hide the rest.
#
# On the left the splats are painted from front to back, in the middle in the order in which the
# file happens to hold them, and on the right with the farthest one in front, so that we see the
# slab from below and the far sides of the balls. Splats that only add up, like lamps, give no
# picture at all: the white background alone fills every pixel, and all of it is white (10.9 dB).


# %%
def in_file_order(x):
    """Numbers to sort by, from places x [N, 3] as the camera sees them; x[:, 2] is the depth."""
    return np.arange(len(x))


def far_ones_first(x):
    return -x[:, 2]


NOTHING, FILE_ORDER, REVERSED = {}, {"depth": in_file_order}, {"depth": far_ones_first}

# %%
without.show_changes(
    "15_compositing_fails",
    {"front to back": NOTHING, "order of the file": FILE_ORDER, "back to front": REVERSED},
    view=tour.VIEW,
)

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
from p4dgs_ref.lessons import close

alpha = np.array([0.5, 0.5, 0.8])
gray = np.array([1, 0, 0.5])
background = 1
T = np.cumprod([1, *(1 - alpha)])
weight = alpha * T[:3]
pixel = weight @ gray + T[3] * background
assert close(T, [1, 0.5, 0.25, 0.05])
assert close(weight, [0.5, 0.25, 0.2])
assert close(pixel, 0.65)
assert close(weight.sum() + T[3], 1)

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
assert close(behind[-1], pixel)

# %% [markdown]
# The same happens in every pixel of the trained scene. The figure shows the one in the middle of
# the disc of anchor 29, which `13_covariance` turned and `14_projection` projected. The disc is
# nearly opaque, $\alpha = 0.96$, and still it gives only 4.5 % of the pixel, because the splats in
# front of it leave only 5 % of the light. The purple bars are those of anchor 29: the disc is the
# last one, and another of its Gaussians lies in front of it. Behind them, next to nothing is left
# for the far side of the ball. The figure shows only the six splats that give more than 1 % of the
# pixel; all others together give 3 %. [See it move](viewer/demo.html#step=splatting): the viewer
# paints the splats one after another, and shows the weights in any pixel.

# %%
gaussians, camera = without.GAUSSIANS, without.CAMERA
disc = np.flatnonzero(without.OWN)[-1]
mean2d, cov2d, conic, depth, visible = show.splats(gaussians, camera)
middle = np.round(mean2d[disc])
in_front, shares, _ = show.front_to_back(gaussians, camera, middle)
place = np.argmax(in_front == disc)
assert 0.04 < shares[place] < 0.05
print(f"light in front of the disc {1 - shares[:place].sum():.3f}, its weight {shares[place]:.3f}")

# %%
figure = plt.figure(figsize=(12, 4.8), layout="constrained")
show.pixel(figure, tour.MODEL, camera, without.T, middle)
show.ellipses(figure.axes[0], mean2d[[disc]], cov2d[[disc]], fc="none", ec=thread.color, lw=3)
for bar, i in zip(figure.axes[1].patches, in_front[shares > show.MIN_SHARE]):
    if without.OWN[i]:
        bar.set(edgecolor=thread.color, lw=3)
figures.show(figure, "15_compositing_pixel")

# %% [markdown]
# ## In code
# The next cell composites a window of 32 by 24 pixels of the trained scene, with anchor 29 in its
# middle. `A (M, P)` holds the opacity of each visible splat at each pixel, sorted front to back,
# and `before (M, P)` holds the transmittance in front of it. Splats are sorted by depth; splats of
# equal depth keep the order of their index.

# %%
from p4dgs_ref.splatting import compositing, loop
from p4dgs_ref.splatting.settings import EXACT

height, width = 24, 32
inputs = dict(
    mean2d=mean2d - middle + (width / 2, height / 2),  # the window's corner is its pixel (0, 0)
    conic=conic,
    alpha=gaussians.alpha.astype(float),
    color=gaussians.color.astype(float),
    background=tour.MODEL.background.astype(float),
)
constant = dict(depth=depth, visible=visible, height=height, width=width)
order = np.argsort(depth, kind="stable")
y, x = np.indices((height, width)).reshape(2, 1, -1)


def layers(mean2d, conic, alpha, **others):
    """Return e_x, e_y, falloff and raw opacity (M, P), then A, before and T_N."""
    mean_x, mean_y = mean2d[order].T[:, :, None]
    e_x = x - mean_x  # from the mean to the pixel
    e_y = y - mean_y
    a, b, c = conic[order].T[:, :, None]
    falloff = np.exp(-0.5 * (a * e_x**2 + 2 * b * e_x * e_y + c * e_y**2))
    raw = alpha[order, None] * falloff
    A = np.minimum(raw, 0.99)
    T = np.cumprod(np.vstack([np.ones_like(A[:1]), 1 - A]), axis=0)
    return e_x, e_y, falloff, raw, A, T[:-1], T[-1]


e_x, e_y, falloff, raw, A, before, T_N = layers(**inputs)
color = inputs["color"][order]
by_hand = (A * before).T @ color + T_N[:, None] * inputs["background"]

(image, transmittance), saved = compositing.forward(**inputs, **constant)
assert close(by_hand.reshape(height, width, 3), image)
assert close(T_N, transmittance.ravel())
cover = (A > 0.01).sum(axis=0).reshape(height, width)[height // 2, width // 2]
print(f"{cover} splats cover more than 1 % of the pixel in the middle")

# %% [markdown]
# The package contains this computation three times. Read `splatting/loop.py` first: it draws one
# Gaussian after another, front to back, each on its own rectangle of pixels, and keeps one
# transmittance per pixel. `splatting/compositing.py` is the exact version that evaluates every
# Gaussian at every pixel, as we just did. `splatting/fast.py` is the version that training uses; it
# sorts Gaussians into tiles. A test compares the three, and here the loop agrees with our array
# code.

# %%
(looped, _), _ = loop.forward(**inputs, **constant, cov2d=cov2d, settings=EXACT)
assert close(looped, image)

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
assert close(by_difference, (value - hidden) * g, 1e-8)

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
    assert close(by_difference, alpha_bar[i], 1e-8)
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


def sweep(A, before, v, value_behind):
    """Return A_bar (M, P)."""
    A_bar = np.empty_like(A)
    for i in reversed(range(len(A))):
        gain = v[i] - value_behind  # v_i - B_i
        A_bar[i] = before[i] * gain  # T_i (v_i - B_i)
        value_behind = value_behind + A[i] * gain  # B_(i-1)
    return A_bar


A_bar = sweep(A, before, v, G @ inputs["background"] + T_bar.ravel())
ours = compositing.backward(saved, image_bar, T_bar)
assert close(ours["color"][order], (A * before) @ G, 1e-10)  # weights times g
assert close(ours["background"], T_N @ G, 1e-10)

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
    assert close((up - down) / (2 * h), slopes[i], 1e-8)

# %% [markdown]
# In two dimensions the exponent is $-\frac12(a e_x^2 + 2b\,e_x e_y + c\,e_y^2)$. Write
# $V = \bar\alpha(p)\,\alpha(p)$. A splat covers many pixels, so each of its gradients is a sum
# over $p$. The factor $\frac12$ is missing in $\bar b$ because $b$ occurs twice in the exponent:
# $$\bar\mu = \sum_p V\begin{pmatrix} a e_x + b e_y \\ b e_x + c e_y\end{pmatrix},\quad
#   \bar\alpha = \sum_p \bar\alpha(p)\,e^{\dots},$$
# $$\bar a = -\tfrac12\sum_p V e_x^2,\quad \bar b = -\sum_p V e_x e_y,\quad
#   \bar c = -\tfrac12\sum_p V e_y^2.$$

# %%
a, b, c = conic[order].T[:, :, None]
A_bar = np.where(raw > 0.99, 0, A_bar)
V = A_bar * raw
terms = {
    "alpha": [A_bar * falloff],
    "mean2d": [V * (a * e_x + b * e_y), V * (b * e_x + c * e_y)],
    "conic": [-0.5 * V * e_x**2, -V * e_x * e_y, -0.5 * V * e_y**2],
}
for name, term in terms.items():
    sums = np.sum(term, axis=2)  # over the pixels
    assert close(ours[name][order].T, sums, 1e-9)

# %% [markdown]
# Finally the adjoint identity checks all five gradients at once.

# %%
forward, bars = partial(compositing.forward, **constant), (image_bar, T_bar)
d, difference = lessons.adjoint(rng, forward, inputs, bars, ours, 1e-6)

# %% [markdown]
# How does each pixel pull on a splat? The next picture shows anchor 29 in the wrong place: its
# Gaussians are 3 pixels too far to the right. The loss $\frac12\|C - C^*\|^2$ compares the result
# with the picture $C^*$ from before. A pixel pulls an opacity up where the pixel needs more of the
# splat, and down where the splat hides something that should be visible. The strength of this pull
# is $-T_i\,(c_i - B_i)\cdot g$. If each pull is multiplied by $\alpha_i(p)\,K_i(p - \mu_i)$, as
# derived above, the sum over all pixels is the arrow that moves the splat back. The right side
# shows this for the one of the three Gaussians that feels the strongest pull: at the edge of the
# ball it hides the blue ball, so the pixels there (orange) want less of it, and the splat moves to
# the left, away from them.

# %%
moved = {**inputs, "mean2d": inputs["mean2d"] + 3 * without.OWN[:, None] * [1, 0]}
(seen, _), saved_moved = compositing.forward(**moved, **constant)
error = seen - image
moved_bars = compositing.backward(saved_moved, error)
*_, A_moved, before_moved, _ = layers(**moved)
G = error.reshape(-1, 3)
pulls = -sweep(A_moved, before_moved, color @ G.T, G @ inputs["background"])
strongest = np.flatnonzero(without.OWN)[np.abs(moved_bars["mean2d"][without.OWN]).sum(1).argmax()]
pull = pulls[order == strongest].reshape(height, width)

# %%
figure, panels = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
shown = [panel.imshow(picture) for panel, picture in zip(panels, (seen, image))]
largest = np.abs(pull).max()
shown = panels[2].imshow(pull, cmap="PuOr", vmin=-largest, vmax=largest)
for ax, name in zip(panels, ("as it is", "as it should be", "pull at one splat")):
    ax.set(title=name, **show.BARE, xlim=(8, 31), ylim=(20, 3))
    ax.grid(False)
mean = moved["mean2d"][[strongest]]
show.ellipses(panels[2], mean, cov2d[[strongest]], fc="none", ec=thread.color, lw=3)
slope = moved_bars["mean2d"][strongest]
arrow = {"arrowstyle": "-|>", "lw": 3}
panels[2].annotate("", mean[0] - 3 * slope / np.linalg.norm(slope), mean[0], arrowprops=arrow)
figure.colorbar(shown, ax=panels[2], label="more (+) or less of it")
figures.show(figure, "15_compositing", title="Every pixel pulls on every splat that covers it")

# %% [markdown]
# ## Break it
# Suppose we forget that an opacity also *hides* what is behind it, and write
# $\bar\alpha_i = T_i\,c_i\cdot g$. The image is right, and so are the gradients of the colours.
# Only the adjoint identity reveals the mistake.

# %%
forgetful = np.zeros_like(inputs["alpha"])
forgetful[order] = (np.where(raw > 0.99, 0, before * v) * falloff).sum(axis=1)
wrong = lessons.inner({**ours, "alpha": forgetful}, d)
print(f"by differences {difference:.4f}, without hiding {wrong:.4f}")
assert not close(wrong, difference, 0.1)

# %% [markdown]
# ## What this idea buys
# The order is the idea: without it the scene has 23.3 dB in the order of the file, and 19.9 dB from
# back to front. What exactly is sorted by hardly matters here: with the distance from the camera in
# place of the depth $z$, some neighbours change places, and the quality stays the same. The limit
# of $0.99$ costs nothing here either.
#
# P-4DGS takes compositing over from 3DGS and has no number of its own. 3DGS has one for the sweep:
# earlier renderers gave gradients only to the first few splats of a pixel. With the first 10, its
# mean over three real scenes falls from 26.05 to 19.19 dB (Table 3 of Kerbl et al. 2023).


# %%
def distance(x):
    return np.linalg.norm(x, axis=1)


changes = {
    "front to back": NOTHING,
    "order of the file": FILE_ORDER,
    "back to front": REVERSED,
    "splats that add up": {"occlusion": False},
    "distance for depth": {"depth": distance},
    "no limit of 0.99": {"alpha_max": 1.0},
}
quality = {name: without.quality(**change) for name, change in changes.items()}
for name, dB in quality.items():
    print(f"{name:18s} {dB:.2f} dB")
assert np.allclose([*quality.values()], [33.48, 23.30, 19.87, 10.86, 33.48, 33.48], atol=0.02)

# %% [markdown]
# **In short**
# - A splat's weight in a pixel is its opacity there times the light that the splats in front of it
#   leave. All weights and the share of the background add up to one.
# - From the back, $B_{i-1} = B_i + \alpha_i (c_i - B_i)$; the same sweep gives all gradients,
#   $\bar\alpha_i = T_i (c_i - B_i)\cdot g$.
# - A splat moves towards the pixels that need its colour more than what it hides.
#
# **Often misunderstood**
# - *An opaque splat shows.* The disc of anchor 29 has the opacity 0.96 and 4.5 % of its pixel. The
#   weight counts, not the opacity.
# - *More opacity means more of the colour.* It also means less of what is behind. If that is
#   better, the gradient takes opacity away.
# - *The order needs a gradient.* It has none. When two splats change places the picture jumps a
#   little, and training lives with it.

# %% [markdown]
# ## Exercises
# **15.1** ●● In the pixel of "By hand", the middle layer turns white, and every layer stores a
# thickness $\tau_i$, like fog, with $\alpha_i = 1 - e^{-\tau_i}$. What changes in the gradient?
# Give four numbers: the pixel and, for $g = 1$, the three gradients $\bar\tau_i$.
#
# **15.2** ●● Write the forward pass. The argument `alpha_max` is the limit of $0.99$. Far along a
# thin splat, rounding can make the exponent positive; it then counts as $0$.
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

# %% [markdown]
# ## For ports
# There is another correct formula for the gradient. Let $S_i$ be the contribution of everything
# behind layer $i$ to the pixel:
# $$S_i = T_i\,(1-\alpha_i)\,B_i = \sum_{j>i} c_j\alpha_jT_j + T_N c_{bg} \quad\Longrightarrow\quad
#   \bar\alpha_i = T_ic_i - \frac{S_i}{1-\alpha_i}.$$
# gsplat 1.5.3 and `00_whole_paper` use this formula. Because of its division, an opaque layer would
# give $0/0$, but below the limit of $0.99$ the formula is as good as the sweep, *if $S_i$ is a sum
# from the back*. The kernels of gsplat and 3DGS keep only the last transmittance of the forward
# pass and recover the others, $T_i = T_{i+1}/(1-\alpha_i)$, which fails behind so many opaque
# layers that $T_N$ is 0 (`24_hard_cases`); published kernels stop before that.
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
        slopes[i] = T[i] * (gray[i] - behind)
        behind = behind + alpha[i] * (gray[i] - behind)
    return slopes


def by_division(alpha, gray, T, background):
    """The same from S, summed from the back, and a division."""
    parts = np.append(alpha * T[:-1] * gray, T[-1] * background)
    S = np.cumsum(parts[::-1])[-2::-1]
    with np.errstate(invalid="ignore"):
        return T[:-1] * gray - S / (1 - alpha)


def by_subtraction(alpha, gray, T, background):
    """The same with S as the pixel minus everything up to layer i."""
    passed = np.cumsum(alpha * T[:-1] * gray)
    C = passed[-1] + T[-1] * background
    return T[:-1] * gray - (C - passed) / (1 - alpha)


def slopes_of(formula, alpha, gray, dtype):
    alpha, gray = alpha.astype(dtype), gray.astype(dtype)
    T = np.cumprod(np.append(dtype(1), 1 - alpha))
    return formula(alpha, gray, T, dtype(0.5))


alphas = rng.uniform(0.05, 0.6, 40)
grays = rng.uniform(size=40)
alphas[[10, 25]] = 0.99
exact = slopes_of(by_sweep, alphas, grays, np.float64)
errors = {}
for formula in (by_sweep, by_division, by_subtraction):
    single = slopes_of(formula, alphas, grays, np.float32)
    errors[formula.__name__] = np.abs(single - exact) / np.abs(exact)
    print(f"{formula.__name__}: at most {errors[formula.__name__].max():.1e} of the gradient")
assert max(errors["by_sweep"].max(), errors["by_division"].max()) < 1e-4
assert errors["by_subtraction"].max() > 0.1
opaque = np.array([0.5, 1.0]), np.array([0.3, 0.6])
assert np.isfinite(slopes_of(by_sweep, *opaque, np.float64)).all()
assert np.isnan(slopes_of(by_division, *opaque, np.float64)[1])

# %%
figure, ax = plt.subplots(figsize=(9, 4.8))
for (name, error), style in zip(errors.items(), ("o-", "D:", "s--")):
    ax.semilogy(error, style, ms=4, label=name.replace("_", " "))
for layer in (10, 25):
    ax.axvline(layer, color="0.6", lw=1)
figures.finish(
    ax,
    xlabel="layer, front to back (grey lines: opacity 0.99)",
    ylabel=r"relative error of $\bar\alpha_i$ in float32",
    title="Behind nearly opaque layers the subtraction leaves no correct digit",
    legend={},
)
figures.show(figure, "15_compositing_division")
