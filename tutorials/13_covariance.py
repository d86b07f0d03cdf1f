# %% [markdown]
# # Support: from a quaternion and three scales to a covariance, and back
#
# **Promise.** After this tutorial you can turn a quaternion into an ellipsoid by hand, and send a
# gradient of the ellipsoid back to the quaternion. **Before it:** `01_offsets`, `02_view`.
# **Takes** six seconds of machine time on two cores, 30 minutes of reading and 35 of exercises.
#
# **File:** [covariance.py](../p4dgs_ref/splatting/covariance.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, without

plt = figures.pyplot()
architecture.show("13_covariance")
rng = np.random.default_rng(13)
thread = figures.THREAD

# %% [markdown]
# ## What fails without it
# Splatting builds a scene from soft blobs, its Gaussians. If they were balls, those that cover a
# wall would stick out of it on both sides, and balls small enough to hide in it would leave holes.
# A Gaussian therefore has three sizes, one along each of its own axes, and a rotation that lays
# these axes along the surface.
#
# This tutorial and the next two follow the Gaussians of anchor 29 from their shape to the picture.
# The left side shows the red ball of the trained scene from near, with these Gaussians ringed in
# purple. In the middle nothing is turned: every Gaussian keeps its three sizes, but they lie along
# x, y and z. On the right every Gaussian is a ball of the same volume. The titles give the mean
# quality of ten test views as the PSNR, a logarithmic measure of the mean squared error: 3 dB more
# mean half the error.


# %%
def spheres(s, r):
    """The covariances [N, 3, 3] of balls that have the volumes of the ellipsoids."""
    return np.prod(s, axis=1)[:, None, None] ** (2 / 3) * np.eye(3)


def never_turned(s, r):
    return s[:, :, None] ** 2 * np.eye(3)


NOTHING, TURN, SIZES = {}, {"shape": never_turned}, {"shape": spheres}

# %%
without.show_changes(
    "13_covariance_fails", {"as trained": NOTHING, "never turned": TURN, "balls": SIZES}
)

# %% [markdown]
# ## Claim
# A Gaussian is a soft ellipsoid: densest in its middle, and thinner the farther away one goes. Its
# shape is a *covariance* $\Sigma$, a symmetric matrix that says for each direction $v$ how far the
# Gaussian reaches: $v^T\Sigma v$ is the variance along $v$, the square of the standard deviation.
# Each Gaussian has three scales $s$, the standard deviations along its own axes, and a unit
# quaternion $r = (w, x, y, z)$, which describes a rotation. From these,
# $$\Sigma = R\,S\,S^T R^T, \qquad S = \mathrm{diag}(s).$$
# The paper does not print this formula, because it belongs to Gaussian splatting. The inputs are
# $s'$ and $r'$ of Eq. (6). The rotation matrix of a unit quaternion is
# $$R = \begin{pmatrix} 1-2(y^2+z^2) & 2(xy-wz) & 2(xz+wy) \\ 2(xy+wz) & 1-2(x^2+z^2) & 2(yz-wx) \\
#   2(xz-wy) & 2(yz+wx) & 1-2(x^2+y^2) \end{pmatrix}.$$
#
# This tutorial and the next two are about the folder `p4dgs_ref/splatting/`. The first file to read
# there is `loop.py`: it renders an image with plain loops over pixels and Gaussians, and
# `15_compositing` explains it.

# %% [markdown]
# ## By hand
# We stay in the plane first. With $x = y = 0$, the upper left part of $R$ has $1-2z^2$ on its
# diagonal and $\mp 2wz$ beside it. A rotation by the angle $\theta$ has $w = \cos\frac\theta2$ and
# $z = \sin\frac\theta2$, with *half* the angle, because $1-2\sin^2\frac\theta2 = \cos\theta$ and
# $2\sin\frac\theta2\cos\frac\theta2 = \sin\theta$.
#
# For a quarter turn, $w = z = \sqrt{1/2}$. The diagonal is 0 and the entries beside it are $-1$ and
# 1, so the x axis is turned into the y axis. With the scales 3 and 2, $S S^T$ has 9 and 4 on its
# diagonal. After the rotation these are 4 and 9, so the long axis points along y.


# %%
from p4dgs_ref.lessons import close


def flat_rotation(w, z):
    """Return the upper left part of R for x = y = 0."""
    return np.array([[1 - 2 * z * z, -2 * w * z], [2 * w * z, 1 - 2 * z * z]])


quarter = flat_rotation(np.sqrt(0.5), np.sqrt(0.5))
M = quarter @ np.diag([3, 2])
assert close(M @ M.T, [[4, 0], [0, 9]])

# %% [markdown]
# The figure shows how $M = RS$ bends a circle into an ellipse. The columns of $M$ are its half
# axes. Since $v^T\Sigma v = |M^Tv|^2$, no direction $v$ has a negative variance, whatever the
# networks predict. If they predicted the entries of $\Sigma$ one by one, this could happen.


# %%
def draw_ellipse(ax, Sigma, **style):
    """Draw the one-sigma ellipse of a covariance [2, 2]."""
    show.ellipses(ax, np.zeros((1, 2)), Sigma.reshape(1, 4)[:, [0, 1, 3]], **style)


figure, panels = plt.subplots(1, 4, figsize=(13, 4.6), sharey=True, layout="constrained")
for ax, degrees in zip(panels, (0, 30, 60, 90)):
    w, z = np.cos(np.radians(degrees) / 2), np.sin(np.radians(degrees) / 2)
    M = flat_rotation(w, z) @ np.diag([3, 1])
    Sigma = M @ M.T
    draw_ellipse(ax, Sigma, color=show.PALE)
    for axis, color in zip(M.T, figures.COLORS):
        ax.annotate("", axis, (0, 0), arrowprops={"arrowstyle": "-|>", "lw": 3, "color": color})
    numbers = "a = {:.1f}, b = {:.1f}, c = {:.1f}".format(*Sigma.ravel()[[0, 1, 3]])
    ax.set(
        title=f"{degrees}°: w = {w:.3f}, z = {z:.3f}\n{numbers}",
        aspect="equal",
        xlim=(-3.4, 3.4),
        ylim=(-3.4, 3.4),
    )
figures.show(
    figure,
    "13_covariance",
    title=r"The quaternion contains half the angle; $\Sigma$ = [[a, b], [b, c]] contains b twice",
)

# %% [markdown]
# ## In code
# `s [N, 3]` and `r [N, 4]` give `Sigma [N, 3, 3]` in two lines: `M = R * s[:, None, :]` multiplies
# column $j$ by $s_j$, and `M @ M.transpose(0, 2, 1)` is the covariance. The cell computes the three
# Gaussians of anchor 29 that are drawn. The eigenvalues of $\Sigma$ are the squared scales, and $r$
# and $-r$ give the same $\Sigma$.


# %%
from p4dgs_ref.equations.numerics import normalise, normalise_backward
from p4dgs_ref.splatting import covariance


def transposed(matrices):
    """Return the transposes of matrices [N, 3, 3]."""
    return matrices.transpose(0, 2, 1)


s = without.GAUSSIANS.s[without.OWN].astype(float)
r, _ = normalise(without.GAUSSIANS.r[without.OWN].astype(float))
N = len(s)
Sigma, saved = covariance.forward(s, r)
R = covariance.rotation_matrix(r)
M = R * s[:, None, :]
assert close(Sigma, M @ transposed(M))
assert close(np.linalg.eigvalsh(Sigma), np.sort(s**2, axis=1))
of_negative, _ = covariance.forward(-s, -r)
assert np.array_equal(of_negative, Sigma)
print(
    "the last one: s", s[-1].round(3), "turned by", round(2 * np.degrees(np.arccos(r[-1, 0]))), "°"
)

# %% [markdown]
# The last of the three is a disc: two sizes of 0.08 and one of 0.01 scene units. Without a rotation
# it would lie flat. Turned by 29° it lies on the ball, where the highlight is. The figure shows it
# as the camera of the pictures sees it, with the columns of $M$ as its three half axes.

# %%
around, up = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(-np.pi / 2, np.pi / 2, 13))
ball = np.stack([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
figure, panels = plt.subplots(
    1, 3, figsize=(10, 3.6), subplot_kw={"projection": "3d"}, layout="constrained"
)
shapes = 0.05 * np.eye(3), np.diag(s[-1]), M[-1]
for ax, name, shape in zip(panels, ("a ball", "stretched: $S$", "turned: $RS$"), shapes):
    ax.plot_wireframe(*np.tensordot(shape, ball, 1), color=thread.color, lw=0.5)
    for axis, color in zip(shape.T, figures.COLORS):
        ax.plot(*np.stack([0 * axis, axis], axis=1), color=color, lw=4)
    limits = dict.fromkeys(("xlim", "ylim", "zlim"), (-0.08, 0.08))
    ax.set(**limits, title=name, xlabel="x", ylabel="y", zlabel="z", box_aspect=(1, 1, 1))
    ax.locator_params(nbins=3)
    ax.view_init(26, 60)
figures.show(figure, "13_covariance_turned")

# %% [markdown]
# Where does the matrix come from? A quaternion rotates a vector $v$ by the product $r\,v\,r^*$,
# where $v$ is a quaternion with the real part zero and $r^* = (w, -x, -y, -z)$. If we multiply this
# out, and use $w^2+x^2+y^2+z^2 = 1$ on the diagonal, the coefficients of $v$ are the entries of
# $R$, which keeps lengths and handedness.


# %%
def product(p, q):
    """Return the product of two quaternions, real part first."""
    imaginary = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([p[0] * q[0] - p[1:] @ q[1:], *imaginary])


v = np.array([1.0, 2, 3])
for quaternion, matrix in zip(r, R):
    rotated = product(product(quaternion, np.array([0, *v])), quaternion * [1, -1, -1, -1])
    assert close(rotated, [0, *(matrix @ v)])
assert close(R @ transposed(R), np.tile(np.eye(3), (N, 1, 1)))
assert close(np.linalg.det(R), np.ones(N))

# %% [markdown]
# ## Backward by hand
# The forward has three steps, $r \to R \to M = RS \to \Sigma$, so the backward has three as well.
#
# **Step one**, with numbers: $\Sigma = m^2$ gives $d\Sigma = 2m\,dm$ and $\bar m = 2m\,\bar\Sigma$.
# The factor two is there because $m$ occurs twice. With $m = 3$ and $\bar\Sigma = 5$ this is 30.
#
# For matrices we need two rules about $\langle A, B\rangle = \sum_{ij} A_{ij}B_{ij}$, which says
# how a loss responds to a small change:
# $$\langle A,\; B\,C\rangle = \langle A\,C^T,\; B\rangle, \qquad
#   \langle A,\; B^T\rangle = \langle A^T,\; B\rangle.$$
# The first rule moves a factor to the other side, the second one moves a transpose. The matrix
# gradients of this tutorial and of `14_projection` need nothing else.

# %%
inner = lessons.inner
A = rng.normal(size=(3, 4))
B = rng.normal(size=(3, 5))
C = rng.normal(size=(5, 4))
assert close(inner(A, B @ C), inner(A @ C.T, B))

# %% [markdown]
# In $\Sigma = M M^T$ the differential has one term for each occurrence of $M$,
# $d\Sigma = dM\,M^T + M\,dM^T$. With the two rules, everything else moves away from $dM$:
# $$\langle\bar\Sigma, dM\,M^T\rangle = \langle\bar\Sigma M, dM\rangle,\quad
#   \langle\bar\Sigma, M\,dM^T\rangle = \langle\bar\Sigma^T, dM\,M^T\rangle
#   = \langle\bar\Sigma^T M, dM\rangle$$
# $$\Longrightarrow\quad \bar M = (\bar\Sigma + \bar\Sigma^T)\,M$$

# %%
Sigma_bar = rng.normal(size=(N, 3, 3))  # deliberately not symmetric
dM = rng.normal(size=(N, 3, 3))
dSigma = dM @ transposed(M) + M @ transposed(dM)
M_bar = (Sigma_bar + transposed(Sigma_bar)) @ M
assert close(inner(Sigma_bar, dSigma), inner(M_bar, dM))

# %% [markdown]
# **Step two** is $M_{ij} = R_{ij} s_j$, a product of numbers, so $\bar R_{ij} = \bar M_{ij}\,s_j$.
# The scale $s_j$ is used in the three rows $i$, so it receives three gradients:
# $\bar s_j = \sum_i \bar M_{ij} R_{ij}$.

# %%
h = 1e-6
ours = covariance.backward(saved, Sigma_bar)
s_bar = (M_bar * R).sum(axis=1)
R_bar = M_bar * s[:, None, :]
assert close(ours["s"], s_bar)
for j in range(3):
    move = h * np.eye(3)[j]
    up, _ = covariance.forward(s + move, r)
    down, _ = covariance.forward(s - move, r)
    change = Sigma_bar * (up - down) / (2 * h)
    assert close(change.sum(axis=(1, 2)), s_bar[:, j], 1e-6)

# %% [markdown]
# **Step three** goes from $\bar R$ to $\bar r$. In the plane, $w$ occurs in two entries of $R$ and
# $z$ in all four:
# $$dR = 2\begin{pmatrix} -2z\,dz & -z\,dw - w\,dz \\ z\,dw + w\,dz & -2z\,dz \end{pmatrix},$$
# $$\bar w = 2z\,(\bar R_{21}-\bar R_{12}), \qquad
#   \bar z = 2w\,(\bar R_{21}-\bar R_{12}) - 4z\,(\bar R_{11}+\bar R_{22}).$$

# %%
w, z = 0.8, 0.6
bar = rng.normal(size=(2, 2))
beside = bar[1, 0] - bar[0, 1]
diagonal = bar[0, 0] + bar[1, 1]
w_bar = 2 * z * beside
z_bar = 2 * w * beside - 4 * z * diagonal
along_w = flat_rotation(w + h, z) - flat_rotation(w - h, z)
along_z = flat_rotation(w, z + h) - flat_rotation(w, z - h)
assert close(inner(bar, along_w) / (2 * h), w_bar, 1e-8)
assert close(inner(bar, along_z) / (2 * h), z_bar, 1e-8)

# %% [markdown]
# In space this is the same work for four letters. Each entry of $R$ is a sum of products of two
# letters, so each slope is linear:
# $$\tfrac{\partial R}{\partial w} = 2\begin{pmatrix} 0&-z&y\\ z&0&-x\\ -y&x&0 \end{pmatrix},\quad
#   \tfrac{\partial R}{\partial x} = 2\begin{pmatrix} 0&y&z\\ y&-2x&-w\\ z&w&-2x \end{pmatrix},$$
# $$\tfrac{\partial R}{\partial y} = 2\begin{pmatrix} -2y&x&w\\ x&0&z\\ -w&z&-2y \end{pmatrix},\quad
#   \tfrac{\partial R}{\partial z} = 2\begin{pmatrix} -2z&-w&x\\ w&-2z&y\\ x&y&0 \end{pmatrix}.$$
# Because $R$ is quadratic in $r$, a central difference is exact for a step of *any* size. The cell
# uses steps of one.

# %%
w, x, y, z = r[0]
slopes = 2 * np.array(
    [
        [[0, -z, y], [z, 0, -x], [-y, x, 0]],
        [[0, y, z], [y, -2 * x, -w], [z, w, -2 * x]],
        [[-2 * y, x, w], [x, 0, z], [-w, z, -2 * y]],
        [[-2 * z, -w, x], [w, -2 * z, y], [x, y, 0]],
    ]
)
ahead = covariance.rotation_matrix(r[0] + np.eye(4))
behind = covariance.rotation_matrix(r[0] - np.eye(4))
assert close((ahead - behind) / 2, slopes)

# %% [markdown]
# Each component of $\bar r$ is the inner product of $\bar R$ and a slope. With the names $a, b, c$,
# $d, e, f$ and $g, h, i$ for the entries of $\bar R$, row by row,
# $$\bar w = 2\,[z(d-b) + y(c-g) + x(h-f)],\quad \bar x = 2\,[y(b+d)+z(c+g)+w(h-f)-2x(e+i)],$$
# $$\bar y = 2\,[x(b+d)+z(f+h)+w(c-g)-2y(a+i)],\quad \bar z = 2\,[x(c+g)+y(f+h)+w(d-b)-2z(a+e)].$$
# These four are the last lines of `covariance.backward`. The adjoint identity checks all three
# steps together.

# %%
by_slopes = [inner(R_bar[0], slope) for slope in slopes]
assert close(ours["r"][0], by_slopes)

d, difference = lessons.adjoint(rng, covariance.forward, {"s": s, "r": r}, Sigma_bar, ours, 1e-8)

# %% [markdown]
# One thing looks wrong but is not: $\bar r$ has a component along $r$, although only the direction
# of $r$ has a meaning. The reason is that $\bar r$ is the plain derivative of the matrix above,
# which is a rotation only for quaternions of length one. The normalisation before this step (choice
# `Q9`, in Eq. (6)) removes this component, because its backward is the projector of `02_view` with
# four axes.

# %%
unit, norm = normalise(2.5 * r)
raw_bar = normalise_backward(unit, norm, ours["r"])
along = np.abs((ours["r"] * r).sum(axis=1))
assert along.min() > 0.01 * np.abs(ours["r"]).max()
assert np.abs((raw_bar * r).sum(axis=1)).max() < 1e-14

# %% [markdown]
# Gradient descent shows that the gradients work together. The cell starts with a flat Gaussian that
# is not turned, and pulls it into the shape of the disc of anchor 29, with the loss
# $\frac12\|\Sigma - \Sigma^*\|^2$, whose $\bar\Sigma$ is $\Sigma - \Sigma^*$. The unit of length is
# 0.1 scene units. The Gaussian turns and stretches at the same time.

# %%
target = 100 * Sigma[-1:]
scale = np.array([[0.7, 0.7, 0.3]])
raw = np.array([[1.0, 0, 0, 0]])
shapes = []
losses = []
for step in range(150):
    unit, norm = normalise(raw)
    now, saved_now = covariance.forward(scale, unit)
    error = now - target
    shapes.append(now[0])
    losses.append((error**2).sum() / 2)
    gradients = covariance.backward(saved_now, error)
    scale = scale - 0.1 * gradients["s"]
    raw = raw - 0.1 * normalise_backward(unit, norm, gradients["r"])
print(f"loss: {losses[0]:.2e}, after {step} steps {losses[-1]:.2e}")
assert losses[-1] < 1e-3 * losses[0]

# %%
figure, panels = plt.subplots(1, 5, figsize=(13, 3), sharey=True, layout="constrained")
for ax, step in zip(panels, (0, 5, 10, 20, 149)):
    draw_ellipse(ax, target[0, ::2, ::2], fc="none", ec=thread.color, lw=3)
    draw_ellipse(ax, shapes[step][::2, ::2], fc="none", ec=show.GREY, lw=2, ls="--")
    ax.set(title=f"{step} steps", aspect="equal", xlim=(-1, 1), ylim=(-1, 1))
figures.show(
    figure,
    "13_covariance_descent",
    title=r"$\bar s$ and $\bar r$ turn and stretch a Gaussian (dashed), seen along y",
)

# %% [markdown]
# ## Break it
# Suppose we read the quaternion as $(x, y, z, w)$, as many libraries store it, or transpose the
# rotation, as happens between conventions of row and column vectors. The eigenvalues, the volume
# and the symmetry are still right: every ellipsoid has its size and shape, but it points in
# another direction. On the scene, the order of the quaternion costs 4.4 dB, the transpose 4.9 dB.
# Both are worse than no rotation at all, which costs 3.2 dB. The checker names the mistakes.


# %%
def real_part_last(s, r):
    return covariance.forward(s, r[:, [3, 0, 1, 2]])[0]


def of_transpose(s, r):
    return covariance.forward(s, r * [1, -1, -1, -1])[0]


assert close(np.linalg.eigvalsh(real_part_last(s, r)), np.linalg.eigvalsh(Sigma))
lessons.check_mistake(real_part_last, "covariance", "covariance-real-last")
lessons.check_mistake(of_transpose, "covariance", "covariance-transposed")

# %%
ORDER, TRANSPOSE = {"shape": real_part_last}, {"shape": of_transpose}
without.show_changes("13_covariance_mistakes", {"real part last": ORDER, "transposed": TRANSPOSE})

# %% [markdown]
# ## What a codec should round
# P-4DGS predicts $s$ and $r$, so its file contains neither. A codec that stores shapes should not
# round $\Sigma$ itself, because the rounded matrix may have a negative eigenvalue and then is no
# longer a covariance. A rounded $s$ and a rounded, normalised $r$ always give a covariance. The
# cell rounds the Gaussians of the scene both ways.

# %%
every = without.GAUSSIANS
whole, _ = covariance.forward(every.s.astype(float), every.r.astype(float))
rounded_r, _ = normalise(np.round(50 * every.r.astype(float)))
of_rounded, _ = covariance.forward(np.round(every.s.astype(float), 3), rounded_r)
lowest = np.linalg.eigvalsh([np.round(whole, 4), of_rounded])[:, :, 0]
invalid, still = (lowest < -1e-12).mean(axis=1)
print(f"invalid: {invalid:.0%} of the rounded Sigma, {still:.0%} of those of rounded s and r")
assert invalid > 0.1
assert still == 0

# %% [markdown]
# ## What this idea buys
# With three sizes and a rotation, the scene has 33.5 dB. Without the rotations it has 30.3 dB, and
# as balls 23.9 dB. These numbers say what a *renderer* loses that leaves a step out of a finished
# scene. A training that has only balls does better, because it makes them small and many: the
# authors of 3DGS trained three real scenes with one radius for each Gaussian, and lost 0.8 dB
# (26.05 to 25.23 dB, Table 3 of Kerbl et al. 2023). P-4DGS takes the shapes over from 3DGS and has
# no number of its own.

# %%
changes = {
    "as trained": NOTHING,
    "never turned": TURN,
    "balls": SIZES,
    "real part last": ORDER,
    "transposed": TRANSPOSE,
}
quality = {name: without.quality(**change) for name, change in changes.items()}
for name, dB in quality.items():
    print(f"{name:14s} {dB:.1f} dB")
assert np.allclose([*quality.values()], [33.48, 30.28, 23.89, 29.13, 28.56], atol=0.02)

# %% [markdown]
# **In short**
# - A Gaussian's shape is $\Sigma = M M^T$ with $M = RS$: three standard deviations and a rotation,
#   whose half axes are the columns of $M$.
# - Written in this way, $\Sigma$ cannot become invalid, whatever $s$ and $r$ are.
# - $\bar M$ gets one term for each of its two places, and $\bar r$ follows from slopes of $R$
#   that are linear in $r$.
#
# **Often misunderstood**
# - *The ellipsoid has an edge.* The rings are drawn at one standard deviation, and the Gaussian
#   goes on beyond: at two, it still has 14 % of its peak.
# - *The quaternion contains the angle.* It contains the sine and the cosine of half of it, and $r$
#   and $-r$ are the same rotation.
# - *Wrong rotations look wrong.* Every Gaussian keeps its size, and the picture is only somewhat
#   rough; a number or a known answer shows it.

# %% [markdown]
# ## Exercises
# **13.1** ● Compute $\Sigma$ `[3, 3]` of $r = (\frac12, \frac12, \frac12, \frac12)$ and
# $s = (1, 2, 3)$ by hand. Where does each axis go?
#
# **13.2** ●● The three axes share the logarithm of one scale, $s = (e^l, e^l, e^l)$. What changes
# in the gradient? For $e^l = \frac12$, the $r$ of 13.1 and $\bar\Sigma$ with the rows $(0, 1, 2)$,
# $(3, 4, 5)$ and $(6, 7, 8)$, give five numbers: $\bar l$, and the part of $\bar r$ that is
# perpendicular to $r$.
#
# **13.3** ●●● Write the backward of the covariance.
#
# **Predict, then run.** A quaternion $r$ is replaced by $-r$. What happens to $\Sigma$, and what
# to $\bar r$?

# %%
answer_1 = ...
answer_2 = ...


def my_backward(inputs, cotangents):
    """Return the gradients {"s" [N, 3], "r" [N, 4]} for inputs of these names and shapes.

    The real part of r stands first. cotangents["Sigma_bar"] has the shape [N, 3, 3] and need not be
    symmetric.
    """
    raise NotImplementedError


lessons.check_number("13.1", answer_1)
lessons.check_number("13.2", answer_2)
lessons.check_backward("13.3", my_backward, "covariance")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only covariance` compares what a port wrote. The golden $\bar\Sigma$
# is not symmetric, so a port that assumes symmetry and computes $2\bar\Sigma M$ fails. A port that
# projects $\bar r$ onto the sphere fails as well, because that is part of Eq. (6).

# %%
lessons.passes("covariance")

# %% [markdown]
# ## For ports
# $\Sigma$ contains *squares*, so it keeps half of the digits of $s$. Beside an axis of length 1, an
# axis of $10^{-9}$ has the square $10^{-18}$, which `float64` loses; `float32` loses axes below
# about $2\cdot 10^{-4}$. 36 of the scene's 760 Gaussians are thinner than that: one of their scales
# is 0. Training and rendering therefore never form $\Sigma$; `factored.py` keeps $s$ and $R$
# apart (`14_projection`).

# %%
thin, _ = covariance.forward(np.array([[1.0, 1, 1e-9]]), r[:1])
print(f"smallest eigenvalue {np.linalg.eigvalsh(thin)[0, 0]:.0e}, right is 1e-18")
assert not close(np.linalg.eigvalsh(thin)[0, 0], 1e-18, 0.5)
sizes = np.sort(every.s, axis=1)
assert np.sum(sizes[:, 0] < 2e-4 * sizes[:, 2]) == 36
