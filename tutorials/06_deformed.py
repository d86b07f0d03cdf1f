# %% [markdown]
# # Eq. (6): the Gaussians at time t
#
# **Promise.** After this tutorial you know how a correction is added to a position, a scale and a
# rotation, and which parameters learn from its gradient. **Before it:** `04_color_rotation_scale`
# and `05_positional_encoding_and_deformation`. **Takes** four seconds of machine time on two cores,
# 20 minutes of reading and 30 of exercises.
#
# **File:** Eq. (6) [deformed.py](../p4dgs_ref/equations/deformed.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("06_deformed")
rng = np.random.default_rng(6)

# %% [markdown]
# ## What fails without it
# The anchors know no time, so the Gaussians that they predict are the same in every picture of the
# film (bottom). Storing the Gaussians of each picture anew would multiply the size of the file by
# the number of pictures.

# %%
from p4dgs_ref.scenes import simulator

model, thread = tour.MODEL, figures.THREAD
camera = simulator.camera_at(tour.SCENE, *np.radians((60, 26)))

# %%
figure, axes = plt.subplots(2, 3, figsize=(10, 6), layout="constrained")
for column, t in zip(axes.T, (0, 0.25, 0.5)):
    for ax, at in zip(column, (t, None)):
        show.picture(ax, show.frame(model, camera, at), camera, **tour.VIEW)
        gaussians = model.gaussians(at, camera)
        own = gaussians.index // model.design.k == thread.index
        mean2d, cov2d, *_ = show.splats(gaussians, camera, own)
        show.ellipses(ax, mean2d, cov2d, fc="none", ec=thread.color, lw=2)
    column[0].set_title(f"t = {t}: $x + \\Delta x$")
    column[1].set_title("$x$ alone")
figures.show(figure, "06_deformed", title="Anchor 29 at three times, and at rest")

# %% [markdown]
# ## Claim
# The predictions of Eq. (5) are added to the canonical Gaussians:
# $$(x', s', r') = (x+\Delta x, s+\Delta s, r+\Delta r) \tag{6}$$
# The sum of two quaternions does not have unit length, but the covariance needs a unit quaternion.
# The code therefore normalises $r'$ once more (choice `Q9`).

# %% [markdown]
# ## By hand
# Take a Gaussian at $(1, 2, 3)$ with the scale $(0.5, 0.1, 0.1)$ and no rotation,
# $r = (1, 0, 0, 0)$. Let the field predict $\Delta x = (0.5, 0, -1)$, $\Delta s = (0, 0.2, -0.3)$
# and $\Delta r = (0, 2, 2, 4)$. Then $x' = (1.5, 2, 2)$ and $s' = (0.5, 0.3, -0.2)$. The sum of the
# quaternions has the length 5, so $r' = (0.2, 0.4, 0.4, 0.8)$. A negative scale does no harm,
# because the covariance uses its square.

# %%
x = np.array([[1.0, 2, 3]])
s = np.array([[0.5, 0.1, 0.1]])
r = np.array([[1.0, 0, 0, 0]])
delta_x = np.array([[0.5, 0, -1]])
delta_s = np.array([[0, 0.2, -0.3]])
delta_r = np.array([[0.0, 2, 2, 4]])
print("x'", x + delta_x, "| s'", s + delta_s, "| r'", (r + delta_r) / 5)

# %% [markdown]
# ## In code
# The canonical Gaussians and the corrections have the shapes `[N, 3]`, `[N, 3]` and `[N, 4]`. A
# scene of this project lists its *effects*, and three of them are about motion: translation,
# scaling and rotation. If a scene does not list one of them, the correction has the shape `[N, 0]`.
# The attribute is then passed on as it is, and it is not normalised again.

# %%
from p4dgs_ref.equations import deformed, numerics
from p4dgs_ref.lessons import close, random_like
from p4dgs_ref.splatting import covariance

# paper, Sec. 3.2: the deformation is added to the canonical attributes
# silent: Q9, what keeps a sum of quaternions a rotation
(x_t, s_t, r_t), saved = deformed.forward(x, s, r, delta_x, delta_s, delta_r)
assert close(x_t, [[1.5, 2, 2]])
assert close(s_t, [[0.5, 0.3, -0.2]])
assert close(r_t, [[0.2, 0.4, 0.4, 0.8]])

none = np.zeros((1, 0))
(_, s_unchanged, r_unchanged), _ = deformed.forward(x, s, r, delta_x, none, none)
assert np.array_equal(s_unchanged, s)
assert np.array_equal(r_unchanged, r)

with_negative_scale, _ = covariance.forward(s_t, r_t)
with_positive_scale, _ = covariance.forward(np.abs(s_t), r_t)
assert close(with_negative_scale, with_positive_scale)

# %% [markdown]
# ## Backward by hand
# For one number, $y = a + b$ gives $dy = da + db$, so $\bar a = \bar b = \bar y$. A sum gives the
# same gradient to both terms. The position and the scale need nothing else:
# $\bar x = \overline{\Delta x} = \bar x'$ and $\bar s = \overline{\Delta s} = \bar s'$.

# %%
N = 6
inputs = {
    "x": rng.normal(size=(N, 3)),
    "s": rng.uniform(0.1, 1, (N, 3)),
    "r": numerics.normalise(rng.normal(size=(N, 4)))[0],
    "delta_x": rng.normal(size=(N, 3)),
    "delta_s": rng.normal(size=(N, 3)),
    "delta_r": rng.normal(size=(N, 4)),
}
outputs, saved = deformed.forward(**inputs)
x_t_bar, s_t_bar, r_t_bar = bars = random_like(rng, list(outputs))
ours = deformed.backward(saved, *bars)
assert np.array_equal(ours["x"], x_t_bar)
assert np.array_equal(ours["delta_x"], x_t_bar)
assert np.array_equal(ours["s"], s_t_bar)
assert np.array_equal(ours["delta_s"], s_t_bar)

# %% [markdown]
# The cotangent of the rotation first goes through the normalisation of `04_color_rotation_scale`,
# then through the sum. With $n = \|r + \Delta r\|$,
# $$\bar r = \overline{\Delta r} = \frac{1}{n}\bigl(\bar r' - r'\,(r'\cdot\bar r')\bigr).$$
# A large $\Delta r$ makes $n$ large and both gradients small.

# %%
n = np.linalg.norm(inputs["r"] + inputs["delta_r"], axis=1, keepdims=True)
r_t = outputs[2]
along = (r_t * r_t_bar).sum(axis=1, keepdims=True)
assert close(ours["r"], (r_t_bar - r_t * along) / n, 1e-11)
assert np.array_equal(ours["r"], ours["delta_r"])

# %% [markdown]
# The adjoint identity checks all six gradients at once.

# %%
_ = lessons.adjoint(rng, deformed.forward, inputs, bars, ours)

# %% [markdown]
# Which parameters learn from this gradient? At one time, both terms of the sum receive the same
# gradient. $\overline{\Delta x}$ continues to the weights of $\psi_d$, and $\bar x$ to the
# position, the offsets and the scaling of the anchor. Over several times they differ: the canonical
# position receives the gradients of all times, while $\Delta x(t)$ receives only that of its own
# time. The cell shows this with gradient descent, where free numbers $\Delta x(t)$ at four times
# take the place of the network. The canonical position learns 4/5 of the mean of the targets, and
# the corrections learn the rest.

# %%
T = 4
targets = rng.normal(size=(T, 3))  # where one Gaussian should be at T times
position = np.zeros(3)
corrections = np.zeros((T, 3))
for _ in range(200):
    error = position + corrections - targets  # the gradient of |error|^2 / 2
    position = position - 0.1 * error.sum(axis=0)
    corrections = corrections - 0.1 * error
assert close(position + corrections, targets, 1e-8)
assert close(position, T / (T + 1) * targets.mean(axis=0), 1e-9)

# %% [markdown]
# There is one blind spot. The covariance, which is what gets drawn (`13_covariance`), contains
# $s'^2$. At $s' = 0$ its slope is 0, so an exactly flat Gaussian receives no gradient along its
# flat axis. Elsewhere the gradient changes its sign together with $s'$.

# %%
Sigma_bar = rng.normal(size=(1, 3, 3))


def gradient_of_thickness(thickness):
    """Return the gradient of the first scale of a Gaussian."""
    _, saved = covariance.forward(np.array([[thickness, 0.2, 0.3]]), r_t[:1])
    return covariance.backward(saved, Sigma_bar)["s"][0, 0]


positive = gradient_of_thickness(0.1)
assert abs(positive) > 1e-3
assert close(gradient_of_thickness(-0.1), -positive)
assert gradient_of_thickness(0) == 0

# %% [markdown]
# ## Break it
# Suppose we leave out the second normalisation, as `D3DGS` does. The cell rotates a Gaussian with
# the scales 2, 1 and 1 about its third axis. Small rotations look right, because the longest axis
# grows only by the factor $\sqrt{1 + 4\|\Delta r\|^4}$. Larger ones inflate the Gaussian: at
# $\|\Delta r\| = 1$, a quarter turn, it is more than twice as long.

# %%
z = np.linspace(0, 1, 101)
zero = np.zeros(101)
unturned = np.eye(4)[[0] * 101]
scales = np.tile([2.0, 1, 1], (101, 1))
delta_r = np.stack([zero, zero, zero, z], axis=1)
none = np.zeros((101, 0))
(_, _, normalised), _ = deformed.forward(scales, scales, unturned, none, none, delta_r)


def longest_axis(quaternions):
    """Return the largest standard deviation of each Gaussian."""
    Sigma, _ = covariance.forward(scales, quaternions)
    return np.sqrt(np.linalg.eigvalsh(Sigma)[:, -1])


right = longest_axis(normalised)
inflated = longest_axis(unturned + delta_r)
assert close(right, 2)
assert close(inflated, 2 * np.sqrt(1 + 4 * z**4))
print(f"longest axis after a quarter turn: {right[-1]:.2f}, not normalised {inflated[-1]:.2f}")

# %% [markdown]
# ## What a codec does with it
# This is inter prediction: the canonical Gaussians are the reference frame and $\Delta x$ is the
# motion vector. Unlike in a video codec, no residual follows, so whatever $\psi_d$ cannot express
# is not shown. One more frame costs no byte. What costs bytes is each head of $\psi_d$.
# [See it move](viewer/demo.html#step=time): the paths of the demo's Gaussians, and where they
# begin.

# %%
from p4dgs_ref import PRESETS, effects
from p4dgs_ref.training.initial import design_of

paper = PRESETS["paper_synthetic"]
sizes = []
for listed in (("translation",), ("translation", "rotation"), effects.MOTION):
    layers = design_of(paper, listed).layers()["psi_d"]
    count = sum((rows + 1) * columns for rows, columns in layers[-3:])
    sizes.append(2 * count)
    print(f"{' '.join(listed):30} heads {effects.heads(listed)}: {2 * count} bytes in float16")
assert sizes == sorted(set(sizes))
assert "psi_d" not in design_of(paper, ()).layers()

# %% [markdown]
# ## What this idea buys
# The picture is that of `05_positional_encoding_and_deformation`, because Eq. (6) only applies what
# Eq. (5) predicts: 13,715 bytes raise the PSNR from 20.0 to 33.9 dB, whether the film has 11
# pictures or a thousand.

# %%
from tutorials import gains

here = {"at rest": "no deformation", "moving": "+ quantisation and entropy coding"}
assert np.round([gains.mean(label, "psnr_db") for label in here.values()], 1).tolist() == [20, 33.9]
gains.show("06_deformed", here, {})

# %% [markdown]
# **In short**
# - One canonical scene and a sum make the Gaussians of every time.
# - Both terms of a sum get the same gradient; the canonical one adds it up over all times.
# - A sum of quaternions is normalised again (`Q9`).
#
# **Often misunderstood**
# - *Deformations add up over time.* Each one starts at the canonical scene; a frame needs no other.
# - *A residual follows, as in video.* None does.
# - *Opacity and colour change in time.* Eq. (6) has neither.

# %% [markdown]
# ## Exercises
# **06.1** ● $r = (1, 0, 0, 0)$ and $\Delta r = (0, 0, 0, 1)$. By how many degrees does the Gaussian
# turn? The real part of a unit quaternion is the cosine of half the angle.
#
# **06.2** ●● Write Eq. (6), including corrections of width zero.
#
# **06.3** ●● Write its backward. `numerics.normalise(y)` returns $y/n$ and $n$, and
# `numerics.normalise_backward(y / n, n, bar)` returns the gradient of $y$.
#
# **Predict, then run.** Both $r$ and $\Delta r$ are multiplied by $100$. What happens to $r'$ and
# to the gradient of $\Delta r$?

# %%
answer_1 = ...


def my_deformed(x, s, r, delta_x, delta_s, delta_r):
    """Return x_t [N, 3], s_t [N, 3] and r_t [N, 4]; a correction may have the width zero."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return the gradients of the six inputs, in the shapes of the inputs.

    `cotangents` holds "x_t_bar" [N, 3], "s_t_bar" [N, 3] and "r_t_bar" [N, 4].
    """
    raise NotImplementedError


lessons.check_number("06.1", answer_1)
lessons.check_forward("06.2", my_deformed, "deformed")
lessons.check_backward("06.3", my_backward, "deformed")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only deformed` compares what a port wrote. Besides the missing
# normalisation, ports add $\Delta s$ to the logarithm of the scale, because that is what 3DGS
# stores. The checker tells the two mistakes apart.


# %%
def logarithmic(s, delta_s, **others):
    (x_t, s_t, r_t), _ = deformed.forward(s=s, delta_s=delta_s, **others)
    if delta_s.shape[1] > 0:
        s_t = s * np.exp(delta_s)
    return x_t, s_t, r_t


def unnormalised(r, delta_r, **others):
    (x_t, s_t, r_t), _ = deformed.forward(r=r, delta_r=delta_r, **others)
    if delta_r.shape[1] > 0:
        r_t = r + delta_r
    return x_t, s_t, r_t


lessons.passes("deformed")
lessons.check_mistake(logarithmic, "deformed", "exp(delta_s)")
lessons.check_mistake(unnormalised, "deformed", "not of unit length")
