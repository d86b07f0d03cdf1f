# %% [markdown]
# # Support: from an ellipsoid in space to an ellipse of pixels, and back
#
# **Promise.** After this you can project a Gaussian by hand, and follow a gradient from its conic back to its place and shape.
# **Before it:** `13_covariance`. **Takes** six seconds of machine time on two cores, an hour of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import covariance, projection

plt, rng, h = lessons.pyplot(), np.random.default_rng(14), 1e-6
inner = lambda a, b: (a * b).sum()

# %% [markdown]
# ## Claim
# A camera (focal lengths $f_x, f_y$, centre $c_x, c_y$, in pixels) sees a mean at a pixel $\mu$ and $\Sigma$ as a covariance of
# pixels. Along its axes the mean is $x_c = W x_{world} + T = (x, y, z)$ (in Eq. (2) $x_c$ was the camera's place), and
# $$\mu = \Bigl(f_x \tfrac{x}{z} + c_x,\; f_y \tfrac{y}{z} + c_y\Bigr),\quad \Sigma_{2D} = J W \Sigma W^T J^T + 0.3\,I,\quad
#   K = \Sigma_{2D}^{-1}.$$

# %% [markdown]
# $J$ is the slope of $\mu$ in $(x, y, z)$, but for the clip; $K$ is the *conic*, which the next tutorial reads at every pixel.
# The paper prints none of this: it is Gaussian splatting's. What the clip and the $0.3$ are for is said under *In code*.
# $$J = \begin{pmatrix} f_x/z & 0 & -f_x u/z \\ 0 & f_y/z & -f_y v/z \end{pmatrix},\quad
#   u = \mathrm{clip}(x/z, \pm 1.3\,width/2f_x),\; v = \mathrm{clip}(y/z, \pm 1.3\,height/2f_y)$$

# %% [markdown]
# ## By hand
# A flat world first: one axis $x$, the depth $z$, a row of pixels. With $f = 80$, $c = 31.5$ the point $(1, 4)$ falls on pixel
# 51.5. The slope has two parts: $f/z$, here 20 pixels per unit to the side, and $-fx/z^2$, here -5 pixels per unit of depth.

# %%
f, c, x, z = 80, 31.5, 1, 4
pixel = lambda x, z: f * x / z + c
J = np.array([f / z, -f * x / z**2])
assert pixel(x, z) == 51.5 and J.tolist() == [20, -5]
assert np.allclose(
    [pixel(x + h, z) - pixel(x - h, z), pixel(x, z + h) - pixel(x, z - h)], 2 * h * J, rtol=1e-6
)

# %% [markdown]
# A Gaussian there with variances 0.04 to the side and 0.16 in depth: its variance in pixels is $J\Sigma J^T$, which is
# 16 plus 4. With the blur it is 20.3 square pixels, and the conic, the inverse, is 0.049 per square pixel.

# %%
S = np.diag([0.04, 0.16])
variance = J @ S @ J + 0.3
assert S.diagonal().tolist() == [0.04, 0.16] and np.allclose(J**2 * S.diagonal(), [16, 4])
assert np.isclose(variance, 20.3) and round(1 / variance, 3) == 0.049

# %% [markdown]
# Is it true? A straight line stands in for a bent one, so it holds for Gaussians that are small beside their depth. The picture
# sends points of two Gaussians through the camera exactly, and draws beside them what $J$ says.

# %%
figure, (top, row) = plt.subplots(1, 2, figsize=(13, 5.4), layout="constrained")
for name, at, S, color in (
    ("far", np.array([1.0, 4]), S, lessons.COLORS[0]),
    ("near", np.array([-0.4, 1]), np.diag([0.01, 0.09]), lessons.COLORS[1]),
):
    points = at + rng.normal(size=(20000, 2)) * np.sqrt(S.diagonal())
    slope = np.array([f / at[1], -f * at[0] / at[1] ** 2])
    mean, std = pixel(*at), np.sqrt(slope @ S @ slope)
    top.plot(
        *points[:500].T, ".", ms=4, color=color, alpha=0.5, label=f"points of a Gaussian, {name}"
    )
    u = np.linspace(mean - 4 * std, mean + 4 * std, 200)
    row.hist(
        pixel(*points[points[:, 1] > 0.2].T),
        120,
        range=(-90, 80),
        density=1,
        fc=color,
        alpha=0.4,
        label=f"{name}: points",
    )
    row.plot(
        u,
        np.exp(-0.5 * ((u - mean) / std) ** 2) / std / np.sqrt(2 * np.pi),
        color=color,
        label=f"{name}: what J says",
    )
top.plot(0, 0, "k^", ms=14, ls="none", label="camera")
top.plot([-1.6, 0, 1.6], [4, 0, 4], "k-", lw=1, label="edge of the image")
top.set(
    xlabel="x (scene units)", ylabel="depth z (scene units)", title="From above", xlim=(-2.4, 2.4)
)
row.set(xlabel="pixel u", ylabel="density (1/pixel)", title="On the row of pixels", xlim=(-90, 80))
top.legend(fontsize=11), row.legend(fontsize=11)
figure.suptitle(
    "A straight line for a bent one: good far from the camera, poor close to it", fontsize=16
)
lessons.show(figure, "14_projection_line")

# %% [markdown]
# ## In code
# The same with three axes. We run the module, and beside it the steps one by one, with the names of `projection.py`.
# Matrices are `m (N, 2, 3)`, the rows of $JW$; three numbers $(a, b, c)$ stand for the symmetric `[[a, b], [b, c]]`.

# %%
N = 5
s, r = rng.uniform(0.1, 0.5, (N, 3)), rng.normal(size=(N, 4))
Sigma = covariance.forward(s, r / np.linalg.norm(r, axis=1, keepdims=True))[0].Sigma
W, T, x = (
    np.linalg.qr(rng.normal(size=(3, 3)))[0],
    np.array([0.1, -0.2, 4.0]),
    rng.normal(size=(N, 3)) * 0.7,
)
x[0] = (np.array([5, 0.4, 2.5]) - T) @ W  # far to the side: beyond the clamp
view = dict(
    W=W, T=T, focal=np.array([80.0, 65]), center=np.array([30.2, 24.9]), size=np.array([64, 48])
)
out, res = projection.forward(x, Sigma, **view)

x_c = x @ W.T + T  # 1 into the camera
z = x_c[:, 2:]
ratio, limit = x_c[:, :2] / z, 1.3 * view["size"] / (2 * view["focal"])  # 2 x/z and y/z
uv = np.clip(ratio, -limit, limit)  # 3 the clamp
m = (W[None, :2] - uv[:, :, None] * W[2]) * (view["focal"] / z)[:, :, None]  # 4 rows of J W
cov = m @ Sigma @ m.transpose(0, 2, 1) + 0.3 * np.eye(2)  # 5 pixels, and the blur
K = np.linalg.inv(cov)  # 6 the conic
assert (
    np.allclose(out.mean2d, view["focal"] * ratio + view["center"], rtol=1e-14)
    and (np.abs(ratio) > limit).sum() == 1
)
assert np.allclose(out.cov2d, cov.reshape(N, 4)[:, [0, 1, 3]]) and np.allclose(
    out.conic, K.reshape(N, 4)[:, [0, 1, 3]]
)

# %% [markdown]
# Three constants. At a depth of 0.2 or less, or where $\det\Sigma_{2D}$ is not positive or not finite, a row is *culled*: zeros,
# no gradient. The blur, 0.3 square pixels, keeps standard deviations above 0.54 pixels. The clamp, at 1.3 times the half
# width: far to the side $-f_x u/z$ would grow without bound, and a splat beside the image would smear into it.

# %%
side, straight = np.linspace(0, 3, 200), {**view, "W": np.eye(3), "T": np.zeros(3)}
there, balls = (
    np.stack([2 * side, 0 * side, 2 + 0 * side], axis=1),
    np.tile(0.05 * np.eye(3), (200, 1, 1)),
)
figure, ax = plt.subplots(figsize=(9, 4.8))
for k, style, name in ((np.inf, "C1--", "without the clamp"), (1.3, "C0-", "with it")):
    ax.plot(
        side,
        np.sqrt(projection.forward(there, balls, **straight, tan_clamp=k)[0].cov2d[:, 0]),
        style,
        label=name,
    )
ax.axvspan(0, 0.4, color="0.9", label="inside the image")
ax.set(
    xlabel="x/z, how far to the side",
    ylabel="standard deviation in u (pixels)",
    title="The clamp keeps splats beside the image small",
)
ax.legend()
lessons.show(figure, "14_projection_clamp")
assert (
    projection.forward.__defaults__ == (0.2, 0.3, 1.3)
    and limit[0] == 1.3 * (64 / 2) / 80
    and np.sqrt(0.3) > 0.54
)

# %% [markdown]
# ## Backward by hand
# From here the steps in reverse: conic, covariance, $JW$, clamp, ratio, camera. **First a convention**, where ports disagree.
# The symmetric matrix holds $b$ *twice*, but it is *one* number among the outputs. So $\bar b$ is what the loss gains when both
# entries move together. A matrix $D$ that stands for the same gradient must give the same answer:

# %% [markdown]
# $$D = \begin{pmatrix} \bar a & \bar b/2 \\ \bar b/2 & \bar c \end{pmatrix},\qquad
#   \bar a\,da + \bar b\,db + \bar c\,dc = \Bigl\langle D, \begin{pmatrix} da & db \\ db & dc \end{pmatrix}\Bigr\rangle.$$
# Numbers to matrix: halve $b$. Matrix to numbers: double the off-diagonal entry. The numbers 2, 6, 5 are the matrix
# [[2, 3], [3, 5]]. Everything between is plain matrix calculus.

# %%
matrix = lambda bar: np.stack([bar[:, 0], bar[:, 1] / 2, bar[:, 1] / 2, bar[:, 2]], axis=1).reshape(
    -1, 2, 2
)
numbers = lambda D: np.stack([D[:, 0, 0], 2 * D[:, 0, 1], D[:, 1, 1]], axis=1)
bar, change = rng.normal(size=(N, 3)), rng.normal(size=(N, 3))
assert np.isclose(
    inner(bar, change), inner(matrix(bar), change[:, [0, 1, 1, 2]].reshape(N, 2, 2)), rtol=1e-12
)
assert matrix(np.array([[2, 6, 5]]))[0].tolist() == [[2, 3], [3, 5]] and np.array_equal(
    numbers(matrix(bar)), bar
)

# %% [markdown]
# **Conic.** As scalars: $k = 1/v$ gives $dk = -dv/v^2 = -k^2\,dv$. As matrices: differentiate $K\Sigma_{2D} = I$,
# $$dK\,\Sigma_{2D} + K\,d\Sigma_{2D} = 0 \;\Rightarrow\; dK = -K\,d\Sigma_{2D}\,K \;\Rightarrow\; D_\Sigma = -K\,D_K\,K,$$
# $D_K$, $D_\Sigma$ being $D$ of conic and covariance. The last step uses $\langle A, BC\rangle = \langle AC^T, B\rangle$, its
# mirror image $\langle A, BC\rangle = \langle B^TA, C\rangle$, and $K = K^T$. No determinant is differentiated.

# %%
conic_bar, cov2d_bar = rng.normal(size=(2, N, 3))
D = -K @ matrix(conic_bar) @ K
d = rng.normal(size=(N, 3))
move = d[:, [0, 1, 1, 2]].reshape(N, 2, 2)
dK = (np.linalg.inv(cov + h * move) - np.linalg.inv(cov - h * move)).reshape(N, 4)[:, [0, 1, 3]] / (
    2 * h
)
assert np.isclose(inner(conic_bar, dK), inner(numbers(D), d), rtol=1e-8)

# %% [markdown]
# Written out, with $K = (A, B, C)$; here a factor of two is lost most easily:
# $$\bar a = -(A^2\bar A + AB\,\bar B + B^2\bar C),\qquad \bar c = -(B^2\bar A + BC\,\bar B + C^2\bar C),$$
# $$\bar b = -\bigl(2AB\,\bar A + (AC + B^2)\,\bar B + 2BC\,\bar C\bigr).$$

# %%
(A, B, C), (A_bar, B_bar, C_bar) = out.conic.T, conic_bar.T
written_out = -np.stack(
    [
        A * A * A_bar + A * B * B_bar + B * B * C_bar,
        2 * A * B * A_bar + (A * C + B * B) * B_bar + 2 * B * C * C_bar,
        B * B * A_bar + B * C * B_bar + C * C * C_bar,
    ],
    axis=1,
)
assert np.allclose(numbers(D), written_out, rtol=1e-10)

# %% [markdown]
# **Covariance.** The blur is a constant and drops out. As scalars: $v = m^2 S$, so $\bar S = m^2\bar v$ and $\bar m = 2mS\bar v$.
# As matrices, $\Sigma_{2D} = m\,\Sigma\,m^T$ with $m = JW$:
# $$\bar\Sigma = m^T D\,m,\qquad \bar m = D\,m\,\Sigma^T + D^T m\,\Sigma = D\,m\,(\Sigma + \Sigma^T).$$

# %%
D = D + matrix(cov2d_bar)  # the covariance is an output, too
Sigma_bar = m.transpose(0, 2, 1) @ D @ m
m_bar = D @ m @ (Sigma + Sigma.transpose(0, 2, 1))
ours = projection.backward(res, conic_bar=conic_bar, cov2d_bar=cov2d_bar)
assert np.allclose(ours["Sigma"], Sigma_bar, rtol=1e-10, atol=1e-12)
dm = rng.normal(size=m.shape)
answer = inner(D, dm @ Sigma @ m.transpose(0, 2, 1) + m @ Sigma @ dm.transpose(0, 2, 1))
assert np.isclose(answer, inner(m_bar, dm), rtol=1e-12)

# %% [markdown]
# **$JW$ to $u_1 = u$, $u_2 = v$ and $z$.** With $W_i$ the rows of $W$, row $i$ of $m$ is $\frac{f_i}{z}(W_i - u_i W_3)$. So
# $$\bar u_i = -\frac{f_i}{z}\,\bar m_i\cdot W_3,\qquad \bar z = -\frac1z\sum_{ij}\bar m_{ij}\,m_{ij}.$$
# **Clamp**: $\bar u$ passes where $|x/z|$ is not beyond the limit, and is lost where it is.

# %%
uv_bar = -(m_bar @ W[2]) * view["focal"] / z
z_bar = -(m_bar * m).sum(axis=(1, 2))[:, None] / z
ratio_bar = uv_bar * (np.abs(ratio) <= limit)
assert ratio_bar[0, 0] == 0 and ratio_bar[1:].all()  # Gaussian 0 is beyond the clamp in x

# %% [markdown]
# **The mean** is $f\rho + c$ with the ratio $\rho = x/z$, not clamped: its gradient joins here, $+f\bar\mu$. **The ratio** is a
# quotient: $\bar x = \bar\rho/z$, and $\bar z$ loses $\bar\rho\,x/z^2$. **Depth** adds its own. **Camera**: $W^T\bar x_c$.
# The last lines are the adjoint identity of it all. In the flat example $\bar\mu = 2$ gives $\bar x$ = 40 and $\bar z$ = -10.

# %%
mean2d_bar, depth_bar = rng.normal(size=(N, 2)), rng.normal(size=N)
ratio_bar = ratio_bar + mean2d_bar * view["focal"]
z_bar = z_bar - (ratio_bar * x_c[:, :2]).sum(axis=1, keepdims=True) / z**2 + depth_bar[:, None]
x_bar = np.concatenate([ratio_bar / z, z_bar], axis=1) @ W
ours = projection.backward(res, mean2d_bar, cov2d_bar, conic_bar, depth_bar)
assert np.allclose(ours["x"], x_bar, rtol=1e-10, atol=1e-12) and (2 * J).tolist() == [40, -10]
d = {"x": rng.normal(size=x.shape), "Sigma": rng.normal(size=Sigma.shape)}
up, down = (projection.forward(x + e * d["x"], Sigma + e * d["Sigma"], **view)[0] for e in (h, -h))
cotangents = dict(mean2d=mean2d_bar, cov2d=cov2d_bar, conic=conic_bar, depth=depth_bar)
difference = sum(inner(bar, getattr(up, n) - getattr(down, n)) for n, bar in cotangents.items()) / (
    2 * h
)
assert abs(difference - sum(inner(ours[n], d[n]) for n in d)) < 1e-7 * abs(difference)

# %% [markdown]
# What does it mean in space? A wish about the *mean* moves a Gaussian across its ray: along the ray the pixel does not change,
# so $\bar x_c\cdot x_c = 0$. A wish for a larger *size* brings it nearer.

# %%
grid = np.stack(np.meshgrid(np.linspace(-1.2, 1.2, 7), [0.0], [2.0, 3.0, 4.0]), axis=-1).reshape(
    -1, 3
)
_, seen = projection.forward(grid, balls[: len(grid)], **straight)
of_mean = projection.backward(seen, mean2d_bar=np.tile([1.0, 0], (len(grid), 1)))["x"]
of_size = projection.backward(seen, cov2d_bar=np.tile([1.0, 0, 1], (len(grid), 1)))["x"]
assert np.abs((of_mean * grid).sum(axis=1)).max() < 1e-13 and (of_size[:, 2] < 0).all()
figure, panels = plt.subplots(1, 2, figsize=(11, 5.6), sharey=True, layout="constrained")
for ax, arrows, color, what in (
    (panels[0], of_mean, "C0", r"one pixel to the right, $\bar\mu_x = 1$: across the ray"),
    (panels[1], of_size, "C1", r"a larger splat, $\bar a = \bar c = 1$: nearer"),
):
    ax.plot(0, 0, "k^", ms=14, ls="none", label="camera")
    ax.plot(
        *(grid[:, None] * [[0], [1]])[..., [0, 2]].transpose(2, 1, 0), color="0.85", lw=1, zorder=0
    )
    ax.quiver(
        grid[:, 0], grid[:, 2], arrows[:, 0], arrows[:, 2], color=color, angles="xy", width=0.008
    )
    ax.plot([], [], color=color, label=r"gradient $\bar x$")
    ax.plot(grid[:, 0], grid[:, 2], "o", ms=5, color="0.4", label="Gaussians")
    ax.set(
        title=what,
        xlabel="x (scene units)",
        ylabel="depth z (scene units)",
        aspect="equal",
        xlim=(-2, 2),
        ylim=(-0.3, 4.6),
    )
panels[1].legend(loc="lower right", fontsize=11)
figure.suptitle("Which way a pixel's wish moves a Gaussian, seen from above", fontsize=16)
lessons.show(figure, "14_projection")

# %% [markdown]
# ## Break it
# Forget the doubling: hand on $\bar b = D_{12}$ instead of $2D_{12}$. Take a splat in the middle of the image, its axes
# along those of the image. Its scales receive the right gradient: it grows as it should. Only its turning is slow: 50 percent.


# %%
def careless(inputs, cotangents):
    out, res = projection.forward(**inputs)
    K = out.conic[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    D = matrix(cotangents["cov2d_bar"]) - K @ matrix(cotangents["conic_bar"]) @ K
    return projection.backward(
        res, cotangents["mean2d_bar"], numbers(D) * [1, 0.5, 1], None, cotangents["depth_bar"]
    )


shape, of_shape = covariance.forward(np.array([[0.4, 0.2, 0.3]]), np.array([[1.0, 0, 0, 0]]))
one = dict(x=np.array([[0, 0, 3.0]]), Sigma=shape.Sigma, **straight)
some = dict(
    mean2d_bar=np.zeros((1, 2)),
    cov2d_bar=np.zeros((1, 3)),
    conic_bar=conic_bar[:1],
    depth_bar=np.zeros(1),
)
right = covariance.backward(
    of_shape, projection.backward(projection.forward(**one)[1], **some)["Sigma"]
)
wrong = covariance.backward(of_shape, careless(one, some)["Sigma"])
assert np.allclose(wrong["s"], right["s"]) and np.isclose(
    100 * wrong["r"][0, 3] / right["r"][0, 3], 50
)
verdict = oracle.check(lambda **inputs: projection.forward(**inputs)[0], "projection", careless)
assert not verdict.ok and "one of its two places" in verdict.first.explanation
print(verdict.first.explanation)

# %% [markdown]
# ## What a codec does with it
# Nothing here is coded: the decoder projects what it decoded, as a video decoder moves blocks. But projection says how many bits
# a place is worth. In a box of side 2.6 seen from a distance of 4 with $f$ of 1111 pixels, rounding on 8 bits an axis is off
# by more than a pixel; on 16, as in our file, by less than 0.02.

# %%
side, distance, focal = sizes = 2.6, 4, 1111
places = rng.uniform(-side / 2, side / 2, (5000, 3))
camera = {**straight, "T": np.array([0.0, 0, distance]), "focal": np.array([focal, focal])}
means = lambda x: projection.forward(x, np.zeros((len(x), 3, 3)), **camera)[0].mean2d
steps = {bits: side / (2**bits - 1) for bits in (8, 10, 12, 14, 16)}
off = {
    bits: np.abs(means(np.round(places / q) * q) - means(places)).max() for bits, q in steps.items()
}
print({bits: f"{pixels:.4f} px" for bits, pixels in off.items()})
assert off[8] > 1 and off[16] < 0.02 and sizes == (2.6, 4, 1111)

# %% [markdown]
# ## Exercises
# **14.1** The flat Gaussian of "By hand" stands twice as far away, at $(1, 8)$. What is its variance in pixels, blur included?
# **14.2** Write the forward: what is too near as if at $(0, 0, 1)$, then zeros where culled. **14.3** Write its backward.

# %%
answer_1 = ...


def my_forward(x, Sigma, W, T, focal, center, size):
    """-> mean2d (N, 2), cov2d (N, 3), conic (N, 3), depth (N,), visible (N,); zeros where culled."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"x" (N, 3), "Sigma" (N, 3, 3)}, from cotangents["mean2d_bar"], ["cov2d_bar"], ["conic_bar"], ["depth_bar"]."""
    raise NotImplementedError


lessons.number("14.1", answer_1, np.array([80 / 8, -80 / 64]) ** 2 @ [0.04, 0.16] + 0.3)
lessons.forward("14.2", my_forward, "projection")
lessons.backward("14.3", my_backward, "projection")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only projection` reads what a port wrote. Beside the off-diagonal entry, ports go wrong in the
# clamp's slope in $z$: beyond it $u$ is a constant, so the third entry of $J$ depends on $z$ as $1/z$, no longer as $1/z^2$.

# %%
full = lambda inputs, cotangents: projection.backward(projection.forward(**inputs)[1], **cotangents)
verdict = oracle.check(lambda **inputs: projection.forward(**inputs)[0], "projection", full)
print(verdict)
assert verdict.ok and EQUATIONS["projection"].differentiable == ("x", "Sigma")
