# %% [markdown]
# # Support: from a quaternion and three scales to a covariance, and back
#
# **Promise.** After this tutorial you can turn a quaternion into an ellipsoid by hand, and send a
# gradient of the ellipsoid back to the quaternion. **Before it:** `01_offsets`, `02_view`.
# **Takes** five seconds of machine time on two cores, 30 minutes of reading and 35 of exercises.
#
# **File:** [covariance.py](../p4dgs_ref/splatting/covariance.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures

plt = figures.pyplot()
architecture.show("13_covariance")
rng = np.random.default_rng(13)
turn = np.linspace(0, 2 * np.pi, 90)
circle = np.stack([np.cos(turn), np.sin(turn)])  # the figures bend it into ellipses

# %% [markdown]
# ## Claim
# Each Gaussian has three scales $s$ and a unit quaternion $r = (w, x, y, z)$, which describes a
# rotation. The renderer needs the covariance
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


for theta in np.linspace(-3, 3, 13):
    R = flat_rotation(np.cos(theta / 2), np.sin(theta / 2))
    expected = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
    assert close(R, expected)

quarter = flat_rotation(np.sqrt(0.5), np.sqrt(0.5))
M = quarter @ np.diag([3, 2])
assert close(M @ M.T, [[4, 0], [0, 9]])

# %% [markdown]
# The figure shows how $M = RS$ bends a circle into an ellipse. The columns of $M$ are its half
# axes. Since $v^T\Sigma v = |M^Tv|^2$, no direction $v$ has a negative variance, whatever the
# networks predict. If they predicted the entries of $\Sigma$ one by one, this could happen.

# %%
figure, panels = plt.subplots(
    1,
    4,
    figsize=(13, 4.4),
    sharey=True,
    layout="constrained",
)
for ax, degrees in zip(panels, (0, 30, 60, 90)):
    half = np.radians(degrees) / 2
    w, z = np.cos(half), np.sin(half)
    M = flat_rotation(w, z) @ np.diag([3, 1])
    ax.fill(*(M @ circle), color=figures.COLORS[5], alpha=0.35)
    for j in range(2):
        color = figures.COLORS[j]
        arrow = {"arrowstyle": "-|>", "lw": 3, "color": color}
        ax.annotate("", M[:, j], (0, 0), arrowprops=arrow)
    (a, b), (_, c) = M @ M.T
    quaternion = f"{degrees}°: w = {w:.3f}, z = {z:.3f}"
    ax.set(
        title=f"{quaternion}\na = {a:.1f}, b = {b:.1f}, c = {c:.1f}",
        xlabel="x (scene units)",
        aspect="equal",
        xlim=(-3.4, 3.4),
        ylim=(-3.4, 3.4),
    )
panels[0].set_ylabel("y (scene units)")
for j, height in enumerate((-2.4, 1.4)):
    column = f"column {j + 1} of RS,\nlength $s_{j + 1}$"
    panels[0].text(-2.8, height, column, color=figures.COLORS[j])
figures.show(
    figure,
    "13_covariance",
    title=r"The quaternion contains half the angle; $\Sigma$ = [[a, b], [b, c]] contains b twice",
)

# %% [markdown]
# ## In code
# `s [N, 3]` and `r [N, 4]` give `Sigma [N, 3, 3]` in two lines: `M = R * s[:, None, :]` multiplies
# column $j$ by $s_j$, and `M @ M.transpose(0, 2, 1)` is the covariance. The eigenvalues of $\Sigma$
# are the squared scales, and $r$ and $-r$ give the same $\Sigma$.


# %%
from p4dgs_ref.equations.numerics import normalise, normalise_backward
from p4dgs_ref.splatting import covariance


def transposed(matrices):
    """Return the transposes of matrices [N, 3, 3]."""
    return matrices.transpose(0, 2, 1)


N = 7
s = rng.lognormal(-1, 0.7, size=(N, 3))
r, _ = normalise(rng.normal(size=(N, 4)))
Sigma, saved = covariance.forward(s, r)
R = covariance.rotation_matrix(r)
M = R * s[:, None, :]
assert close(Sigma, M @ transposed(M))
eigenvalues = np.linalg.eigvalsh(Sigma)
assert close(eigenvalues, np.sort(s**2, axis=1))
of_negative, _ = covariance.forward(-s, -r)
assert np.array_equal(of_negative, Sigma)

# %% [markdown]
# Where does the matrix come from? A quaternion rotates a vector $v$ by the product $r\,v\,r^*$,
# where $v$ is a quaternion with the real part zero and $r^* = (w, -x, -y, -z)$. If we multiply this
# out, and use $w^2+x^2+y^2+z^2 = 1$ on the diagonal, the coefficients of $v$ are the entries of
# $R$.


# %%
def product(p, q):
    """Return the product of two quaternions, real part first."""
    w, v = p[0], p[1:]
    w_q, v_q = q[0], q[1:]
    real = w * w_q - v @ v_q
    imaginary = w * v_q + w_q * v + np.cross(v, v_q)
    return np.array([real, *imaginary])


for quaternion, matrix in zip(r, R):
    v = rng.normal(size=3)
    conjugate = quaternion * [1, -1, -1, -1]
    left = product(quaternion, np.array([0, *v]))
    rotated = product(left, conjugate)
    assert close(rotated, [0, *(matrix @ v)])
    assert close(matrix @ matrix.T, np.eye(3))
    assert close(np.linalg.det(matrix), 1)

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
assert np.abs((ours["r"] * r).sum(axis=1)).min() > 1e-3
assert np.abs((raw_bar * r).sum(axis=1)).max() < 1e-14

# %% [markdown]
# Gradient descent shows that the gradients work together. The cell pulls a Gaussian into the shape
# of another one with the loss $\frac12\|\Sigma - \Sigma^*\|^2$, whose $\bar\Sigma$ is
# $\Sigma - \Sigma^*$. The Gaussian rotates and stretches at the same time.


# %%
def about_z(degrees):
    """Return the quaternion [1, 4] of a rotation about the z axis."""
    half = np.radians(degrees) / 2
    return np.array([[np.cos(half), 0, 0, np.sin(half)]])


target, _ = covariance.forward(np.array([[1.6, 0.5, 0.4]]), about_z(70))
scale = np.array([[1.0, 0.6, 0.4]])
raw = about_z(10)
shapes = []
losses = []
for step in range(150):
    unit, norm = normalise(raw)
    now, saved = covariance.forward(scale, unit)
    error = now - target
    shapes.append(now[0, :2, :2])
    losses.append((error**2).sum() / 2)
    gradients = covariance.backward(saved, error)
    scale = scale - 0.02 * gradients["s"]
    raw = raw - 0.04 * normalise_backward(unit, norm, gradients["r"])
assert losses[-1] < 1e-5 * losses[0]
assert close(scale, [[1.6, 0.5, 0.4]], 0.01)


# %%
def outline(Sigma):
    """Return the one-sigma ellipse of a covariance [2, 2]."""
    return np.linalg.cholesky(Sigma) @ circle


figure, (left, right) = plt.subplots(
    1,
    2,
    figsize=(12, 5),
    layout="constrained",
)
left.plot(
    *outline(target[0, :2, :2]),
    "k--",
    lw=3,
    label="target",
)
for step, color in zip((0, 5, 8, 12, 149), figures.COLORS):
    left.plot(*outline(shapes[step]), color=color)
    right.semilogy(
        step,
        losses[step],
        "o",
        ms=10,
        color=color,
    )
    right.text(step + 4, losses[step], f"after {step} steps", color=color, va="center")
figures.finish(
    left,
    xlabel="x (scene units)",
    ylabel="y (scene units)",
    aspect="equal",
    title="The Gaussian, seen along z (1 sigma)",
)
figures.label(left, (-0.2, 0))
right.semilogy(losses, color="0.4", zorder=0)
right.set(
    xlim=(-6, 205),
    xlabel="steps of gradient descent",
    ylabel="scene units$^4$",
    title=r"The loss $\frac{1}{2}\|\Sigma-\Sigma^*\|^2$",
)
figures.show(
    figure,
    "13_covariance_descent",
    title=r"$\bar s$ and $\bar r$ rotate and stretch one Gaussian into another",
)

# %% [markdown]
# ## Break it
# Suppose we read the quaternion as $(x, y, z, w)$, as many libraries store it. The eigenvalues, the
# volume and the symmetry are still right: every ellipsoid has its size and shape, but it points in
# another direction. Only a known answer reveals this, and the checker names the mistake.


# %%
def real_part_last(s, r):
    Sigma, _ = covariance.forward(s, r[:, [3, 0, 1, 2]])
    return Sigma


wrong = np.linalg.eigvalsh(real_part_last(s, r))
assert close(wrong, np.linalg.eigvalsh(Sigma))
lessons.check_mistake(real_part_last, "covariance", "covariance-real-last")

# %% [markdown]
# Another mistake is to count only one of the two factors $M$ in the backward. Each gradient is then
# half of what it should be. Its direction is right, so gradient descent still works. The adjoint
# identity shows the missing factor.

# %%
one_factor = {name: gradient / 2 for name, gradient in ours.items()}
print(
    f"with one factor, the gradient explains {inner(one_factor, d) / difference:.0%} of the change"
)
assert not close(inner(one_factor, d), difference, 0.1)

# %% [markdown]
# ## What a codec does with it
# P-4DGS predicts $s$ and $r$, so its file contains neither. A codec that stores shapes should not
# round $\Sigma$ itself, because the rounded matrix may have a negative eigenvalue and then is not a
# covariance any more. A rounded $s$ and a rounded, normalised $r$ always give a covariance.

# %%
many_s = np.exp(rng.uniform(-4, 0, (2000, 3)))
many_r, _ = normalise(rng.normal(size=(2000, 4)))


def on_grid(a):
    """Round to multiples of 0.02."""
    return np.round(a / 0.02) * 0.02


def share_of_invalid(Sigma):
    """Return the share of matrices with a negative eigenvalue."""
    return (np.linalg.eigvalsh(Sigma)[:, 0] < -1e-12).mean()


exact, _ = covariance.forward(many_s, many_r)
rounded_r, _ = normalise(on_grid(many_r))
of_rounded, _ = covariance.forward(on_grid(many_s), rounded_r)
print(f"invalid: {share_of_invalid(on_grid(exact)):.0%} of the rounded Sigma")
assert share_of_invalid(on_grid(exact)) > 0.1
assert share_of_invalid(of_rounded) == 0

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
