# %% [markdown]
# # Eq. (6): the Gaussians at time t
#
# **Promise.** After this you know how a correction is added to a place, a size and a turn, and who learns from its gradient.
# **Before it:** `04_color_rotation_scale` and `05_positional_encoding_and_deformation`. **Takes** two seconds of machine time
# on two cores, twenty minutes of yours.

# %%
import numpy as np
from matplotlib.patches import Ellipse

from p4dgs_ref import EQUATIONS, PRESETS, effects
from p4dgs_ref.equations import deformed, rotation
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import covariance
from p4dgs_ref.training.initial import design_of

plt = lessons.pyplot()
rng = np.random.default_rng(6)

# %% [markdown]
# ## Claim
# What Eq. (5) predicts is added to the canonical Gaussians:
# $$(x', s', r') = (x+\Delta x, s+\Delta s, r+\Delta r) \tag{6}$$
# The sum of two quaternions has no unit length, and the covariance wants one. So $r'$ is normalised once more (choice `Q9`).

# %% [markdown]
# ## By hand
# A Gaussian at $(1, 2, 3)$ with scale $(0.5, 0.1, 0.1)$, not turned: $r = (1, 0, 0, 0)$. The field says
# $\Delta x = (0.5, 0, -1)$, $\Delta s = (0, 0.2, -0.3)$, $\Delta r = (0, 2, 2, 4)$. Then $x'$ is 1.5, 2, 2 and $s'$ is 0.5, 0.3,
# -0.2. The sum of the quaternions has length 5, and $r'$ is 0.2, 0.4, 0.4, 0.8. A negative scale is allowed: the covariance
# takes its square.

# %%
x, s, r = np.array([[1.0, 2, 3]]), np.array([[0.5, 0.1, 0.1]]), np.array([[1.0, 0, 0, 0]])
delta_x, delta_s, delta_r = (
    np.array([[0.5, 0, -1]]),
    np.array([[0, 0.2, -0.3]]),
    np.array([[0.0, 2, 2, 4]]),
)
added = r + delta_r
assert (x + delta_x).tolist() == [[1.5, 2, 2]] and np.allclose(
    s + delta_s, [[0.5, 0.3, -0.2]], rtol=1e-14
)
assert np.linalg.norm(added) == 5 and np.allclose(added / 5, [[0.2, 0.4, 0.4, 0.8]], rtol=1e-15)

# %% [markdown]
# ## In code
# Shapes are `(N, 3)`, `(N, 3)`, `(N, 4)` for the canonical Gaussians and for the deltas. A scene of this project lists its
# *effects*, of motion: translation, scaling, rotation. What it does not list has a delta of zero width `(N, 0)`: that attribute
# passes as it is, and is not normalised again.

# %%
out, res = deformed.forward(x, s, r, delta_x, delta_s, delta_r)
assert np.array_equal(out.x_t, x + delta_x) and np.array_equal(out.s_t, s + delta_s)
assert np.allclose(out.r_t, added / 5, rtol=1e-15)
still, _ = deformed.forward(x, s, r, delta_x, delta_s[:, :0], delta_r[:, :0])
assert still.s_t is s and still.r_t is r
sizes = (
    covariance.forward(out.s_t, out.r_t)[0].Sigma,
    covariance.forward(np.abs(out.s_t), out.r_t)[0].Sigma,
)
assert np.allclose(*sizes, rtol=1e-14)

# %% [markdown]
# One canonical Gaussian and what is drawn of it at six times. Its three deltas are written down here instead of predicted:
# a throw, a stretch, and a turn by ever larger $\Delta r$.

# %%
times = np.linspace(0, 1, 6)
canon = dict(x=np.zeros((6, 3)), s=np.tile([0.16, 0.07, 0.05], (6, 1)), r=np.eye(4)[[0] * 6])
turn = np.radians(150 * times) / 2
deltas = dict(
    delta_x=np.stack([2.4 * times, 3.2 * times * (1 - times), 0 * times], axis=1),
    delta_s=np.stack([0.12 * times, 0 * times, 0 * times], axis=1),
    delta_r=np.stack([0 * times, 0 * times, 0 * times, np.tan(turn)], axis=1),
)
track, _ = deformed.forward(**canon, **deltas)
Sigma = covariance.forward(track.s_t, track.r_t)[0].Sigma[:, :2, :2]
shown = np.degrees(2 * np.arctan2(track.r_t[:, 3], track.r_t[:, 0]))
assert np.allclose(shown, 150 * times)
figure, ax = plt.subplots(figsize=(10.5, 5))
fine = np.linspace(0, 1, 101)
ax.plot(2.4 * fine, 3.2 * fine * (1 - fine), "k:", lw=1.5, label=r"$x + \Delta x(t)$")
for i, t in enumerate(times):
    size, axis = np.linalg.eigh(Sigma[i])
    ax.add_patch(
        Ellipse(
            track.x_t[i, :2],
            *2 * np.sqrt(size),
            angle=np.degrees(np.arctan2(axis[1, 0], axis[0, 0])),
            alpha=0.75,
            fc=("0.6", lessons.COLORS[0])[i > 0],
            ec="k",
            label=("canonical", "moved")[i] if i < 2 else None,
        )
    )
    ax.text(
        track.x_t[i, 0],
        track.x_t[i, 1] - 0.5,
        f"t = {t:.1f}\n{shown[i]:.0f}°",
        ha="center",
        fontsize=12,
    )
ax.set(
    xlabel="x (scene units)",
    ylabel="y (scene units)",
    aspect="equal",
    xlim=(-0.5, 3),
    ylim=(-0.65, 1.35),
)
ax.set_title(
    "One canonical Gaussian at six times: thrown, stretched, turned (1 sigma)", fontsize=15
)
ax.legend(loc="upper right", fontsize=12)
lessons.show(figure, "06_deformed")

# %% [markdown]
# ## Backward by hand
# One number: $y = a + b$, so $dy = da + db$ and $\bar a = \bar b = \bar y$. A sum gives the same gradient to both. Place and
# scale need nothing else: $\bar x = \overline{\Delta x} = \bar x'$ and $\bar s = \overline{\Delta s} = \bar s'$.

# %%
N = 6
inputs = dict(
    x=rng.normal(size=(N, 3)),
    s=rng.uniform(0.1, 1, (N, 3)),
    r=rotation.normalise(rng.normal(size=(N, 4)))[0],
    delta_x=rng.normal(size=(N, 3)),
    delta_s=rng.normal(size=(N, 3)),
    delta_r=rng.normal(size=(N, 4)),
)
out, res = deformed.forward(**inputs)
bars = dict(
    x_t_bar=rng.normal(size=(N, 3)),
    s_t_bar=rng.normal(size=(N, 3)),
    r_t_bar=rng.normal(size=(N, 4)),
)
ours = deformed.backward(res, **bars)
assert np.array_equal(ours["x"], bars["x_t_bar"]) and np.array_equal(
    ours["delta_x"], bars["x_t_bar"]
)
assert np.array_equal(ours["s"], bars["s_t_bar"]) and np.array_equal(
    ours["delta_s"], bars["s_t_bar"]
)

# %% [markdown]
# The turn: first through the normalisation of `04_color_rotation_scale`, then through the sum. With $n = \|r + \Delta r\|$:
# $$\bar r = \overline{\Delta r} = \frac{1}{n}\bigl(\bar r' - r'\,(r'\cdot\bar r')\bigr)$$
# A $\Delta r$ of large size makes $n$ large, and both gradients small.

# %%
n = np.linalg.norm(inputs["r"] + inputs["delta_r"], axis=1, keepdims=True)
along = (out.r_t * bars["r_t_bar"]).sum(axis=1, keepdims=True)
assert np.allclose(ours["r"], (bars["r_t_bar"] - out.r_t * along) / n, rtol=1e-11, atol=1e-13)
assert np.array_equal(ours["r"], ours["delta_r"])
d = {name: rng.normal(size=a.shape) for name, a in inputs.items()}  # the adjoint identity, all six
h = 1e-6
up, down = (
    deformed.forward(**{m: a + sign * h * d[m] for m, a in inputs.items()})[0] for sign in (1, -1)
)
difference = sum((bars[m + "_bar"] * (a - b)).sum() for m, a, b in zip(out._fields, up, down)) / (
    2 * h
)
gradient = sum((ours[m] * d[m]).sum() for m in d)
assert abs(difference - gradient) < 1e-7 * abs(gradient)
print(f"by differences {difference:.8f}, by gradient {gradient:.8f}")

# %% [markdown]
# Who learns? At one time both sides of the sum get the same gradient: $\overline{\Delta x}$ goes on into the weights of
# $\psi_d$, $\bar x$ to place, offset and scaling of the anchor. Over several times the canonical place collects them all, while
# each $\Delta x(t)$ hears only its own. Gradient descent, with four free numbers $\Delta x(t)$ per axis in place of a network:

# %%
targets = rng.normal(size=(4, 3))  # where one Gaussian should be at four times
place, moves = np.zeros(3), np.zeros((4, 3))
for _ in range(200):
    miss = place + moves - targets  # x_t_bar of the squared error / 2
    place, moves = place - 0.1 * miss.sum(axis=0), moves - 0.1 * miss
assert np.allclose(place + moves, targets, atol=1e-12) and np.allclose(
    place, moves.sum(axis=0), atol=1e-12
)
share = np.abs(place).mean() / np.abs(targets.mean(axis=0)).mean()
assert np.isclose(share, 4 / 5, rtol=1e-9)  # T / (T + 1) of the mean, T times
print(
    f"of the mean of four targets the canonical place learned {share:.2f}; the deltas learned the rest and the motion"
)

# %% [markdown]
# A blind spot: the covariance, which is what gets drawn (`13_covariance`), holds $s'^2$. Where $s' = 0$ on an axis its slope is
# 0: an exactly flat Gaussian receives no gradient along it. Elsewhere the sign of the gradient flips with the sign of $s'$.

# %%
Sigma_bar = rng.normal(size=(1, 3, 3))
felt = [
    covariance.backward(
        covariance.forward(np.array([[thick, 0.2, 0.3]]), out.r_t[:1])[1], Sigma_bar
    )["s"][0, 0]
    for thick in (0.1, -0.1, 0)
]
assert np.isclose(felt[0], -felt[1], rtol=1e-12) and felt[2] == 0 and abs(felt[0]) > 1e-3

# %% [markdown]
# ## Break it
# Leave out the second normalisation, as `D3DGS` does. The figure turns a Gaussian of scales 2, 1, 1 about its third axis. Small
# turns look fine: the longest axis grows by the factor $\sqrt{1 + 4\|\Delta r\|^4}$. Larger ones blow the Gaussian up.

# %%
z = np.linspace(0, 1, 101)
unturned, reach = np.eye(4)[[0] * len(z)], np.tile([2.0, 1, 1], (len(z), 1))
delta_r = np.stack([0 * z, 0 * z, 0 * z, z], axis=1)
right = deformed.forward(
    np.zeros((len(z), 3)), reach, unturned, np.zeros((len(z), 3)), np.zeros((len(z), 3)), delta_r
)[0].r_t
longest = {
    name: np.sqrt(np.linalg.eigvalsh(covariance.forward(reach, q)[0].Sigma)[:, -1])
    for name, q in (("normalised (Q9)", right), ("not normalised", unturned + delta_r))
}
assert np.allclose(longest["normalised (Q9)"], 2, rtol=1e-12) and reach[0].tolist() == [2, 1, 1]
assert np.allclose(longest["not normalised"], 2 * np.sqrt(1 + 4 * z**4), rtol=1e-12)
assert longest["not normalised"][10] < 2.05 and longest["not normalised"][-1] > 4
figure, ax = plt.subplots(figsize=(9, 5))
for (name, values), style in zip(longest.items(), ("-", "--")):
    ax.plot(z, values, style, lw=3, label=name)
ax.set(xlabel=r"size of $\Delta r$, about the z axis, added to $r = (1, 0, 0, 0)$", ylim=(0, None))
ax.set_ylabel("longest axis (scene units)")
ax.set_title("Without the second normalisation a turn inflates the Gaussian", fontsize=15)
ax.legend(loc="lower left")
lessons.show(figure, "06_deformed_inflated")

# %% [markdown]
# ## What a codec does with it
# This is inter prediction: the canonical Gaussians are the reference frame, $\Delta x$ the motion vector. Unlike in a video codec
# no residual follows: what $\psi_d$ cannot say is not shown. One more time costs no byte. What costs bytes is a head of $\psi_d$:

# %%
paper = PRESETS["paper_synthetic"]
for listed in (("translation",), ("translation", "rotation"), effects.MOTION):
    heads = design_of(paper, listed).layers()["psi_d"][-3:]
    count = sum(rows * wide + wide for rows, wide in heads)
    print(f"{' '.join(listed):30} heads {effects.heads(listed)}: {2 * count} bytes in float16")
assert effects.heads(("translation",)) == (3, 0, 0) and "psi_d" not in design_of(paper, ()).layers()

# %% [markdown]
# ## Exercises
# **06.1** $r = (1, 0, 0, 0)$ and $\Delta r = (0, 0, 0, 1)$: by how many degrees does the Gaussian turn? (The real part of a unit
# quaternion is the cosine of half the angle.) **06.2** Write Eq. (6), a delta of width zero included. **06.3** Write its
# backward. In both take `rotation.normalise(y)`, which returns $y/n$ and $n$, and `rotation.normalise_backward(y / n, n, bar)`.

# %%
answer_1 = ...


def my_deformed(x, s, r, delta_x, delta_s, delta_r):
    """Arrays (N, 3), (N, 3), (N, 4) and deltas of the same widths or of width zero -> x_t, s_t, r_t."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """The six gradients, in the shapes of the inputs of the same names (width zero stays zero), from
    cotangents["x_t_bar"] (N, 3), ["s_t_bar"] (N, 3), ["r_t_bar"] (N, 4)."""
    raise NotImplementedError


quarter = deformed.forward(x, s, r, delta_x, delta_s, np.array([[0.0, 0, 0, 1]]))[0].r_t[0]
lessons.number("06.1", answer_1, np.degrees(2 * np.arccos(quarter[0])))
lessons.forward("06.2", my_deformed, "deformed")
lessons.backward("06.3", my_backward, "deformed")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only deformed` reads what a port wrote. Another slip than the one above is adding $\Delta s$ to
# the logarithm of the scale, which is what 3DGS stores. The checker tells them apart:

# %%
from p4dgs_ref import oracle


def logarithmic(delta_s, **given):
    out = deformed.forward(delta_s=delta_s, **given)[0]
    return out._replace(s_t=given["s"] * np.exp(delta_s)) if delta_s.shape[1] else out


def unnormalised(r, delta_r, **given):
    out = deformed.forward(r=r, delta_r=delta_r, **given)[0]
    return out._replace(r_t=r + delta_r) if delta_r.shape[1] else out


print(oracle.check(lambda **given: deformed.forward(**given)[0], "deformed"))
assert oracle.check(lambda **given: deformed.forward(**given)[0], "deformed").ok
for slip, says in ((logarithmic, "exp(delta_s)"), (unnormalised, "not of unit length")):
    print(oracle.check(slip, "deformed").first.explanation)
    assert says in oracle.check(slip, "deformed").first.explanation
assert EQUATIONS["deformed"].number == "6"
