# %% [markdown]
# # Eq. (2): how far away an anchor is, and in which direction it is seen
#
# **Promise.** After this tutorial you can derive the gradients of a length and of a direction, and
# explain why the second one has no radial component. **Before it:** `01_offsets`. **Takes** five
# seconds of machine time on two cores, 30 minutes of reading and 30 of exercises.
#
# **File:** Eq. (2) [view.py](../p4dgs_ref/equations/view.py).

# %%
from functools import partial

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, panels, show, tour

plt = figures.pyplot()
architecture.show("02_view")
rng = np.random.default_rng(2)

# %% [markdown]
# ## What fails without it
# A highlight is a mirror image of the lamp, so it wanders over a ball at rest while the camera
# walks around it (top). If every spot of the ball has one colour for all cameras, the highlight of
# the first picture is painted on the ball and turns with the stripes (bottom).

# %%
x, y = np.meshgrid(*2 * [np.linspace(-1.1, 1.1, 220)])
z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
lamp = np.array([0, -0.6, 0.8])


def ball(angle, highlight_seen_from):
    """A picture of a striped ball by a camera that has walked `angle` radians around it."""
    cos, sin = np.cos(angle), np.sin(angle)
    normal = np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=2)
    eye = np.array([np.sin(highlight_seen_from), 0, np.cos(highlight_seen_from)])
    half = (lamp + eye) / np.linalg.norm(lamp + eye)
    stripes = 0.6 + 0.15 * (np.sin(8 * np.arctan2(normal[..., 0], normal[..., 2])) > 0)
    matte = stripes * (0.3 + 0.7 * np.maximum(normal @ lamp, 0))
    image = matte[..., None] * (1, 0.2, 0.15) + np.maximum(normal @ half, 0)[..., None] ** 60
    return np.where((z > 0)[..., None], np.clip(image, 0, 1), 1)


# %%
figure, axes = plt.subplots(2, 3, figsize=(10, 6.8), layout="constrained")
for (top, bottom), degrees in zip(axes.T, (0, 35, 70)):
    top.imshow(ball(np.radians(degrees), np.radians(degrees)))
    bottom.imshow(ball(np.radians(degrees), 0))
    top.set(title=f"camera at {degrees}°", **show.BARE)
    bottom.set(**show.BARE)
axes[0, 0].set_ylabel("as it is")
axes[1, 0].set_ylabel("one colour for all cameras")
figures.show(figure, "02_view_ball")

# %% [markdown]
# 3DGS therefore stores 48 numbers for each Gaussian, from which its colour in every direction
# follows. P-4DGS stores none of them: its networks are told where the camera is.

# %% [markdown]
# ## Claim
# Four networks predict the opacities, colours, rotations and scales of the Gaussians. Besides the
# anchor's feature they read a distance and a direction:
# $$\delta_{vc} = \| x_a - x_c \|_2, \quad d_{vc} = \frac{x_a-x_c}{\| x_a - x_c \|_2} \tag{2}$$
# Here $x_c$ is the position of the camera. The direction points *from the camera to the anchor*.

# %% [markdown]
# ## By hand
# Take an anchor at $(3, -1, 7)$ and a camera at $(1, 2, 1)$. Their difference is $(2, -3, 6)$, and
# its length is $\sqrt{4 + 9 + 36} = 7$. The direction is the difference divided by 7.

# %%
x_a = np.array([3.0, -1, 7])
x_c = np.array([1.0, 2, 1])
distance = (2 * 2 + 3 * 3 + 6 * 6) ** 0.5
direction = np.array([2, -3, 6]) / distance
print("distance", distance, "direction", direction.round(4))

# %% [markdown]
# ## In code
# For $A$ anchors and one camera, `x_a [A, 3]` and `x_c [3]` give `delta_vc [A, 1]` and
# `d_vc [A, 3]`. The distance keeps an axis of length one, because it becomes a column beside the
# feature. Since `forward` has two outputs here, it returns them as a tuple.

# %%
from p4dgs_ref.equations import mlp, view
from p4dgs_ref.lessons import close, inner

# paper, Sec. 3.2: the distance and the direction between anchor and camera
# silent: Q22, which position; here the anchor's own, before any motion
(delta_vc, d_vc), saved = view.forward(x_a[None], x_c)
assert delta_vc.shape == (1, 1)
assert delta_vc[0, 0] == 7
assert close(d_vc[0], direction)

# %% [markdown]
# An anchor at the position of the camera has the distance 0, and $0/0$ is NaN. The code divides by
# 1 there, so the direction of such an anchor is zero.

# %%
(no_distance, no_direction), _ = view.forward(x_c[None], x_c)
assert no_distance[0, 0] == 0
assert not no_direction.any()

# %% [markdown]
# The next figure walks around the trained scene. Anchor 29 (purple) is at rest in its canonical
# place, but its distance and direction change, and with them the colours that the network $\psi_c$
# gives to its three children: the middle one is bright red where the highlight is seen and dark on
# the other side. The file stores these children once, for all cameras.
# [See it move](viewer/demo.html#step=prediction): colours follow the direction while the camera
# turns.

# %%
from p4dgs_ref.scenes import simulator

model, thread = tour.MODEL, figures.THREAD
walk = np.arange(0, 360, 5)
cameras = [simulator.camera_at(tour.SCENE, *np.radians((degrees, 26))) for degrees in walk]
seen = [model.gaussians(0.3, camera) for camera in cameras]
own = seen[0].index // model.design.k == thread.index
colors = np.array([gaussians.color[own] for gaussians in seen])
names = [f"child {i}" for i in seen[0].index[own] % model.design.k]
change = 255 * np.ptp(colors, axis=0).max(axis=1)
assert names[change.argmax()] == f"child {thread.child}"
assert change.max() > 60
print(*(f"{name} changes by {most:.0f} of 255" for name, most in zip(names, change)), sep=", ")

# %%
panels.walk(model, cameras, seen, own, walk, colors, names, tour.VIEW)

# %% [markdown]
# ## Backward by hand
# Let $v = x_a - x_c$. Because the camera does not move, $dv = dx_a$, and the gradient of $x_a$ is
# that of $v$.
#
# We begin on a line, where $v$ is a number. The length is $\delta = |v|$ and the direction is the
# sign of $v$. Away from $v = 0$, a small step $dv$ changes the length by $\pm dv$ and does not
# change the direction. So $\bar v = \pm\bar\delta$, and the cotangent of the direction contributes
# nothing.
#
# The function `gradient` below uses the table `EQUATIONS`, which contains every equation by name.
# Its method `vjp` returns the outputs and a function `pullback` from cotangents to gradients.
# Cotangents that are left out are zero, which is convenient for an equation with two outputs.


# %%
from p4dgs_ref import EQUATIONS, effects


def gradient(x_a, x_c, **cotangents):
    """Return the gradient of x_a."""
    _, pullback = EQUATIONS["view"].vjp(x_a=x_a, x_c=x_c)
    return pullback(**cotangents)["x_a"]


origin = np.zeros(3)
two = np.array([[2.0]])
five = np.array([[5.0, 0, 0]])
for position in (3.0, -0.5):
    on_the_line = np.array([[position, 0, 0]])
    of_length = gradient(on_the_line, origin, delta_vc_bar=two)
    of_direction = gradient(on_the_line, origin, d_vc_bar=five)
    assert of_length[0, 0] == 2 * np.sign(position)
    assert of_direction[0, 0] == 0

# %% [markdown]
# In three dimensions we take the length first. Differentiating both sides of $\delta^2 = v\cdot v$
# gives
# $$2\,\delta\,d\delta = 2\,v\cdot dv \;\Rightarrow\; d\delta = d_{vc}\cdot dv
# \;\Rightarrow\; \bar v = d_{vc}\,\bar\delta.$$
# The gradient of a length is the unit vector along it. For the anchor of "By hand" and
# $\bar\delta = 7$ it is $(2, -3, 6)$.

# %%
A = 5
anchors = rng.normal(size=(A, 3))
delta_bar = rng.normal(size=(A, 1))
d_bar = rng.normal(size=(A, 3))
(delta_vc, d_vc), _ = view.forward(anchors, x_c)
of_length = gradient(anchors, x_c, delta_vc_bar=delta_bar)
assert np.array_equal(of_length, d_vc * delta_bar)

# %% [markdown]
# For the direction we use the quotient rule, then substitute $v = \delta\,d_{vc}$ and $d\delta =
# d_{vc}\cdot dv$. With $\mathrm{d}d_{vc}$ for the change of the direction,
# $$\mathrm{d}d_{vc} = \frac{dv}{\delta} - \frac{v\,d\delta}{\delta^2}
# = \frac{1}{\delta}\bigl(dv - d_{vc}\,(d_{vc}\cdot dv)\bigr).$$
# The brackets remove the component of $dv$ along $d_{vc}$ and keep the component perpendicular to
# it. This makes sense, because a step along the ray does not change the direction in which the
# anchor is seen. As a matrix that multiplies $dv$, they are called a *projector*; the next cell
# computes it.

# %%
projector = np.eye(3) - d_vc[:, :, None] * d_vc[:, None, :]  # [A, 3, 3]
assert close(projector @ projector, projector)
step = 1e-6 * rng.normal(size=(A, 3))
(_, ahead), _ = view.forward(anchors + step, x_c)
(_, behind), _ = view.forward(anchors - step, x_c)
predicted = (projector @ step[:, :, None])[:, :, 0] / delta_vc
assert close((ahead - behind) / 2, predicted, 1e-6)

# %% [markdown]
# If $dy = M\,dv$, then $\bar y\cdot dy = (M^T\bar y)\cdot dv$, where $T$ stands for transposing. A
# backward therefore multiplies by the transposed matrix. The projector is its own transpose, so
# with both outputs together
# $$\bar x_a = d_{vc}\,\bar\delta_{vc}
# + \frac{1}{\delta_{vc}}\bigl(\bar d_{vc} - d_{vc}\,(d_{vc}\cdot\bar d_{vc})\bigr).$$
# Because of the factor $1/\delta_{vc}$, the direction to a distant anchor changes slowly. For the
# anchor of "By hand", $\bar d_{vc} = (343, 0, 0)$ alone gives $(45, 6, -12)$.

# %%
by_hand = gradient(x_a[None], x_c, d_vc_bar=np.array([[343.0, 0, 0]]))
assert close(by_hand, [[45, 6, -12]])

ours = gradient(anchors, x_c, delta_vc_bar=delta_bar, d_vc_bar=d_bar)
along = (d_vc * d_bar).sum(axis=1, keepdims=True)
formula = d_vc * delta_bar + (d_bar - d_vc * along) / delta_vc
assert close(ours, formula)

# %% [markdown]
# The adjoint identity of `01_offsets` checks the whole backward at once.

# %%
inputs, bars = {"x_a": anchors}, (delta_bar, d_bar)
tangents, _ = lessons.adjoint(
    rng, partial(view.forward, x_c=x_c), inputs, bars, {"x_a": ours}, 1e-8
)

# %% [markdown]
# The next figure shows the gradients that anchors around a camera receive. A cotangent of the
# length gives arrows of equal size along the rays (blue). A cotangent of the direction gives arrows
# perpendicular to the rays, which get shorter with the distance (orange).

# %%
directions = np.arange(12) * np.pi / 6
angle, radius = np.meshgrid(directions, [1.0, 2.5, 4.0])
x = radius * np.cos(angle)
y = radius * np.sin(angle)
ring = np.stack([x, y, 0 * x], axis=-1).reshape(36, 3)
to_the_right = np.tile([1.0, 0, 0], (36, 1))
of_length = gradient(ring, origin, delta_vc_bar=np.ones((36, 1)))
of_direction = gradient(ring, origin, d_vc_bar=to_the_right)
radial_part = (of_direction * ring).sum(axis=1)
assert np.abs(radial_part).max() < 1e-15

# %%
panels.gradients_of_view(ring, of_length, of_direction)

# %% [markdown]
# ## Break it
# Suppose we treat the length in the denominator as a constant, so that $\bar v = \bar
# d_{vc}/\delta$ without the projector. The shape is right, and the adjoint identity holds for every
# step *perpendicular* to the ray. It fails for a step *along* the ray: the broken gradient claims
# that the loss changes, although moving along the ray changes no direction.

# %%
broken = d_bar / delta_vc
ours = gradient(anchors, x_c, d_vc_bar=d_bar)
move = tangents["x_a"]
across = move - d_vc * (d_vc * move).sum(axis=1, keepdims=True)
assert abs(inner(broken - ours, across)) < 1e-13

(_, from_further), _ = view.forward(anchors + 0.01 * d_vc, x_c)
assert close(from_further, d_vc)
claimed = (broken * d_vc).sum(axis=1)
actual = (ours * d_vc).sum(axis=1)
assert np.abs(claimed).min() > 0.01
assert np.abs(actual).max() < 1e-15
print("change of the loss per unit along the ray, which is 0; broken:", claimed.round(3))

# %% [markdown]
# The other mistake is to divide without checking for zero. One anchor at the camera then has the
# direction $0/0$, which is NaN in one row of many. But all rows share the weights of a network, as
# `03_opacity_and_masking` shows. After one backward through that network, *every* gradient of a
# weight that reads a direction is NaN.

# %%
from p4dgs_ref.lab.random_inputs import random_network

with np.errstate(invalid="ignore"):
    v = np.array([[0.0, 0, 0], x_a, x_c])
    unguarded = v / np.linalg.norm(v, axis=1, keepdims=True)
    weights, biases = random_network(rng, 3, 4, 2)
    _, net = mlp.forward(unguarded, weights, biases)
    first_layer = mlp.backward(net, np.ones((3, 2)))["weights"][0]
assert np.isnan(unguarded[0]).all()
assert np.isfinite(unguarded[1:]).all()
assert np.isnan(first_layer).all()
print(f"one of three rows is NaN, but {np.isnan(first_layer).sum()} of {first_layer.size} weights")

# %% [markdown]
# ## What a codec does with it
# The file contains nothing of Eq. (2), because the decoder knows the camera and computes both
# columns itself. They still have a price, namely the rows of the first layers that read them. A
# scene of this project lists its *effects*. If its list contains no effect that depends on the
# view, the columns are left out and cost nothing.

# %%
hidden = 32  # width of the hidden layers in the paper's synthetic scenes
columns = effects.view_width(("view_geometry",), "view_geometry")
price = 4 * columns * hidden * 2
print(f"{columns} columns cost no byte per anchor, but {price} bytes in four float16 networks")
assert columns == delta_vc.shape[1] + d_vc.shape[1]
assert effects.view_width((), "view_geometry") == 0

# %% [markdown]
# Encoder and decoder must compute the same view. The positions of the anchors are therefore rounded
# to a grid of $2^{16}$ values along each axis, the paper's "16-bit uniform quantization". The
# change of a direction is what the derivation above predicts: the error perpendicular to the ray,
# divided by the distance.

# %%
from p4dgs_ref.model import bounding_box, snap

cloud = rng.uniform(-1.3, 1.3, (2000, 3))
symbols, snapped = snap(cloud, *bounding_box(cloud))
camera = np.array([0.0, 0, 4])
(distance, direction), _ = view.forward(cloud, camera)
(distance_snapped, direction_snapped), _ = view.forward(snapped, camera)
error = np.linalg.norm(direction - direction_snapped, axis=1)
turn = np.degrees(error).max()
shift = np.abs(distance - distance_snapped).max()
assert symbols.max() == 2**16 - 1
assert turn < 0.001
print(f"largest change of a direction {turn:.1e} degrees, of a distance {shift:.1e}")

# %% [markdown]
# ## What this idea buys
# Without the view, trainings of `bouncing` need 37,188 bytes and reach 33.2 to 33.6 dB; with it
# they need 38,698 bytes and reach 33.5 to 33.8 dB (our record of effects). That is 0.3 dB for 1,500
# bytes, of which 256 are the weights that read the view. The gain is small, because the balls of
# this scene are nearly matte. The paper has no number for it. But in 3DGS a colour takes 48 of the
# 59 numbers of a Gaussian, and these 48 are most of what the paper's Table 3 saves.

# %%
from tutorials import gains

here = {"without the view": "without view_color", "with the view": "as listed"}
assert np.round([gains.mean(label, record="effects") for label in here.values()]).tolist() == [
    37_188,
    38_698,
]
gains.show("02_view", here, {}, "effects")

# %% [markdown]
# **In short**
# - Light depends on where one looks from, so the networks see distance and direction.
# - Nothing of Eq. (2) is stored: a decoder knows its camera.
# - The gradient of the distance points along the ray, that of the direction across it.
#
# **Often misunderstood**
# - *An anchor stores a colour.* It stores a feature; the colour is computed for each camera.
# - *The direction is that of the pixel's ray.* It is the direction to the anchor. All pixels, all
#   children of the anchor and all times share it (`Q22`).
# - *Everything must depend on the view.* In the demo only colours do. The paper's networks all see
#   it; a scene of this project lists what it needs.

# %% [markdown]
# ## Exercises
# **02.1** ●● Suppose the networks read $\ln\delta_{vc}$ in place of $\delta_{vc}$, so that another
# unit of length only shifts their input. What changes in the gradient? Give $\bar x_a$ `[2, 3]` of
# the anchor of "By hand" and of one ten times as far from the camera in the same direction, when
# the logarithm has the cotangent $49$.
#
# **02.2** ●● Write Eq. (2). The checks contain lengths near `1e200` and `1e-200` and a camera at
# the position of an anchor. `np.hypot` and `np.where` help.
#
# **02.3** ●●● Write its backward: two terms, and zero where the distance is zero.
#
# **Predict, then run.** A port (a new implementation) computes the distance in float16, as the root
# of the sum of squares. An anchor is $300$ units away along x. Which distance and which direction
# does the port compute?

# %%
answer_1 = ...


def my_forward(x_a, x_c):
    """Return delta_vc [A, 1] and d_vc [A, 3] for x_a [A, 3] and x_c [3]."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return {"x_a": gradient [A, 3]}.

    cotangents["delta_vc_bar"] has the shape [A, 1] and cotangents["d_vc_bar"] the shape [A, 3].
    """
    raise NotImplementedError


lessons.check_number("02.1", answer_1)
lessons.check_forward("02.2", my_forward, "view")
lessons.check_backward("02.3", my_backward, "view")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only view` compares what a port wrote. The usual mistake is a
# direction that points from the anchor *to* the camera. A network that is trained with the wrong
# sign adapts to it, so training does not show the mistake. A file from another encoder shows it,
# and so does the checker.


# %%
def to_camera(x_a, x_c):
    (delta_vc, d_vc), _ = view.forward(x_a, x_c)
    return delta_vc, -d_vc


lessons.passes("view")
lessons.check_mistake(to_camera, "view", "to the camera")

# %% [markdown]
# ## For ports
# The square of a length near `1e200` is larger than any float, so Eq. (2) as printed gives
# infinity. The function `numerics.length` therefore uses `np.hypot`, which computes $\sqrt{a^2 +
# b^2}$ without squaring large numbers.

# %%
far = np.array([[2e200, -3e200, 6e200]])
with np.errstate(over="ignore"):
    printed = np.sqrt((far**2).sum())
(with_hypot, _), _ = view.forward(far, np.zeros(3))
assert np.isinf(printed)
assert close(with_hypot[0, 0], 7e200)
print("printed formula", printed, "| with hypot", with_hypot[0, 0])

# %% [markdown]
# The gradient of the direction has a weakness, too. Let $e_i$ be component $i$ of $e = d_{vc}$. If
# the direction nearly follows axis $i$, then $e_i$ is almost 1, and
# $\bar e_i - e_i\,(e\cdot\bar e)$ subtracts two nearly equal numbers. The code avoids this by
# writing the first term as $\bar e_i \sum_j e_j^2$, because the squares add up to 1:
# $$\bar e_i - e_i\,(e\cdot\bar e) = \sum_j (\bar e_i\,e_j - e_i\,\bar e_j)\,e_j$$
# The two equal terms with $j = i$ now cancel exactly, before any rounding. The function
# `numerics.perpendicular` computes this sum. The cell below compares both forms in single
# precision.

# %%
from p4dgs_ref.equations.numerics import perpendicular

nearly_x = np.array([[1000.0, 0.125, 0]], dtype=np.float32)
(length, unit), _ = view.forward(nearly_x, np.zeros(3))
bar = np.array([[1, 0, 0]], dtype=np.float32)
as_sum = (perpendicular(unit, bar) / length)[0, 0]
along = unit * (unit * bar).sum()
textbook = ((bar - along) / length)[0, 0]
exact = 0.125**2 / (1000.0**2 + 0.125**2) ** 1.5  # (1 - d_x^2) / delta
assert as_sum.dtype == np.float32
assert abs(as_sum - exact) < 1e-6 * exact
assert abs(textbook - exact) > 0.5 * exact
print(f"exact {exact:.6e}, as a sum {as_sum:.6e}, textbook form {textbook:.6e}")
