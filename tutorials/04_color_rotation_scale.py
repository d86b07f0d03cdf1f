# %% [markdown]
# # Eq. (3) for colour and rotation, Eq. (4) for scale
#
# **Promise.** After this you can take a gradient through a sigmoid, a shared factor and a normalised quaternion.
# **Before it:** `02_view`, `03_opacity_and_masking`. **Takes** two seconds of machine time on two cores, half an hour of yours.

# %%
import numpy as np
from matplotlib.patches import Ellipse

from p4dgs_ref import EQUATIONS
from p4dgs_ref.equations import color, mlp, opacity, rotation, scale
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import covariance

plt = lessons.pyplot()
rng = np.random.default_rng(4)

# %% [markdown]
# ## Claim
# Colour and rotation are "predicted analogously" to the opacity of Eq. (3). For the scale the network's output is "a residual
# scaling factor relative to the anchor scale":
# $$\{s_0,\dots,s_{k-1}\} = s_a \cdot \mathrm{sigmoid}\bigl(\psi_s(f_a, \delta_{vc}, d_{vc})\bigr) \tag{4}$$

# %% [markdown]
# The paper prints no activation for the other two; those of Scaffold-GS are $c_j = \mathrm{sigmoid}(\psi_c)_j$ and
# $r_j = \psi_{r,j} / \|\psi_{r,j}\|_2$, a unit *quaternion*: four numbers $(w, x, y, z)$ of length one that name a rotation. The
# real part $w$ is the cosine of half the angle, $(x, y, z)$ points along the axis; `13_covariance` needs the details. This is
# choice `Q4`.

# %% [markdown]
# ## By hand
# The sigmoid $1/(1+e^{-\psi})$ of $0$, $\ln 3$ and $-\ln 3$ is 0.5, 0.75 and 0.25. With $s_a = (2, 1, 0.5)$ the child's scale is
# 1, 0.75 and 0.125. The quaternion $(1, 2, 2, 4)$ has length 5, so the rotation is 0.2, 0.4, 0.4, 0.8.

# %%
psi = np.array([0, np.log(3), -np.log(3)])
fraction = 1 / (1 + np.exp(-psi))
s_a = np.array([2, 1, 0.5])
y = np.array([1.0, 2, 2, 4])
length = np.sqrt((y * y).sum())
assert np.allclose(fraction, [0.5, 0.75, 0.25], rtol=1e-15) and np.allclose(
    s_a * fraction, [1, 0.75, 0.125], rtol=1e-15
)
assert length == 5 and (y / length).tolist() == [0.2, 0.4, 0.4, 0.8]

# %% [markdown]
# ## In code
# A network's last layer is `(A, 3k)` or `(A, 4k)` wide. `reshape(A, k, 3)` reads it child by child: the first three columns
# are the first child's. The anchor's `s_a (A, 3)` gets an axis of length one and serves all children.

# %%
seen = np.zeros((1, 0)), np.zeros((1, 0))  # no view: the feature is the whole input
both = np.concatenate([psi, psi[::-1]])[None]  # two children; the network is the identity
network = [np.eye(6)], [np.zeros(6)]
assert np.allclose(
    color.forward(both, *seen, *network)[0].color, [[fraction, fraction[::-1]]], rtol=1e-15
)
assert np.allclose(
    scale.forward(s_a[None], both, *seen, *network)[0].s,
    [[s_a * fraction, s_a * fraction[::-1]]],
    rtol=1e-15,
)
assert np.allclose(
    rotation.forward(y[None], *seen, [np.eye(4)], [np.zeros(4)])[0].r, [[y / 5]], rtol=1e-15
)

# %% [markdown]
# What an anchor looks like then, with random networks. The grey ellipse is the anchor's own scale, unturned. Its children have
# colours, turns and scales of their own, but along no axis of theirs more than the anchor's: a sigmoid stays below one.

# %%
A, k = 3, 5
inputs = opacity.view_inputs(rng, A=A, d=6, k=k, outputs=4, hidden=(12, 12))
views = {name: inputs[name] for name in ("f_a", "delta_vc", "d_vc")}
nets = {n: opacity.view_inputs(rng, A=A, d=6, k=k, outputs=n, hidden=(12, 12)) for n in (3, 4)}
colors = color.forward(
    **views, weights=[W * 1.6 for W in nets[3]["weights"]], biases=nets[3]["biases"]
)[0].color
turns = rotation.forward(**views, weights=nets[4]["weights"], biases=nets[4]["biases"])[0].r
own = np.array([[1.0, 0.35, 0.3], [0.4, 0.8, 0.3], [0.7, 0.7, 0.2]])
sizes = scale.forward(
    own, **views, weights=[W * 1.2 for W in nets[3]["weights"]], biases=nets[3]["biases"]
)[0].s
assert (sizes < own[:, None]).all() and (sizes > 0).all()


def outline(ax, place, s, r, **style):
    """The one-sigma ellipse of a Gaussian seen along z."""
    flat = covariance.forward(s[None], r[None])[0].Sigma[0, :2, :2]
    long_short, axes_of = np.linalg.eigh(flat)
    ax.add_patch(
        Ellipse(
            place,
            *2 * np.sqrt(long_short),
            angle=np.degrees(np.arctan2(axes_of[1, 0], axes_of[0, 0])),
            **style,
        )
    )


figure, axes = plt.subplots(1, 3, figsize=(12, 4.8), sharey=True, layout="constrained")
for a, ax in enumerate(axes):
    outline(
        ax,
        (0, 0),
        own[a],
        np.array([1.0, 0, 0, 0]),
        fc="0.9",
        ec="0.4",
        ls="--",
        lw=2,
        label="scale of the anchor $s_a$",
    )
    for j in range(k):
        angle = 2 * np.pi * j / k
        place = 1.05 * np.cos(angle), 1.05 * np.sin(angle)
        outline(
            ax,
            place,
            sizes[a, j],
            turns[a, j],
            fc=colors[a, j],
            ec="k",
            lw=1,
            label="children" if j == 0 else None,
        )
    ax.set(
        title=f"anchor {a}", xlabel="x (scene units)", aspect="equal", xlim=(-2, 2), ylim=(-2, 2)
    )
axes[0].set_ylabel("y (scene units)")
axes[1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
figure.suptitle(
    "Children choose colour, turn and size; none outgrows its anchor (1 sigma, set apart)",
    fontsize=15,
)
lessons.show(figure, "04_color_rotation_scale")

# %% [markdown]
# ## Backward by hand
# **Sigmoid.** With $c = 1/(1+e^{-\psi})$: $\;dc = \frac{e^{-\psi}}{(1+e^{-\psi})^2}\,d\psi = c\,(1-c)\,d\psi$. The code takes
# $\mathrm{sigmoid}(-\psi)$ for $1 - c$: the same number, but it keeps its digits where $c$ is nearly one. Where $c$ is 0.75 the
# slope is 0.1875.

# %%
c, rest = 1 / (1 + np.exp(-np.log(3))), 1 / (1 + np.exp(np.log(3)))
assert np.isclose(c, 0.75) and np.isclose(c * (1 - c), 0.1875) and np.isclose(c * rest, 0.1875)
white, white_res = color.forward(np.full((1, 3), 40.0), *seen, [np.eye(3)], [np.zeros(3)])
assert (
    white.color[0, 0, 0] * (1 - white.color[0, 0, 0]) == 0
    and abs(white_res.slope[0, 0, 0] - np.exp(-40)) < 1e-30
)

# %% [markdown]
# **Scale.** One axis, one child: $s = s_a\,\varphi$ with $\varphi = \mathrm{sigmoid}(\psi)$. The rule for products:
# $$ds = \varphi\,ds_a + s_a\,\varphi(1-\varphi)\,d\psi \;\Rightarrow\; \bar s_a = \varphi\,\bar s, \quad
# \bar\psi = s_a\,\varphi\,(1-\varphi)\,\bar s.$$

# %%
res = scale.forward(s_a[None], psi[None], *seen, [np.eye(3)], [np.zeros(3)])[1]
s_bar = np.array([3.0, -1, 2])
one_child = scale.backward(res, s_bar[None, None])
assert np.allclose(one_child["s_a"][0], fraction * s_bar, rtol=1e-14)
assert np.allclose(one_child["f_a"][0], s_a * fraction * (1 - fraction) * s_bar, rtol=1e-14)

# %% [markdown]
# With shapes: $\bar\psi$ is per child, $\bar s_a$ is shared, so it sums over the axis of children, as $l_a$ did in `01_offsets`:
# $\bar s_a = \sum_j \varphi_j\,\bar s_j$. Then `reshape(A, 3 k)` undoes the other reshape and `mlp.backward` takes over.

# %%
inputs = dict(s_a=rng.uniform(0.1, 2, (A, 3)), **opacity.view_inputs(rng, A=A, d=2, k=k, outputs=3))
out, res = scale.forward(**inputs)
s_bar = rng.normal(size=(A, k, 3))
ours = scale.backward(res, s_bar)
assert np.allclose(
    ours["s_a"], sum(s_bar[:, j] * out.s[:, j] / inputs["s_a"] for j in range(k)), rtol=1e-12
)
last = s_bar * inputs["s_a"][:, None] * res.fraction * (1 - res.fraction)
assert np.allclose(ours["biases"][-1], last.reshape(A, 3 * k).sum(axis=0), rtol=1e-12)

# %% [markdown]
# **Quaternion.** Let $y$ be the four raw numbers and $n = \sqrt{y\cdot y}$. This is the direction of Eq. (2) in four dimensions:
# $$dn = \frac{y\cdot dy}{n} = r\cdot dy, \qquad dr = \frac{dy}{n} - \frac{y\,dn}{n^2} = \frac{1}{n}\,(I - r r^T)\,dy.$$
# The matrix is its own transpose: $\bar y = (\bar r - r\,(r\cdot\bar r))/n$. For $y = (1, 2, 2, 4)$ and $\bar r = (50, 0, 0, 0)$
# that is 9.6, -0.8, -0.8, -1.6.

# %%
r, r_bar = y / 5, np.array([50.0, 0, 0, 0])
by_hand = (r_bar - r * (r @ r_bar)) / 5
assert np.allclose(by_hand, [9.6, -0.8, -0.8, -1.6], rtol=1e-14)
unit, norm = rotation.normalise(y)
assert np.allclose(rotation.normalise_backward(unit, norm, r_bar), by_hand, rtol=1e-14)

# %% [markdown]
# Line by line against differences, for many quaternions: first $dn$, then $dr$, then the transpose as the adjoint identity.

# %%
y = rng.normal(size=(20, 4))
dy, r_bar = rng.normal(size=(20, 4)), rng.normal(size=(20, 4))
(up, n_up), (down, n_down), (r, n) = (rotation.normalise(y + h * dy) for h in (1e-6, -1e-6, 0))
assert np.allclose((n_up - n_down)[:, 0] / 2e-6, (r * dy).sum(axis=1), rtol=1e-6, atol=1e-8)
dr = (dy - r * (r * dy).sum(axis=1, keepdims=True)) / n
assert np.allclose((up - down) / 2e-6, dr, rtol=1e-6, atol=1e-8)
y_bar = rotation.normalise_backward(r, n, r_bar)
assert abs((y_bar * dy).sum() - (r_bar * dr).sum()) < 1e-12

# %% [markdown]
# **At zero.** $0/0$ is no rotation. The code divides by the *safe length* $n = \sqrt{y\cdot y + \epsilon^2}$ with `1e-12` for
# $\epsilon$. The formulas for $dn$, $dr$ and $\bar y$ stay exact; only $|r|^2$ is $1 - (\epsilon/n)^2$ now. `normalise_backward`
# adds two terms, `view.across`, $\bar r\,|r|^2 - r\,(r\cdot\bar r)$, and $(\epsilon/n)^2\,\bar r$: together
# $\bar r - r\,(r\cdot\bar r)$.

# %%
tiny = rng.normal(size=4) * 2e-12
r, n = rotation.normalise(tiny)
assert (
    abs(n[0] - np.sqrt(tiny @ tiny + 1e-24)) < 1e-26
    and abs(r @ r - (1 - (1e-12 / n[0]) ** 2)) < 1e-14
    and r @ r < 0.99
)
bar = np.array([3.0, -5, 7, 11])
assert np.allclose(
    rotation.normalise_backward(r, n, bar), (bar - r * (r @ bar)) / n, rtol=1e-12, atol=0
)
at_zero = rotation.normalise_backward(*rotation.normalise(np.zeros(4)), bar)
assert np.allclose(at_zero, bar * 1e12, rtol=1e-12) and np.isfinite(at_zero).all()

# %% [markdown]
# A picture in two dimensions: the same $\bar r$ arrives everywhere; what goes on to $y$ is tangential, and the shorter the
# longer $y$ already is. So a step of gradient descent turns a long quaternion less than a short one.

# %%
angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 12, endpoint=False), [0.6, 1.2, 2.0])
flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
raw = np.pad(flat, ((0, 0), (0, 2)))
unit, norm = rotation.normalise(raw)
arrows = rotation.normalise_backward(unit, norm, np.tile([0.0, 0.45, 0, 0], (len(raw), 1)))[:, :2]
assert np.abs((arrows * flat).sum(axis=1)).max() < 1e-15
figure, ax = plt.subplots(figsize=(7.5, 6.8))
ax.add_patch(plt.Circle((0, 0), 1, fill=False, lw=2, color="0.4", label="unit quaternions $r$"))
ax.plot(*flat.T, "o", ms=6, color=lessons.COLORS[6], label=r"raw quaternions $\psi_r$")
ax.quiver(
    *flat.T,
    *arrows.T,
    color=lessons.COLORS[1],
    angles="xy",
    scale_units="xy",
    scale=1,
    width=0.008,
    zorder=3,
)
ax.plot([], [], color=lessons.COLORS[1], label=r"gradient $\bar\psi_r$")
ax.annotate(
    "",
    (-2.5, 0.225),
    (-2.5, -0.225),
    arrowprops=dict(width=3, headwidth=11, color=lessons.COLORS[0]),
)
ax.text(-2.55, -0.5, r"$\bar r$ everywhere", color=lessons.COLORS[0], ha="center", fontsize=13)
ax.set(
    xlabel="real part $w$",
    ylabel="imaginary part $x$",
    aspect="equal",
    xlim=(-3.4, 2.6),
    ylim=(-2.6, 2.6),
)
ax.set_title("Normalising removes the radial part of a gradient", fontsize=15)
ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=11, columnspacing=1)
lessons.show(figure, "04_color_rotation_scale_quaternion")

# %% [markdown]
# ## Break it
# Divide by $n$ and forget the projector, as if the length were a constant. Gradient descent towards a target rotation still
# gets there: everything looks fine. But the raw length has shrunk, and the gradient is not that of the loss.

# %%
target = rotation.normalise(rng.normal(size=4))[0]
start = np.array([0.6, -0.3, 0.2, 0.4])
found = {}
for name in ("right", "broken"):
    q = start.copy()
    for _ in range(4000):
        r, n = rotation.normalise(q)
        r_bar = r - target  # of the loss |r - target|^2 / 2
        q -= 0.05 * (rotation.normalise_backward(r, n, r_bar) if name == "right" else r_bar / n)
    assert (np.linalg.norm(q) < np.linalg.norm(start)) == (name == "broken")
    found[name] = np.degrees(2 * np.arccos(np.clip(abs(rotation.normalise(q)[0] @ target), 0, 1)))
    print(
        f"{name}: off the target by {found[name]:.4f} degrees, raw length {np.linalg.norm(q):.3f}"
    )
assert max(found.values()) < 0.1
r, n = rotation.normalise(start)
bar = r - target
assert (
    abs(rotation.normalise_backward(r, n, bar) @ r) < 1e-14 and abs(bar @ r / n[0]) > 0.1
)  # the one-line check

# %% [markdown]
# ## What a codec does with it
# No colour, rotation or scale of a Gaussian is sent: the feature stands for all of them, and three numbers $s_a$. Counted:
# numbers per Gaussian when written out (14, without view dependence), and per anchor of ten children in the paper's sizes.

# %%
d, k = 16, 10
explicit, anchor = 3 + 3 + 4 + 1 + 3, d + 3 + 3 + 3 * k + 3
assert explicit == 14
print(f"ten Gaussians: {k * explicit} numbers written out, {anchor} as an anchor")

# %% [markdown]
# Because $s_a$ is a common factor, its rounding error is common too: all children of an anchor swell or shrink by the same
# relative amount. With the paper's base step of 0.001 for $s_a$, an axis of 0.02 is off by at most 2.5 percent, in every child.

# %%
Q_s, axis = 0.001, 0.02
shares = rng.uniform(0.05, 0.95, 10)
relative = (axis + Q_s / 2) * shares / (axis * shares) - 1
assert Q_s == 0.001 and axis == 0.02 and np.allclose(relative, 2.5 / 100, rtol=1e-12)

# %% [markdown]
# ## Exercises
# **04.1** $y = (0, 3, 0, 4)$, $\bar r = (0, 0, 0, 25)$. What is $\bar y$, as a list of four? **04.2** Write the colours: the
# sigmoid of `psi (A, 3k)`, cut into children; $e^{800}$ is no float, so think of $e^{-|\psi|}$. **04.3** Write the backward of
# rotation, **04.4** of scale: the derivations above give `psi_bar`, and the function that `network` returns does the rest.

# %%
answer_1 = ...


def network(f_a, delta_vc, d_vc, weights, biases):
    """Its output psi (A, J), and a function from psi_bar (A, J) to the gradients of all five inputs."""
    psi, res = mlp.forward(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
    return psi.y, lambda psi_bar: opacity.split_view(mlp.backward(res, psi_bar), f_a.shape[1])


def my_color(f_a, delta_vc, d_vc, weights, biases):
    """f_a (A, d), delta_vc (A, 1), d_vc (A, 3), lists of arrays -> color (A, k, 3); right where psi is 800, -800 and -40."""
    raise NotImplementedError


def my_rotation_backward(inputs, cotangents):
    """The five gradients of `network` as a dictionary, from cotangents["r_bar"] (A, k, 4); with the safe length above."""
    raise NotImplementedError


def my_scale_backward(inputs, cotangents):
    """The same five and "s_a", from cotangents["s_bar"] (A, k, 3); inputs also holds "s_a" (A, 3)."""
    raise NotImplementedError


raw, bar = np.array([0.0, 3, 0, 4]), np.array([0, 0, 0, 25])
lessons.number("04.1", answer_1, rotation.normalise_backward(*rotation.normalise(raw), bar))
lessons.forward("04.2", my_color, "color")
lessons.backward("04.3", my_rotation_backward, "rotation")
lessons.backward("04.4", my_scale_backward, "scale")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rotation`, and the same with `color` and `scale`. The usual slip is a quaternion with the
# real part *last*, as several libraries store it. Its length is one, all its numbers are right, and it is another rotation.

# %%
from p4dgs_ref import oracle

for key, module in (("color", color), ("rotation", rotation), ("scale", scale)):
    print(key, oracle.check(lambda module=module, **given: module.forward(**given)[0], key))
    assert oracle.check(lambda module=module, **given: module.forward(**given)[0], key).ok
report = oracle.check(lambda **given: rotation.forward(**given)[0].r[..., [1, 2, 3, 0]], "rotation")
assert "(x, y, z, w)" in report.first.explanation
print(report.first.explanation)
assert [EQUATIONS[key].number for key in ("color", "rotation", "scale")] == ["3'", "3'", "4"]
