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
from tutorials.tools import architecture, figures

plt = figures.pyplot()
architecture.show("14_projection")
rng = np.random.default_rng(14)
inner = lessons.inner
h = 1e-6

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
# The paper prints none of this, because it belongs to Gaussian splatting. The section "In code"
# explains the clamp and the $0.3$. If you have not looked at `p4dgs_ref/splatting/loop.py` yet, do
# it now: it shows in a few lines what the renderer does with $\mu$ and $K$.

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
# Gaussians that are small compared to their depth. The figure projects points of two Gaussians
# exactly, and compares their distribution with the Gaussian that $J$ predicts.

# %%
figure, (above, on_row) = plt.subplots(
    1,
    2,
    figsize=(13, 5.4),
    layout="constrained",
)
for name, mean, deviation, color in (
    ("far", (1.0, 4.0), (0.2, 0.4), figures.COLORS[0]),
    ("near", (-0.4, 1.0), (0.1, 0.3), figures.COLORS[1]),
):
    x, z = (mean + rng.normal(size=(20_000, 2)) * deviation).T
    u_mean = pixel(*mean)
    u_deviation = np.linalg.norm(slope_of_pixel(*mean) * deviation)
    u = np.linspace(u_mean - 4 * u_deviation, u_mean + 4 * u_deviation, 200)
    predicted = np.exp(-0.5 * ((u - u_mean) / u_deviation) ** 2)
    predicted /= u_deviation * np.sqrt(2 * np.pi)
    above.plot(
        x[:500],
        z[:500],
        ".",
        ms=4,
        color=color,
        alpha=0.5,
    )
    seen = pixel(x, z)[z > 0.2]
    limits = (-90, 80)
    on_row.hist(
        seen,
        120,
        range=limits,
        density=True,
        fc=color,
        alpha=0.4,
    )
    on_row.plot(
        u,
        predicted,
        color=color,
        label=f"{name}: points, and\npredicted by J (line)",
    )
    above.text(mean[0], mean[1] + 3 * deviation[1], name, color=color)
above.plot(0, 0, "k^", ms=14)
above.text(0.2, -0.05, "camera")
above.text(-2.3, 3, "edge of\nthe image")
above.plot(
    [-1.6, 0, 1.6],
    [4, 0, 4],
    "k-",
    lw=1,
)
figures.finish(
    above,
    xlabel="x (scene units)",
    ylabel="depth z (scene units)",
    xlim=(-2.4, 2.4),
    title="From above",
)
figures.finish(
    on_row,
    xlabel="pixel u",
    ylabel="density (1/pixel)",
    xlim=(-90, 80),
    title="On the row of pixels",
)
figures.label(on_row, (-12, 0.07), (-85, 0.025))
figures.show(
    figure,
    "14_projection_line",
    title="The projection is accurate far from the camera and poor close to it",
)

# %% [markdown]
# ## In code
# Now the same with three axes. The cell runs the module, and beside it the steps one by one. The
# matrices $m$ `[N, 2, 3]` are the rows of $JW$. Three numbers $(a, b, c)$ stand for the symmetric
# matrix `[[a, b], [b, c]]`. The first of the five Gaussians is placed so far to the side that the
# clamp applies to it.

# %%
from p4dgs_ref.equations.numerics import normalise
from p4dgs_ref.splatting import covariance, factored, projection

N = 5
r, _ = normalise(rng.normal(size=(N, 4)))
Sigma, _ = covariance.forward(rng.uniform(0.1, 0.5, (N, 3)), r)
W = np.linalg.qr(rng.normal(size=(3, 3)))[0]
T = np.array([0.1, -0.2, 4.0])
focal, center, size = np.array([80.0, 65]), np.array([30.2, 24.9]), np.array([64, 48])
camera = {"W": W, "T": T, "focal": focal, "center": center, "size": size}
x = 0.7 * rng.normal(size=(N, 3))
x[0] = (np.array([5, 0.4, 2.5]) - T) @ W
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


assert np.count_nonzero(np.abs(ratio) > limit) == 1
assert visible.all()
assert close(mean2d, focal * ratio + center)
assert close(cov2d, three_numbers(cov))
assert close(conic, three_numbers(K), 1e-10)

# %% [markdown]
# The code has three constants. First, a Gaussian at a depth of 0.2 or less is *culled*, and so is
# one whose $\det\Sigma_{2D}$ is not positive or not finite. A culled row consists of zeros and
# receives no gradient. Second, the blur of 0.3 square pixels keeps the standard deviations above
# 0.54 pixels, so that no Gaussian falls between the pixels. Third, the clamp applies at 1.3 times
# half the width of the image. Without it, $-f_x \xi/z$ would grow without bound to the side, and
# Gaussians beside the image would be smeared into it.

# %%
n_side = 200
to_the_side = np.linspace(0, 3, n_side)
in_a_row = np.stack([2 * to_the_side, 0 * to_the_side, 2 + 0 * to_the_side], axis=1)
balls = np.tile(0.05 * np.eye(3), (n_side, 1, 1))
straight = {**camera, "W": np.eye(3), "T": np.zeros(3)}
figure, ax = plt.subplots(figsize=(9, 4.8))
for clamp, style, label in ((np.inf, "C1--", "without the clamp"), (1.3, "C0-", "with the clamp")):
    (_, cov2d, _, _, _), _ = projection.forward(
        in_a_row,
        balls,
        **straight,
        tan_clamp=clamp,
    )
    ax.plot(to_the_side, np.sqrt(cov2d[:, 0]), style, label=label)
ax.axvspan(
    0,
    0.4,
    color="0.9",
)
ax.text(0.2, 24, "inside\nthe image", ha="center")
figures.finish(
    ax,
    xlabel="x/z, how far to the side",
    ylabel="standard deviation in u (pixels)",
    title="The clamp keeps Gaussians beside the image small",
)
figures.label(ax, (0.95, 19.5), (1.8, 10.6))
figures.show(figure, "14_projection_clamp")

# %% [markdown]
# ## Backward by hand
# We begin with the flat example, where every step is one number. The cell writes each step as what
# it reads, its formula and its slopes, then goes through them in reverse. What flows back along an
# edge is the gradient of the step at its end, times the slope of this step. The depth $z$ and the
# slope $m_1 = f/z$ are read twice, so their gradients are sums over two edges. The cotangents are
# $\bar\mu = 2$ and, for the conic, $\bar k = 100$.

# %%
STEPS = {  # what a step reads, its formula, and its slopes in what it reads
    "rho": (("x", "z"), lambda x, z: x / z, lambda x, z: (1 / z, -x / z**2)),
    "mu": (("rho",), lambda rho: f * rho + c, lambda rho: (f,)),
    "m_1": (("z",), lambda z: f / z, lambda z: (-f / z**2,)),
    "m_2": (("rho", "m_1"), lambda rho, m_1: -rho * m_1, lambda rho, m_1: (-m_1, -rho)),
    "v": (
        ("m_1", "m_2", "S_1", "S_2"),
        lambda m_1, m_2, S_1, S_2: m_1**2 * S_1 + m_2**2 * S_2 + 0.3,
        lambda m_1, m_2, S_1, S_2: (2 * m_1 * S_1, 2 * m_2 * S_2, m_1**2, m_2**2),
    ),
    "k": (("v",), lambda v: 1 / v, lambda v: (-1 / v**2,)),
}
FLAT = {"x": 1, "z": 4, "S_1": 0.04, "S_2": 0.16}
COTANGENTS = {"mu": 2, "k": 100}


def values_of(given):
    """Return the values of what is given and of all steps."""
    value = dict(given)
    for step, (reads, formula, _) in STEPS.items():
        value[step] = formula(*(value[name] for name in reads))
    return value


value = values_of(FLAT)
gradient = dict.fromkeys(value, 0) | COTANGENTS
back_along = {}  # (what is read, step): the gradient that flows back along this edge
for step, (reads, _, slopes) in reversed(STEPS.items()):
    for name, slope in zip(reads, slopes(*(value[name] for name in reads))):
        back_along[name, step] = gradient[step] * slope
        gradient[name] += back_along[name, step]
for name in FLAT:
    up, down = (values_of(FLAT | {name: FLAT[name] + step}) for step in (h, -h))
    assert close((inner(up, COTANGENTS) - inner(down, COTANGENTS)) / (2 * h), gradient[name], 1e-7)
    print(f"gradient of {name}: {gradient[name]:.4g}")

# %%
PLACES = {
    "x": (0, 5, "$x$"),
    "z": (0, 2.2, "$z$"),
    "rho": (3, 5, r"$\rho = x/z$"),
    "m_1": (3, 2.2, "$m_1 = f/z$"),
    "m_2": (6, 3.9, r"$m_2 = -\rho\,m_1$"),
    "S_1": (6, 1.1, r"$\Sigma_{11}$"),
    "S_2": (7.6, -1.1, r"$\Sigma_{22}$"),
    "mu": (10, 5, r"$\mu = f\rho + c$"),
    "v": (9.6, 2.2, "$v = m_1^2\\Sigma_{11}$\n$+\\; m_2^2\\Sigma_{22} + 0.3$"),
    "k": (13, 2.2, "$k = 1/v$"),
    "to mu": (13, 5, ""),
    "to k": (15.4, 2.2, ""),
}
figure, ax = plt.subplots(figsize=(13, 6), layout="constrained")
frame = {"boxstyle": "round", "fc": "0.93", "ec": "0.5"}
boxes = {}
for name, (across, up, formula) in PLACES.items():
    text = ax.text(across, up, formula, ha="center", va="center", fontsize=14, bbox=frame)
    boxes[name] = text.get_bbox_patch()
    text.set_visible(bool(formula))
ends = {(name, f"to {name}"): bar for name, bar in COTANGENTS.items()}
for (name, step), bar in (back_along | ends).items():
    start, end = np.array(PLACES[name][:2]), np.array(PLACES[step][:2])
    arrow = {"arrowstyle": "-|>", "color": "0.4", "patchA": boxes[name], "patchB": boxes[step]}
    ax.annotate("", end, start, arrowprops=arrow)
    middle, up = (start + end) / 2
    for number, height, color in ((value[name], up + 0.25, "C0"), (bar, up - 0.25, "C1")):
        ax.text(
            middle,
            height,
            f"{number:.4g}",
            color=color,
            ha="center",
            va="center",
            bbox={"fc": "w", "ec": "none", "pad": 0.5},
        )
ax.set(xlim=(-0.6, 15.6), ylim=(-1.6, 5.8))
ax.axis("off")
figures.show(
    figure,
    "14_projection_graph",
    title="The flat example: values (blue, above an edge) and gradients (red, below it)",
)

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


def symmetric(numbers):
    """Return the matrices [[a, b], [b, c]] of (a, b, c) [N, 3]."""
    return numbers[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


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
s = np.tile([0.5, 0.1, 0.3], (N, 1))
_, of_factors = factored.forward(x, s, r, **camera, near=0.2, blur=0.3, tan_clamp=1.3)
Sigma_of_s, saved_Sigma = covariance.forward(s, r)
_, of_Sigma = projection.forward(x, Sigma_of_s, **camera)
bars_of_factors = factored.backward(of_factors, np.zeros((N, 2)), conic_bar)
bars_of_Sigma = projection.backward(of_Sigma, conic_bar=conic_bar)
bars_of_s = covariance.backward(saved_Sigma, bars_of_Sigma["Sigma"])
assert close(bars_of_factors["x"], bars_of_Sigma["x"], 1e-8)
assert close(bars_of_factors["s"], bars_of_s["s"], 1e-8)
assert close(bars_of_factors["r"], bars_of_s["r"], 1e-8)

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
assert ratio_bar[0, 0] == 0  # Gaussian 0 is beyond the clamp in x
assert ratio_bar[1:].all()

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
_ = lessons.adjoint(rng, partial(projection.forward, **camera), inputs, bars, ours)

# %% [markdown]
# What do these gradients mean in space? A cotangent of the *mean* moves a Gaussian perpendicular to
# its ray, because moving along the ray does not change the pixel. A
# cotangent that asks for a larger *size* moves it towards the camera.

# %%
across, depths = np.meshgrid(np.linspace(-1.2, 1.2, 7), [2.0, 3.0, 4.0])
grid = np.stack([across, 0 * across, depths], axis=-1).reshape(21, 3)
_, grid_saved = projection.forward(grid, balls[:21], **straight)
to_the_right = np.tile([1.0, 0], (21, 1))
larger = np.tile([1.0, 0, 1], (21, 1))
of_mean = projection.backward(grid_saved, mean2d_bar=to_the_right)["x"]
of_size = projection.backward(grid_saved, cov2d_bar=larger)["x"]
assert np.abs((of_mean * grid).sum(axis=1)).max() < 1e-13
assert (of_size[:, 2] < 0).all()


# %%
def draw_arrows(ax, arrows, color, title):
    """Draw the gradients of the Gaussians on the grid, seen from above."""
    x, _, z = grid.T
    ax.plot(0, 0, "k^", ms=14)
    for place_x, place_z in zip(x, z):
        ax.plot(
            [0, place_x],
            [0, place_z],
            color="0.85",
            lw=1,
            zorder=0,
        )
    ax.quiver(
        x,
        z,
        arrows[:, 0],
        arrows[:, 2],
        color=color,
        angles="xy",
        width=0.008,
    )
    ax.plot(
        x,
        z,
        "o",
        ms=5,
        color="0.4",
    )
    ax.set(
        title=title,
        xlabel="x (scene units)",
        aspect="equal",
        xlim=(-2, 2),
        ylim=(-0.3, 4.6),
    )


figure, (left, right) = plt.subplots(
    1,
    2,
    figsize=(11, 5.6),
    sharey=True,
    layout="constrained",
)
draw_arrows(left, of_mean, "C0", r"one pixel to the right, $\bar\mu_x = 1$: across the ray")
draw_arrows(right, of_size, "C1", r"a larger splat, $\bar a = \bar c = 1$: towards the camera")
left.set_ylabel("depth z (scene units)")
left.text(0.2, -0.05, "camera")
left.text(1.3, 4.05, "Gaussian", color="0.4")
left.text(1.3, 1.3, "its gradient\n$\\bar x$", color="C0")
figures.show(
    figure, "14_projection", title="How cotangents in the image move a Gaussian, seen from above"
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
# ## What a codec does with it
# The file contains nothing of this, because the decoder projects the Gaussians itself, as a video
# decoder moves blocks. But the projection tells how many bits a position is worth. Take a box of
# side 2.6, seen from a distance of 4 with a focal length of 1111 pixels. With 8 bits per axis, the
# rounded positions are wrong by more than a pixel. With 16 bits, as in the file of this project,
# the error is below 0.02 pixels.

# %%
side = 2.6
places = rng.uniform(-side / 2, side / 2, (5000, 3))
from_distance = {**straight, "T": np.array([0.0, 0, 4]), "focal": np.array([1111, 1111])}


def pixels_of(places):
    """Return the means [N, 2] of Gaussians in the image."""
    flat = np.zeros((len(places), 3, 3))
    (mean2d, _, _, _, _), _ = projection.forward(places, flat, **from_distance)
    return mean2d


errors = {}
for bits in (8, 10, 12, 14, 16):
    step = side / (2**bits - 1)
    rounded = np.round(places / step) * step
    errors[bits] = np.abs(pixels_of(rounded) - pixels_of(places)).max()
    print(f"{bits} bits: wrong by at most {errors[bits]:.4f} pixels")
assert errors[8] > 1
assert errors[16] < 0.02

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
