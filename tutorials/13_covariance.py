# %% [markdown]
# # Support: from a quaternion and three scales to a covariance, and back
#
# **Promise.** After this you can turn a quaternion into an ellipsoid by hand, and send a gradient of the ellipsoid back to it.
# **Before it:** `01_offsets`, `02_view`. **Takes** five seconds of machine time on two cores, forty minutes of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.equations.rotation import normalise, normalise_backward
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import covariance

plt = lessons.pyplot()
ellipse = (
    np.exp(1j * np.linspace(0, 2 * np.pi, 90)).view(float).reshape(-1, 2).T
)  # a unit circle, to be bent

# %% [markdown]
# ## Claim
# Each Gaussian has three scales $s$ and a unit quaternion $r = (w, x, y, z)$, which stands for a turn. The renderer wants
# $$\Sigma = R\,S\,S^T R^T, \qquad S = \mathrm{diag}(s).$$
# The paper does not print this covariance; it is that of Gaussian splatting. What comes in are $s'$ and $r'$ of Eq. (6).

# %% [markdown]
# The matrix of a unit quaternion is
# $$R = \begin{pmatrix} 1-2(y^2+z^2) & 2(xy-wz) & 2(xz+wy) \\ 2(xy+wz) & 1-2(x^2+z^2) & 2(yz-wx) \\
#   2(xz-wy) & 2(yz+wx) & 1-2(x^2+y^2) \end{pmatrix}.$$

# %% [markdown]
# ## By hand
# Stay in the plane first: $x = y = 0$ leaves $R$ with $1-2z^2$ on the diagonal and $\mp 2wz$ beside it. A turn by the angle
# $\theta$ is $w = \cos\frac\theta2$, $z = \sin\frac\theta2$: *half* the angle, since $1-2\sin^2\frac\theta2 = \cos\theta$ and
# $2\sin\frac\theta2\cos\frac\theta2 = \sin\theta$.

# %%
for theta in np.linspace(-3, 3, 13):
    w, z = np.cos(theta / 2), np.sin(theta / 2)
    plane = np.array([[1 - 2 * z * z, -2 * w * z], [2 * w * z, 1 - 2 * z * z]])
    assert np.allclose(
        plane, [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]], atol=1e-15
    )

# %% [markdown]
# A quarter turn, $w = z = \sqrt{1/2}$: the diagonal is 0, beside it stand -1 and 1. The x axis becomes the y axis.
# With scales 3 and 2 the matrix $S S^T$ holds 9 and 4. Turned, it holds 4 and 9: the long axis now points along y.

# %%
w = z = np.sqrt(0.5)
R = np.array([[1 - 2 * z * z, -2 * w * z], [2 * w * z, 1 - 2 * z * z]])
S = np.diag([3, 2])
assert (
    np.allclose(R, [[0, -1], [1, 0]], atol=1e-15)
    and S.diagonal().tolist() == [3, 2]
    and (S @ S).tolist() == [[9, 0], [0, 4]]
)
assert np.allclose(R @ S @ S @ R.T, [[4, 0], [0, 9]], atol=1e-14)

# %% [markdown]
# What the picture shows: $M = RS$ bends a circle into the ellipse; its columns are the half axes. As $v^T\Sigma v = |M^Tv|^2$,
# no direction $v$ has a negative variance, whatever the networks say. Predicted one by one, entries of $\Sigma$ could have.

# %%
figure, panels = plt.subplots(1, 4, figsize=(13, 5), sharey=True, layout="constrained")
for ax, degrees in zip(panels, (0, 30, 60, 90)):
    w, z = np.cos(np.radians(degrees) / 2), np.sin(np.radians(degrees) / 2)
    M = np.array([[1 - 2 * z * z, -2 * w * z], [2 * w * z, 1 - 2 * z * z]]) * [
        3,
        1,
    ]  # R S: column j times s_j
    ax.fill(*(M @ ellipse), color=lessons.COLORS[5], alpha=0.35)
    for j, name in enumerate(("$s_1$", "$s_2$")):
        ax.annotate(
            "", M[:, j], (0, 0), arrowprops=dict(arrowstyle="-|>", lw=3, color=lessons.COLORS[j])
        )
        ax.plot([], [], color=lessons.COLORS[j], label=f"column {j + 1} of RS, length {name}")
    (a, b), (_, c) = M @ M.T
    ax.set(
        title=f"{degrees}°: w = {w:.3f}, z = {z:.3f}\na = {a:.1f}, b = {b:.1f}, c = {c:.1f}",
        xlabel="x (scene units)",
        aspect="equal",
        xlim=(-3.4, 3.4),
        ylim=(-3.4, 3.4),
    )
panels[0].set_ylabel("y (scene units)")
figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
figure.suptitle(
    r"Half the angle goes into the quaternion; $\Sigma$ = [[a, b], [b, c]] holds b twice",
    fontsize=16,
)
lessons.show(figure, "13_covariance")

# %% [markdown]
# ## In code
# `s (N, 3)` and `r (N, 4)` give `Sigma (N, 3, 3)` in two lines: `M = R * s[:, None, :]` scales column $j$ by $s_j$, and
# `M @ M.transpose(0, 2, 1)`. The eigenvalues of $\Sigma$ are the squared scales; $r$ and $-r$ give the same $\Sigma$.

# %%
rng = np.random.default_rng(13)
N = 7
s, r = rng.lognormal(-1, 0.7, size=(N, 3)), rng.normal(size=(N, 4))
r /= np.linalg.norm(r, axis=1, keepdims=True)
out, res = covariance.forward(s, r)
R, M = covariance.rotation_matrix(r), covariance.rotation_matrix(r) * s[:, None, :]
assert out.Sigma.shape == (N, 3, 3) and np.array_equal(out.Sigma, M @ M.transpose(0, 2, 1))
assert np.allclose(np.linalg.eigvalsh(out.Sigma), np.sort(s**2, axis=1), rtol=1e-12)
assert np.array_equal(covariance.forward(-s, -r)[0].Sigma, out.Sigma)

# %% [markdown]
# Where does the printed matrix come from? A quaternion turns a vector $v$ by the product $r\,v\,r^*$, where $v$ has real part
# zero and $r^* = (w, -x, -y, -z)$. Multiply it out (`product`), use $w^2+x^2+y^2+z^2 = 1$ on the diagonal, read off the matrix.


# %%
def product(p, q):
    """Of quaternions (4,): real part first."""
    real = p[0] * q[0] - p[1:] @ q[1:]
    return np.array([real, *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


star = np.array([1, -1, -1, -1])
for quaternion, matrix in zip(r, R):
    v = rng.normal(size=3)
    turned = product(product(quaternion, np.array([0, *v])), quaternion * star)
    assert np.allclose(turned, [0, *(matrix @ v)], atol=1e-14)
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-14) and np.isclose(
        np.linalg.det(matrix), 1
    )

# %% [markdown]
# ## Backward by hand
# Three steps forward, $r \to R \to M = RS \to \Sigma$, so three steps back. **Step one**, as scalars: $\Sigma = m^2$ gives
# $d\Sigma = 2m\,dm$ and $\bar m = 2m\,\bar\Sigma$. The two is there because $m$ occurs twice. With $m = 3$, $\bar\Sigma = 5$: 30.

# %%
m, Sigma_bar, h = 3, 5, 1e-6
m_bar = 2 * m * Sigma_bar
assert m_bar == 30 and abs(Sigma_bar * ((m + h) ** 2 - (m - h) ** 2) / (2 * h) - 30) < 1e-6

# %% [markdown]
# As matrices we need two rules for $\langle A, B\rangle = \sum_{ij} A_{ij}B_{ij}$, the way a loss answers a small change:
# $$\langle A,\; B\,C\rangle = \langle A\,C^T,\; B\rangle, \qquad \langle A,\; B^T\rangle = \langle A^T,\; B\rangle.$$
# The first moves a factor to the other side, the second a transpose. Matrix gradients here and in `14_projection` need no more.

# %%
A, B, C = rng.normal(size=(3, 4)), rng.normal(size=(3, 5)), rng.normal(size=(5, 4))
inner = lambda a, b: (a * b).sum()
assert np.isclose(inner(A, B @ C), inner(A @ C.T, B), rtol=1e-12) and np.isclose(
    inner(A.T, C.T @ B.T), inner(A, B @ C)
)

# %% [markdown]
# Now $d\Sigma = dM\,M^T + M\,dM^T$, one term for each place of $M$. Move everything away from $dM$:
# $$\langle\bar\Sigma, dM\,M^T\rangle = \langle\bar\Sigma M, dM\rangle,\quad
#   \langle\bar\Sigma, M\,dM^T\rangle = \langle\bar\Sigma^T, dM\,M^T\rangle = \langle\bar\Sigma^T M, dM\rangle$$
# $$\Longrightarrow\quad \bar M = (\bar\Sigma + \bar\Sigma^T)\,M$$

# %%
Sigma_bar, dM = (
    rng.normal(size=(N, 3, 3)),
    rng.normal(size=(N, 3, 3)),
)  # Sigma_bar: not symmetric, on purpose
assert np.isclose(inner(Sigma_bar, dM @ M.transpose(0, 2, 1)), inner(Sigma_bar @ M, dM), rtol=1e-12)
assert np.isclose(
    inner(Sigma_bar, M @ dM.transpose(0, 2, 1)),
    inner(Sigma_bar.transpose(0, 2, 1) @ M, dM),
    rtol=1e-12,
)
M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ M  # the first line of covariance.backward

# %% [markdown]
# **Step two**, $M_{ij} = R_{ij} s_j$. A product of numbers, so $\bar R_{ij} = \bar M_{ij}\,s_j$. But $s_j$ serves three rows $i$:
# what is used three times collects three gradients, $\bar s_j = \sum_i \bar M_{ij} R_{ij}$. Two more lines of the code.

# %%
s_bar = (M_bar * R).sum(axis=1)
R_bar = M_bar * s[:, None, :]
ours = covariance.backward(res, Sigma_bar)
assert np.array_equal(ours["s"], s_bar)
for j in range(3):
    up, down = (covariance.forward(s + sign * h * np.eye(3)[j], r)[0].Sigma for sign in (1, -1))
    assert np.allclose(
        (Sigma_bar * (up - down)).sum(axis=(1, 2)) / (2 * h), s_bar[:, j], rtol=1e-6, atol=1e-8
    )

# %% [markdown]
# **Step three**, from $\bar R$ to $\bar r$. In the plane first. There $w$ stands in two entries and $z$ in all four:
# $$dR = 2\begin{pmatrix} -2z\,dz & -z\,dw - w\,dz \\ z\,dw + w\,dz & -2z\,dz \end{pmatrix},$$
# $$\bar w = 2z\,(\bar R_{21}-\bar R_{12}), \qquad \bar z = 2w\,(\bar R_{21}-\bar R_{12}) - 4z\,(\bar R_{11}+\bar R_{22}).$$

# %%
flat = lambda w, z: np.array([[1 - 2 * z * z, -2 * w * z], [2 * w * z, 1 - 2 * z * z]])
w, z, bar = 0.8, 0.6, rng.normal(size=(2, 2))
w_bar, z_bar = (
    2 * z * (bar[1, 0] - bar[0, 1]),
    2 * w * (bar[1, 0] - bar[0, 1]) - 4 * z * (bar[0, 0] + bar[1, 1]),
)
assert np.isclose(inner(bar, flat(w + h, z) - flat(w - h, z)) / (2 * h), w_bar, rtol=1e-8)
assert np.isclose(inner(bar, flat(w, z + h) - flat(w, z - h)) / (2 * h), z_bar, rtol=1e-8)

# %% [markdown]
# In space it is the same work four times. Each entry of $R$ is a sum of products of two letters, so each slope is linear:
# $$\tfrac{\partial R}{\partial w} = 2\begin{pmatrix} 0&-z&y\\ z&0&-x\\ -y&x&0 \end{pmatrix},\quad
#   \tfrac{\partial R}{\partial x} = 2\begin{pmatrix} 0&y&z\\ y&-2x&-w\\ z&w&-2x \end{pmatrix},$$

# %% [markdown]
# $$\tfrac{\partial R}{\partial y} = 2\begin{pmatrix} -2y&x&w\\ x&0&z\\ -w&z&-2y \end{pmatrix},\quad
#   \tfrac{\partial R}{\partial z} = 2\begin{pmatrix} -2z&-w&x\\ w&-2z&y\\ x&y&0 \end{pmatrix}.$$
# Since $R$ is quadratic in $r$, a central difference over *any* step is exact. We take steps of one.

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
for letter, slope in zip(np.eye(4), slopes):
    difference = covariance.rotation_matrix((r[0] + letter)[None]) - covariance.rotation_matrix(
        (r[0] - letter)[None]
    )
    assert np.allclose(difference[0] / 2, slope, atol=1e-14)

# %% [markdown]
# Each component of $\bar r$ is $\langle\bar R, \text{slope}\rangle$. Name the entries of $\bar R$ row by row $abc$, $def$, $ghi$:
# $$\bar w = 2\,[z(d-b) + y(c-g) + x(h-f)],\quad \bar x = 2\,[y(b+d)+z(c+g)+w(h-f)-2x(e+i)],$$
# $$\bar y = 2\,[x(b+d)+z(f+h)+w(c-g)-2y(a+i)],\quad \bar z = 2\,[x(c+g)+y(f+h)+w(d-b)-2z(a+e)].$$
# These four are the last lines of `covariance.backward`.

# %%
assert np.allclose(ours["r"][0], [inner(R_bar[0], slope) for slope in slopes], rtol=1e-12)
d = {"s": rng.normal(size=s.shape), "r": rng.normal(size=r.shape)}
up, down = (
    covariance.forward(s + sign * h * d["s"], r + sign * h * d["r"])[0].Sigma for sign in (1, -1)
)
difference, gradient = (
    inner(Sigma_bar, up - down) / (2 * h),
    inner(ours["s"], d["s"]) + inner(ours["r"], d["r"]),
)
assert abs(difference - gradient) < 1e-8 * abs(gradient)  # the adjoint identity, all together
print(f"by differences {difference:.9f}, by gradient {gradient:.9f}")

# %% [markdown]
# One thing looks wrong and is not. $\bar r$ has a part along $r$, though only the direction of $r$ means anything. It is the
# plain derivative of the printed matrix, which is a rotation on the unit sphere only. The normalisation before this step
# (choice Q9, in our Eq. (6)) takes that part away: its backward is the projector of `02_view`, with four axes.

# %%
unit, norm = normalise(2.5 * r)
raw_bar = normalise_backward(unit, norm, ours["r"])
assert np.abs((ours["r"] * r).sum(axis=1)).min() > 1e-3  # r_bar has a part along r
assert np.abs((raw_bar * r).sum(axis=1)).max() < 1e-14  # what goes on backward has none

# %% [markdown]
# A gradient proves itself in a descent. We pull a Gaussian into the shape of another one by following $-\bar s$ and $-\bar r$ of
# the loss $\frac12\|\Sigma - \Sigma^*\|^2$, whose $\bar\Sigma$ is $\Sigma - \Sigma^*$. It turns and stretches at once.

# %%
turn = lambda degrees: np.array(
    [[np.cos(np.radians(degrees) / 2), 0, 0, np.sin(np.radians(degrees) / 2)]]
)
target = covariance.forward(np.array([[1.6, 0.5, 0.4]]), turn(70))[0].Sigma
scale, raw, path, losses = np.array([[1.0, 0.6, 0.4]]), turn(10), [], []
for step in range(150):
    unit, norm = normalise(raw)
    now, residual = covariance.forward(scale, unit)
    path, losses = path + [residual.M[0, :2, :2]], losses + [((now.Sigma - target) ** 2).sum() / 2]
    bars = covariance.backward(residual, now.Sigma - target)
    scale, raw = scale - 0.02 * bars["s"], raw - 0.04 * normalise_backward(unit, norm, bars["r"])
assert losses[-1] < 1e-5 * losses[0] and np.allclose(scale, [[1.6, 0.5, 0.4]], atol=1e-2)
figure, (ax, curve) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
ax.plot(*(np.linalg.cholesky(target[0, :2, :2]) @ ellipse), "k--", lw=3, label="target")
for step, color in zip((0, 5, 8, 12, 149), lessons.COLORS):
    ax.plot(*(path[step] @ ellipse), color=color, label=f"after {step} steps")
    curve.plot(step, losses[step], "o", ms=10, color=color)
curve.plot(losses, color="0.4", zorder=0)
curve.set(
    yscale="log",
    xlabel="steps of descent",
    title=r"The loss $\frac{1}{2}\|\Sigma-\Sigma^*\|^2$",
    ylabel="scene units$^4$",
)
ax.set(
    xlabel="x (scene units)",
    ylabel="y (scene units)",
    aspect="equal",
    title="The Gaussian, seen along z, at one sigma",
)
ax.legend(fontsize=11, loc="center left", bbox_to_anchor=(1, 0.5))
figure.suptitle(r"$\bar s$ and $\bar r$ turn and stretch a Gaussian into another", fontsize=16)
lessons.show(figure, "13_covariance_descent")

# %% [markdown]
# ## Break it
# Read the quaternion as $(x, y, z, w)$, as many libraries store it. Eigenvalues, volume and symmetry are still right:
# every ellipsoid has its size and shape, and points elsewhere. Only a known answer catches it; the checker names it.

# %%
wrong = lambda s, r: covariance.forward(s, r[:, [3, 0, 1, 2]])[0].Sigma
assert np.allclose(np.linalg.eigvalsh(wrong(s, r)), np.linalg.eigvalsh(out.Sigma), rtol=1e-12)
verdict = oracle.check(wrong, "covariance")
assert not verdict.ok and "covariance-real-last" in verdict.first.explanation
print(verdict.first.explanation)

# %% [markdown]
# And in the backward: count one of the two factors $M$. Each gradient is half of what it should be, so all directions are right
# and a descent still goes down. The adjoint identity sees it: 50 percent.

# %%
halved = inner(ours["s"] / 2, d["s"]) + inner(ours["r"] / 2, d["r"])
assert round(100 * halved / difference) == 50

# %% [markdown]
# ## What a codec does with it
# P-4DGS predicts $s$ and $r$ and codes neither. A codec that does store shapes had better not round $\Sigma$: on a grid it need
# not be a covariance any more, while a rounded $s$ and a normalised rounded $r$ always give one.

# %%
s_flat, r_many = np.exp(rng.uniform(-4, 0, (2000, 3))), normalise(rng.normal(size=(2000, 4)))[0]
onto_grid = lambda a: np.round(a / 0.02) * 0.02
rounded = onto_grid(covariance.forward(s_flat, r_many)[0].Sigma)
parts = covariance.forward(onto_grid(s_flat), normalise(onto_grid(r_many))[0])[0].Sigma
broken = [
    (np.linalg.eigvalsh(covariances)[:, 0] < -1e-12).mean() for covariances in (rounded, parts)
]
assert broken[0] > 0.1 and broken[1] == 0
print(
    f"no covariance any more: {100 * broken[0]:.0f} % of the rounded Sigma, {100 * broken[1]:.0f} % from rounded s and r"
)

# %% [markdown]
# ## Exercises
# **13.1** $\Sigma$ `(3, 3)` of $r = (\frac12, \frac12, \frac12, \frac12)$, $s = (1, 2, 3)$, by hand: where does each axis go?
# **13.2** Write the forward. **13.3** Write its backward. Replace the dots and the `raise` lines and run the cell.

# %%
answer_1 = ...


def my_forward(s, r):
    """s (N, 3), r (N, 4) of unit length, real part first -> Sigma (N, 3, 3)."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"s", "r"}: gradients, from cotangents["Sigma_bar"] (N, 3, 3), which need not be symmetric."""
    raise NotImplementedError


lessons.number(
    "13.1", answer_1, covariance.forward(np.array([[1.0, 2, 3]]), np.full((1, 4), 0.5))[0].Sigma[0]
)
lessons.forward("13.2", my_forward, "covariance")
lessons.backward("13.3", my_backward, "covariance")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only covariance` reads what a port wrote. The vectors' $\bar\Sigma$ is not symmetric: a port
# that takes it to be, and writes $2\bar\Sigma M$, fails. So does one that projects $\bar r$ on the sphere: that is Eq. (6).

# %%
port = lambda s, r: np.einsum(
    "nij,nj,nkj->nik", covariance.rotation_matrix(r), s**2, covariance.rotation_matrix(r)
)
verdict = oracle.check(port, "covariance")
print(verdict)
assert verdict.ok and EQUATIONS["covariance"].module == "p4dgs_ref.splatting.covariance"
