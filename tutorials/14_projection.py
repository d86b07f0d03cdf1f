# %% [markdown]
# # Support: from an ellipsoid in space to an ellipse of pixels, and back
#
# **Promise.** After this tutorial you can project a Gaussian by hand, and follow a gradient from
# its conic back to its position and shape. **Before it:** `13_covariance`. **Takes** six seconds of
# machine time on two cores, 45 minutes of reading and 40 of exercises.
#
# **File:** [projection.py](../p4dgs_ref/splatting/projection.py).

# %%
from functools import partial

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour, without

plt = figures.pyplot()
architecture.show("14_projection")
rng = np.random.default_rng(14)
inner = lessons.inner
thread = figures.THREAD
h = 1e-6

# %% [markdown]
# ## What fails without it
# A photograph of a soft ellipsoid is a soft ellipse, a *splat*, and the renderer has to know where
# the splat is, how long and wide it is, and how it is tilted. If one of these is missing, the
# splats of a surface no longer fit together, and its edges fray.
#
# In the picture, the rings are again the Gaussians of anchor 29. In the middle every splat is a
# circle of the right area. On the right, splats have the right length and width, but are tilted the
# wrong way, because one sign is wrong. This is worse than circles.


# %%
def circles(cov2d, z, camera):
    """Circles that have the areas of the ellipses; the numbers (a, b, c) are [[a, b], [b, c]]."""
    a, b, c = cov2d.T
    return np.sqrt(a * c - b * b)[:, None] * [1, 0, 1]


def wrong_sign(cov2d, z, camera):
    return cov2d * [1, -1, 1]


NOTHING, CIRCLES, WRONG_SIGN = {}, {"splat": circles}, {"splat": wrong_sign}

# %%
without.show_changes(
    "14_projection_fails",
    {"as trained": NOTHING, "circles of equal area": CIRCLES, "sign of b wrong": WRONG_SIGN},
)

# %% [markdown]
# ## Claim
# A camera with the focal lengths $f_x, f_y$ and the centre $c_x, c_y$, in pixels, projects a mean
# to a pixel $\mu$ and a covariance $\Sigma$ to a covariance of pixels. In the coordinates of the
# camera, the mean is $(x, y, z) = W x_{world} + T$ with the camera's rotation $W$ and translation
# $T$. Then, with the identity $I$,
# $$\mu = \Bigl(f_x \tfrac{x}{z} + c_x,\; f_y \tfrac{y}{z} + c_y\Bigr),\quad
#   \Sigma_{2D} = J W \Sigma W^T J^T + 0.3\,I,\quad K = \Sigma_{2D}^{-1}.$$
# $K$ is the *conic*, which `15_compositing` evaluates at every pixel. $J$ is the slope of $\mu$ in
# $(x, y, z)$, except for a clamp:
# $$J = \begin{pmatrix} f_x/z & 0 & -f_x \xi/z \\ 0 & f_y/z & -f_y \eta/z \end{pmatrix},\quad
#   \xi = \mathrm{clip}(x/z, \pm 1.3\,width/2f_x),\quad
#   \eta = \mathrm{clip}(y/z, \pm 1.3\,height/2f_y)$$
# In words: the camera turns the ellipsoid into its own axes, and $J$ flattens it. What is closer is
# larger, hence $1/z$; what is seen from the side is flattened along another direction, hence the
# third column. The paper prints none of this, because it belongs to Gaussian splatting, which has
# it from *EWA splatting* (Zwicker et al. 2001). The section "In code" explains the clamp and the
# $0.3$.

# %% [markdown]
# ## By hand
# Start with a flat world that has one axis $x$, the depth $z$ and a row of pixels. With $f = 80$
# and $c = 31.5$, the point $(1, 4)$ is projected to the pixel $80\cdot\frac14 + 31.5 = 51.5$. The
# slope has two parts: $f/z$, here 20 pixels per unit of $x$, and $-fx/z^2$, here $-5$ pixels per
# unit of depth.
#
# Let a Gaussian at this point have the variances 0.04 in $x$ and 0.16 in depth. Its variance in
# pixels is $J\Sigma J^T = 20^2\cdot 0.04 + 5^2\cdot 0.16 = 16 + 4$. With the blur it is 20.3 square
# pixels. The conic is the inverse, 0.049 per square pixel.

# %%
from p4dgs_ref.lessons import close

f, c = 80, 31.5


def pixel(x, z):
    return f * x / z + c


def slope_of_pixel(x, z):
    return np.array([f / z, -f * x / z**2])


J = slope_of_pixel(1, 4)
along_x = (pixel(1 + h, 4) - pixel(1 - h, 4)) / (2 * h)
along_z = (pixel(1, 4 + h) - pixel(1, 4 - h)) / (2 * h)
assert close([along_x, along_z], J, 1e-6)
variance = J**2 @ [0.04, 0.16] + 0.3
print(f"pixel {pixel(1, 4)}, variance {variance}, conic {1 / variance:.3f}")

# %% [markdown]
# How good is this? $J$ replaces a curved map by a straight one, so the result is accurate for
# Gaussians that are small compared to their depth. Take the disc of anchor 29 that `13_covariance`
# turned. The cell samples 20,000 points from this Gaussian and projects each of them exactly. The
# figure shows 1,000 of them, the ellipse of the covariance of all in dashed black, and the ellipse
# that $J$ predicts in purple. On the left is the camera of the pictures, where the widths agree to
# 1 %. On the right the camera is ten times nearer, at four times the radius of the disc. Even there
# $J$ makes it only 4 % too narrow, but the points have a long tail to the lower left, which no
# ellipse has.

# %%
from p4dgs_ref.splatting import covariance, factored, projection, render
from p4dgs_ref.splatting.settings import EXACT

g = without.GAUSSIANS
x, s, r = (a[without.OWN].astype(float)[[0, 1, 2, 2]] for a in (g.x, g.s, g.r))
Sigma, _ = covariance.forward(s, r)
camera = render.pinhole(without.CAMERA, EXACT)
W, T, focal, center, size = (camera[n] for n in ("W", "T", "focal", "center", "size"))
disc = x[2] @ W.T + T  # as the camera sees it
cloud = rng.multivariate_normal(x[2], Sigma[2], 20_000)
views = {}
for name, nearer in (("the camera of the pictures", 0.0), ("ten times nearer", 0.9)):
    moved = {**camera, "T": T - nearer * disc, "blur": 0.0}
    (mean2d, cov2d, *_), _ = projection.forward(x[2:3], Sigma[2:3], **moved)
    points = projection.forward(cloud, np.zeros((len(cloud), 3, 3)), **{**moved, "blur": 0.3})[0][0]
    exact = np.cov(points.T).reshape(1, 4)[:, [0, 1, 3]]
    views[name] = points, mean2d, cov2d, exact
    widths = np.sqrt([exact[0, 0], cov2d[0, 0]])
    print("{}: standard deviation in u {:.2f} pixels, by J {:.2f}".format(name, *widths))
    assert 0.95 < widths[1] / widths[0] < 1

# %%
figure, panels = plt.subplots(1, 2, figsize=(11, 5), layout="constrained")
for ax, (name, (points, mean2d, cov2d, exact)) in zip(panels, views.items()):
    ax.plot(*points[:1000].T, ".", ms=3, color="0.7")
    show.ellipses(ax, points.mean(axis=0)[None], exact, fc="none", ec="k", lw=2, ls="--")
    show.ellipses(ax, mean2d, cov2d, fc="none", ec=thread.color, lw=3)
    (u, v), reach = mean2d[0], 4 * cov2d[0, 0] ** 0.5
    ax.set(title=name, xlabel="u (pixels)", ylabel="v (pixels)", aspect="equal")
    ax.set(xlim=(u - reach, u + reach), ylim=(v + reach, v - reach))
figures.show(figure, "14_projection_cloud")

# %% [markdown]
# ## In code
# The cell runs the module on anchor 29, and beside it the steps one by one. The matrices $m$
# `[N, 2, 3]` are the rows of $JW$. Three numbers $(a, b, c)$ stand for the symmetric matrix
# `[[a, b], [b, c]]`. A fourth Gaussian is a copy of the disc, placed so far to the side that the
# clamp applies to it.

# %%
x[3] = (np.array([2, 0.4, 2.5]) - T) @ W
N = len(x)
(mean2d, cov2d, conic, depth, visible), saved = projection.forward(x, Sigma, **camera)

x_c = x @ W.T + T  # 1. in the coordinates of the camera
z = x_c[:, 2:]
ratio = x_c[:, :2] / z  # 2. x/z and y/z
limit = 1.3 * size / (2 * focal)
uv = np.clip(ratio, -limit, limit)  # 3. the clamp
m = (W[:2] - uv[:, :, None] * W[2]) * (focal / z)[:, :, None]  # 4. the rows of J W
cov = m @ Sigma @ m.transpose(0, 2, 1) + 0.3 * np.eye(2)  # 5. in pixels, with the blur
K = np.linalg.inv(cov)  # 6. the conic


def three_numbers(matrices):
    """Return (a, b, c) of matrices [[a, b], [b, c]]."""
    return matrices.reshape(-1, 4)[:, [0, 1, 3]]


def symmetric(numbers):
    """Return the matrices [[a, b], [b, c]] of (a, b, c) [N, 3]."""
    return numbers[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


assert np.count_nonzero(np.abs(ratio) > limit) == 1
assert visible.all()
assert close(mean2d, focal * ratio + center)
assert close(cov2d, three_numbers(cov))
assert close(conic, three_numbers(K), 1e-10)
print("the disc: mu", mean2d[2].round(2), "| a, b, c of Sigma_2D", cov2d[2].round(2))

# %% [markdown]
# The splat of the disc has standard deviations of 2.1 pixels across and 1.7 pixels down. It rises
# to the right, and because $v$ points down, its $b$ is negative.
#
# The code has three constants. First, a Gaussian at a depth of 0.2 or less is *culled*, and so is
# one whose $\det\Sigma_{2D}$ is not positive or not finite. A culled row consists of zeros and
# receives no gradient.
#
# Second, the blur of 0.3 square pixels keeps the standard deviations above 0.54 pixels, so that no
# Gaussian falls between the pixels. In the scene, 58 % of all splats are narrower than half a pixel
# without it. The next picture leaves it out, at the size at which the scene was trained: the
# surface gets gaps and sparkles. Enlarged, the same picture would look sharper and mislead, because
# between the pixels there is nothing that training has seen.
#
# Third, the clamp applies at 1.3 times half the width of the image. Without it, $-f_x \xi/z$ would
# grow without bound to the side, and Gaussians beside the image would be smeared into it. In our
# test views no Gaussian is farther to the side than $|x/z| = 0.36$, and the clamp applies from 0.49
# on, so it costs and gains nothing here.

# %%
NO_BLUR, NO_CLAMP = {"blur": 0.0}, {"tan_clamp": np.inf}
narrow = np.linalg.eigvalsh(symmetric(without.draw(g, without.CAMERA, **NO_BLUR)[2]))[:, 0] < 0.25
print(f"{narrow.mean():.0%} of all splats are narrower than half a pixel")
furthest = max(
    np.abs(show.to_pixels(seen.x, v.camera) - center).max() for v, seen in without.test_views()
)
print(f"|x/z| is at most {furthest / focal[0]:.2f}, the clamp {limit[0]:.2f}")
assert furthest / focal[0] < 0.36 < limit[0]

# %%
without.show_changes(
    "14_projection_blur", {"as trained": NOTHING, "no blur": NO_BLUR}, zoom=1, view=tour.VIEW
)

# %% [markdown]
# ## Backward by hand
# We begin with the flat example, where every step is one number, and take the steps in reverse.
# Each gradient is the gradient of the step that reads the number, times the slope of this step. The
# depth $z$, the ratio $\rho$ and the slope $m_1 = f/z$ are read twice or more, so their gradients
# are sums. The cotangents are $\bar\mu = 2$ and, for the conic, $\bar k = 100$.


# %%
def flat_forward(x, z, S_1, S_2):
    """Return mu, k and what is between them."""
    rho = x / z
    m_1 = f / z
    m_2 = -rho * m_1
    v = m_1**2 * S_1 + m_2**2 * S_2 + 0.3
    return f * rho + c, 1 / v, rho, m_1, m_2


flat = np.array([1, 4, 0.04, 0.16])
x_flat, z_flat, S_1, S_2 = flat
_, k, rho, m_1, m_2 = flat_forward(*flat)
mu_bar, k_bar = 2, 100
v_bar = -(k**2) * k_bar
m_2_bar = 2 * m_2 * S_2 * v_bar
m_1_bar = 2 * m_1 * S_1 * v_bar - rho * m_2_bar
rho_bar = f * mu_bar - m_1 * m_2_bar
z_bar = -f / z_flat**2 * m_1_bar - x_flat / z_flat**2 * rho_bar
gradients = [rho_bar / z_flat, z_bar, m_1**2 * v_bar, m_2**2 * v_bar]
print("gradients of x, z and the variances:", np.round(gradients, 3))
for move, gradient in zip(h * np.eye(4), gradients):
    up, down = (inner(flat_forward(*(flat + d))[:2], (mu_bar, k_bar)) for d in (move, -move))
    assert close((up - down) / (2 * h), gradient, 1e-6)

# %% [markdown]
# Now all steps with three axes, in reverse: conic, covariance, $JW$, clamp, ratio, camera.
#
# **First a convention**, on which ports disagree. The symmetric matrix contains $b$ *twice*, but
# $b$ is *one* number of the output. So $\bar b$ says how the loss changes if both entries change
# together. A matrix $D$ that represents the same gradient must give the same result:
# $$D = \begin{pmatrix} \bar a & \bar b/2 \\ \bar b/2 & \bar c \end{pmatrix},\qquad
#   \bar a\,da + \bar b\,db + \bar c\,dc
#   = \Bigl\langle D, \begin{pmatrix} da & db \\ db & dc \end{pmatrix}\Bigr\rangle.$$
# From numbers to a matrix, $\bar b$ is halved. From a matrix to numbers, the entry beside the
# diagonal is doubled. The numbers $(2, 6, 5)$, for example, are the matrix `[[2, 3], [3, 5]]`.
# Everything in between is ordinary matrix calculus.


# %%
def to_matrix(bar):
    """Return the matrices D [N, 2, 2] of gradients (a, b, c) [N, 3]."""
    a, b, c = bar.T
    return np.stack([a, b / 2, b / 2, c], axis=1).reshape(-1, 2, 2)


def to_numbers(D):
    """Return the gradients (a, b, c) [N, 3] of matrices D [N, 2, 2]."""
    return three_numbers(D) * [1, 2, 1]


bar, change = rng.normal(size=(2, N, 3))
assert close(inner(bar, change), inner(to_matrix(bar), symmetric(change)))
assert close(to_numbers(to_matrix(bar)), bar)

# %% [markdown]
# **Conic.** With numbers, $k = 1/v$ gives $dk = -dv/v^2 = -k^2\,dv$. With matrices, we
# differentiate $K\Sigma_{2D} = I$:
# $$dK\,\Sigma_{2D} + K\,d\Sigma_{2D} = 0 \;\Rightarrow\; dK = -K\,d\Sigma_{2D}\,K
#   \;\Rightarrow\; D_\Sigma = -K\,D_K\,K$$
# Here $D_K$ and $D_\Sigma$ are the matrices $D$ of the conic and of the covariance. The last step
# uses the rule $\langle A, BC\rangle = \langle AC^T, B\rangle$ of `13_covariance`, its counterpart
# $\langle A, BC\rangle = \langle B^TA, C\rangle$, and $K = K^T$. No determinant needs to be
# differentiated.

# %%
conic_bar, cov2d_bar = rng.normal(size=(2, N, 3))
D = -K @ to_matrix(conic_bar) @ K
d = rng.normal(size=(N, 3))
dK = np.linalg.inv(cov + h * symmetric(d)) - np.linalg.inv(cov - h * symmetric(d))
difference = inner(conic_bar, three_numbers(dK)) / (2 * h)
assert close(difference, inner(to_numbers(D), d), 1e-8)

# %% [markdown]
# Written out with $K = (A, B, C)$, this is the place where a factor of two is lost most easily:
# $$\bar a = -(A^2\bar A + AB\,\bar B + B^2\bar C),\qquad
#   \bar c = -(B^2\bar A + BC\,\bar B + C^2\bar C),$$
# $$\bar b = -\bigl(2AB\,\bar A + (AC + B^2)\,\bar B + 2BC\,\bar C\bigr).$$

# %%
A, B, C = conic.T
A_bar, B_bar, C_bar = conic_bar.T
a_bar = -(A * A * A_bar + A * B * B_bar + B * B * C_bar)
b_bar = -(2 * A * B * A_bar + (A * C + B * B) * B_bar + 2 * B * C * C_bar)
c_bar = -(B * B * A_bar + B * C * B_bar + C * C * C_bar)
assert close(to_numbers(D), np.stack([a_bar, b_bar, c_bar], axis=1), 1e-9)

# %% [markdown]
# **Covariance.** The blur is a constant and has no gradient. With numbers, $v = m^2 S$ gives
# $\bar S = m^2\bar v$ and $\bar m = 2mS\bar v$. With matrices, $\Sigma_{2D} = m\,\Sigma\,m^T$ and
# $$\bar\Sigma = m^T D\,m,\qquad
#   \bar m = D\,m\,\Sigma^T + D^T m\,\Sigma = D\,m\,(\Sigma + \Sigma^T).$$
# The covariance is an output as well, so its own cotangent is added to $D$.

# %%
D = D + to_matrix(cov2d_bar)
Sigma_bar = m.transpose(0, 2, 1) @ D @ m
m_bar = D @ m @ (Sigma + Sigma.transpose(0, 2, 1))
ours = projection.backward(saved, conic_bar=conic_bar, cov2d_bar=cov2d_bar)
assert close(ours["Sigma"], Sigma_bar, 1e-10)
dm = rng.normal(size=m.shape)
dcov = dm @ Sigma @ m.transpose(0, 2, 1) + m @ Sigma @ dm.transpose(0, 2, 1)
assert close(inner(D, dcov), inner(m_bar, dm))

# %% [markdown]
# **From $JW$ to $\xi_1 = \xi$, $\xi_2 = \eta$ and $z$.** With $W_i$ for the rows of $W$, row $i$ of
# $m$ is $\frac{f_i}{z}(W_i - \xi_i W_3)$. So
# $$\bar\xi_i = -\frac{f_i}{z}\,\bar m_i\cdot W_3,\qquad
#   \bar z = -\frac1z\sum_{ij}\bar m_{ij}\,m_{ij}.$$
# **Clamp.** $\bar\xi$ is passed on where $|x/z|$ is within the limit. Beyond the limit, $\xi$ is a
# constant and its gradient is lost.

# %%
uv_bar = -(m_bar @ W[2]) * focal / z
z_bar = -(m_bar * m).sum(axis=(1, 2))[:, None] / z
ratio_bar = uv_bar * (np.abs(ratio) <= limit)
assert ratio_bar[3, 0] == 0  # the copy is beyond the clamp in x
assert ratio_bar[:3].all()

# %% [markdown]
# **The mean** is $f\rho + c$ with the ratio $\rho = x/z$, which is not clamped. Its gradient
# $f\bar\mu$ is added here.
#
# **The ratio** is a quotient, so $\bar x = \bar\rho/z$, and $\bar z$ gets the additional term
# $-\bar\rho\,x/z^2$. In the flat example, $\bar\mu = 2$ gives $\bar x = 40$ and $\bar z = -10$.
#
# **The depth** adds its own cotangent to $\bar z$, and **the camera** multiplies by $W^T$. The last
# lines of the cell are the adjoint identity of all steps together.

# %%
mean2d_bar = rng.normal(size=(N, 2))
depth_bar = rng.normal(size=N)
ratio_bar = ratio_bar + mean2d_bar * focal
z_bar = z_bar - (ratio_bar * x_c[:, :2]).sum(axis=1, keepdims=True) / z**2
z_bar = z_bar + depth_bar[:, None]
x_bar = np.concatenate([ratio_bar / z, z_bar], axis=1) @ W
bars = (mean2d_bar, cov2d_bar, conic_bar, depth_bar)
ours = projection.backward(saved, *bars)
assert close(ours["x"], x_bar, 1e-10)

inputs = {"x": x, "Sigma": Sigma}
_ = lessons.adjoint(rng, partial(projection.forward, **camera), inputs, bars, ours, 1e-6)

# %% [markdown]
# What do these gradients mean in space? A cotangent of the *mean* moves a Gaussian perpendicular to
# its ray, because moving along the ray does not change the pixel. A cotangent that asks for a
# larger *size* moves it towards the camera, and a little to the side, where $J$ stretches it.
# Beyond the clamp, at both ends of the nearest row, it moves in depth alone.

# %%
straight = {**camera, "W": np.eye(3), "T": np.zeros(3)}
across, depths = np.meshgrid(np.linspace(-1.2, 1.2, 7), [2.0, 3.0, 4.0])
grid = np.stack([across, 0 * across, depths], axis=-1).reshape(21, 3)
_, grid_saved = projection.forward(grid, np.tile(0.05 * np.eye(3), (21, 1, 1)), **straight)
to_the_right = np.tile([1.0, 0], (21, 1))
larger = np.tile([1.0, 0, 1], (21, 1))
of_mean = projection.backward(grid_saved, mean2d_bar=to_the_right)["x"]
of_size = projection.backward(grid_saved, cov2d_bar=larger)["x"]
assert np.abs((of_mean * grid).sum(axis=1)).max() < 1e-13
assert (of_size[:, 2] < 0).all()

# %%
figure, panels = plt.subplots(1, 2, figsize=(11, 5.6), sharey=True, layout="constrained")
names = r"one pixel to the right, $\bar\mu_x = 1$", r"a larger splat, $\bar a = \bar c = 1$"
for ax, arrows, name in zip(panels, (of_mean, of_size), names):
    ax.plot(*np.moveaxis([0 * grid, grid], 2, 0)[::2], color="0.85", lw=1)
    ax.quiver(*grid[:, ::2].T, *arrows[:, ::2].T, color="C1", angles="xy", width=0.008, zorder=2)
    ax.plot(0, 0, "k^", ms=14)
    ax.set(title=name, xlabel="x (scene units)", aspect="equal", xlim=(-2, 2), ylim=(-0.3, 4.6))
panels[0].set_ylabel("depth z (scene units)")
panels[0].text(0.2, -0.05, "camera")
figures.show(
    figure, "14_projection", title="How cotangents in the image move a Gaussian, from above"
)

# %% [markdown]
# ## Break it
# Suppose we forget the doubling and return $\bar b = D_{12}$ instead of $2D_{12}$. Take a Gaussian
# in the middle of the image whose axes are parallel to those of the image. Its scales receive the
# right gradient, so it grows as it should. Only the gradient of its rotation is half of what it
# should be.


# %%
def without_doubling(inputs, cotangents):
    (_, _, conic, _, _), saved = projection.forward(**inputs)
    K = symmetric(conic)
    D = to_matrix(cotangents["cov2d_bar"]) - K @ to_matrix(cotangents["conic_bar"]) @ K
    return projection.backward(
        saved,
        mean2d_bar=cotangents["mean2d_bar"],
        cov2d_bar=three_numbers(D),
        depth_bar=cotangents["depth_bar"],
    )


shape, shape_saved = covariance.forward(np.array([[0.4, 0.2, 0.3]]), np.array([[1.0, 0, 0, 0]]))
in_the_middle = {"x": np.array([[0, 0, 3.0]]), "Sigma": shape, **straight}
of_conic = {
    "mean2d_bar": np.zeros((1, 2)),
    "cov2d_bar": np.zeros((1, 3)),
    "conic_bar": conic_bar[:1],
    "depth_bar": np.zeros(1),
}
_, saved = projection.forward(**in_the_middle)
right = covariance.backward(shape_saved, projection.backward(saved, **of_conic)["Sigma"])
wrong = covariance.backward(shape_saved, without_doubling(in_the_middle, of_conic)["Sigma"])
assert close(wrong["s"], right["s"])
assert close(wrong["r"][0, 3], right["r"][0, 3] / 2)


def outputs_of_projection(**inputs):
    return projection.forward(**inputs)[0]


lessons.check_mistake(
    outputs_of_projection, "projection", "one of its two places", vjp=without_doubling
)

# %% [markdown]
# ## How many bits a position needs
# The file contains no splats, because the decoder projects the Gaussians itself, as a video decoder
# moves blocks itself. But the projection tells how many bits a position is worth. The cell rounds
# the positions of all anchors and projects them into pictures that are 64 pixels wide, like ours,
# and 800 pixels wide, like the paper's synthetic ones. 8 bits per axis are enough for the small
# picture alone. Two more bits divide the error by four, so 16 bits, as in the file of this project,
# leave less than 0.01 pixels of 800.

# %%
places = tour.MODEL.anchors.x_a.astype(float)
low, high = tour.MODEL.box
large = show.enlarged(without.CAMERA, 800 / 64)
for bits in (8, 10, 12):
    step = (high - low) / (2**bits - 1)
    rounded = low + np.round((places - low) / step) * step
    off = np.abs(show.to_pixels(rounded, large) - show.to_pixels(places, large)).max()
    print(f"{bits} bits: wrong by at most {off * 64 / 800:.4f} and {off:.4f} pixels")
assert off / 2**4 < 0.01  # of 16 bits

# %% [markdown]
# ## What this idea buys
# On the ten test views, each row takes one step out of the finished scene. The tilt, the blur and
# the sizes by distance all matter. The third column of $J$ matters little: the scene is seen in a
# narrow angle, $|x/z| \le 0.36$, and the difference of 1 dB is hard to see in a picture. With a
# wide lens it would be more. The clamp changes nothing here. Neither the paper nor 3DGS has numbers
# for these steps. Both train with a blur, and a scene must be drawn with the blur that it was
# trained with.


# %%
def one_distance(cov2d, z, camera):
    """The size of splats as if they were all as far away as the middle of the scene."""
    blur = np.array([0.3, 0, 0.3])
    return blur + (cov2d - blur) * (z[:, None] / np.linalg.norm(camera.center)) ** 2


changes = {
    "as trained": NOTHING,
    "circles of equal area": CIRCLES,
    "sign of b wrong": WRONG_SIGN,
    "no blur": NO_BLUR,
    "no 1/z": {"splat": one_distance},
    "no third column of J": {"tan_clamp": 0.0},
    "no clamp": NO_CLAMP,
}
quality = {name: without.quality(**change) for name, change in changes.items()}
for name, dB in quality.items():
    print(f"{name:22s} {dB:.1f} dB")
numbers = [33.48, 27.50, 26.22, 22.98, 31.72, 32.51, 33.48]
assert np.allclose([*quality.values()], numbers, atol=0.02)

# %% [markdown]
# **In short**
# - The mean goes through the pinhole exactly; the covariance goes through its slope $J$ at the
#   mean, $\Sigma_{2D} = JW\Sigma W^TJ^T$, and then gets the blur.
# - The conic is the inverse of $\Sigma_{2D}$: what the compositor needs at every pixel.
# - A matrix holds $b$ twice, an output once: halve it on the way in, double it on the way out.
#
# **Often misunderstood**
# - *The blur makes pictures soft.* It is part of what was trained. Without it the splats are too
#   thin, and the picture gets holes and sparkles.
# - *A splat is the shadow of the ellipsoid.* It is the shadow of the ellipsoid as a straight map
#   sees it, which is good if the Gaussian is small compared to its depth.
# - *A Gaussian that is too small in the picture is made larger.* It may also be moved towards the
#   camera, as the arrows show; the other cameras decide between the two.

# %% [markdown]
# ## Exercises
# **14.1** ● The flat Gaussian of "By hand" stands twice as far away, at $(1, 8)$. What is its
# variance in pixels, including the blur?
#
# **14.2** ●● Write the forward. Compute Gaussians that are too near as if they were at $(0, 0, 1)$,
# and set all culled rows to zero at the end.
#
# **14.3** ●●● Write its backward.
#
# **Predict, then run.** The same camera takes pictures of twice the width and height, with twice
# the focal length. What happens to the mean, the variances and the blur of a splat, all in pixels?

# %%
answer_1 = ...


def my_forward(x, Sigma, W, T, focal, center, size):
    """Return mean2d [N, 2], cov2d [N, 3], conic [N, 3], depth [N] and visible [N].

    Rows that are culled are zero.
    """
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return the gradients {"x" [N, 3], "Sigma" [N, 3, 3]}.

    `cotangents` holds "mean2d_bar", "cov2d_bar", "conic_bar" and "depth_bar".
    """
    raise NotImplementedError


lessons.check_number("14.1", answer_1)
lessons.check_forward("14.2", my_forward, "projection")
lessons.check_backward("14.3", my_backward, "projection")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only projection` compares what a port wrote. Besides the entry
# beside the diagonal, the usual mistake is the slope of the clamp in $z$. Beyond the clamp $\xi$ is
# a constant, so the third column of $J$ depends on $z$ as $1/z$, no longer as $1/z^2$.

# %%
lessons.passes("projection")

# %% [markdown]
# ## For ports
# **Needles.** For long thin Gaussians $ac - b^2$ and $K D_K K$ cancel; from about $10^7$ pixels on
# `float64` loses all digits. Training and rendering therefore run
# [factored.py](../p4dgs_ref/splatting/factored.py): it starts from $s$ and the rotation $R$ of
# `13_covariance`, so that $\Sigma = \mathrm{diag}(s)^2$ in the axes of the Gaussian. With
# $m = JWR$, its rows $m_1$, $m_2$ and $n = m_1\times m_2$,
# $$\det\Sigma_{2D} = s_2^2s_3^2n_1^2 + s_3^2s_1^2n_2^2 + s_1^2s_2^2n_3^2
#   + 0.3\,(m_1\Sigma m_1^T + m_2\Sigma m_2^T) + 0.3^2,$$
# and $Km$, which gives $\bar\Sigma = -(Km)^T D_K\,(Km)$, has the rows
# $(\Sigma m_2)\times n + 0.3\,m_1$ and $n\times(\Sigma m_1) + 0.3\,m_2$ over the determinant.

# %%
_, of_factors = factored.forward(x, s, r, **camera)
_, of_Sigma = projection.forward(x, Sigma, **camera)
bars_of_factors = factored.backward(of_factors, np.zeros((N, 2)), conic_bar)
bars_of_Sigma = projection.backward(of_Sigma, conic_bar=conic_bar)
_, saved_Sigma = covariance.forward(s, r)
bars_of_s = covariance.backward(saved_Sigma, bars_of_Sigma["Sigma"])
assert close(bars_of_factors["x"], bars_of_Sigma["x"], 1e-8)
assert close(bars_of_factors["s"], bars_of_s["s"], 1e-8)
assert close(bars_of_factors["r"], bars_of_s["r"], 1e-8)
