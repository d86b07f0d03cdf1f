# %% [markdown]
# # Eq. (2): from how far, and from where, an anchor is seen
#
# **Promise.** After this you can derive the gradient of a length and of a direction, and say why the second has no radial part.
# **Before it:** `01_offsets`. **Takes** two seconds of machine time on two cores, twenty minutes of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS, effects
from p4dgs_ref.equations import mlp, view
from p4dgs_ref.model import bounding_box, snap
from p4dgs_ref.school import lessons

plt = lessons.pyplot()

# %% [markdown]
# ## Claim
# The networks that predict opacity, colour, rotation and scale see, beside the anchor's feature, a distance and a direction:
# $$\delta_{vc} = \| x_a - x_c \|_2, \quad d_{vc} = \frac{x_a-x_c}{\| x_a - x_c \|_2} \tag{2}$$
# $x_c$ is the camera's place. The direction points *from the camera to the anchor*.

# %% [markdown]
# ## By hand
# An anchor at $(3, -1, 7)$, a camera at $(1, 2, 1)$: the difference is $(2, -3, 6)$, its length 7.
# The direction is that difference divided by 7, and its own length is 1.

# %%
x_a, x_c = np.array([3.0, -1, 7]), np.array([1.0, 2, 1])
v = x_a - x_c
length = (2 * 2 + 3 * 3 + 6 * 6) ** 0.5
d = v / length
assert v.tolist() == [2, -3, 6] and length == 7 and abs((d * d).sum() - 1) < 1e-15
print("distance", length, "direction", d.round(4))

# %% [markdown]
# ## In code
# For `A` anchors and one camera: `x_a (A, 3)`, `x_c (3,)` give `delta_vc (A, 1)` and `d_vc (A, 3)`. The distance keeps an
# axis of length one, so that it can stand beside the feature as a column.

# %%
out, res = view.forward(x_a[None], x_c)
assert out.delta_vc.shape == (1, 1) and out.d_vc.shape == (1, 3)
assert out.delta_vc[0, 0] == length and np.allclose(out.d_vc[0], d, rtol=1e-15)

# %% [markdown]
# Two lines of `view.py` are not the printed formula. Lengths near `1e200` have squares beyond the range of floats; `np.hypot`,
# $\sqrt{a^2 + b^2}$ computed without leaving that range, does not mind. And the division is by 1 where the distance is 0, so an
# anchor inside the camera has the direction zero.

# %%
far = np.array([[2e200, -3e200, 6e200]])
with np.errstate(over="ignore"):
    literal = np.sqrt((far**2).sum())
assert literal == np.inf and np.isclose(
    view.forward(far, np.zeros(3))[0].delta_vc[0, 0], 7e200, rtol=1e-15
)
inside = view.forward(x_c[None], x_c)[0]
divisor = np.where(inside.delta_vc > 0, inside.delta_vc, 1)
assert inside.delta_vc[0, 0] == 0 and divisor[0, 0] == 1 and not inside.d_vc.any()
print("literal length", literal, "| with hypot", view.forward(far, np.zeros(3))[0].delta_vc[0, 0])

# %% [markdown]
# ## Backward by hand
# Let $v = x_a - x_c$. Begin on a line, where $v$ is a number: the length is $\delta = |v|$, the direction its sign, $\pm 1$. A
# small step $dv$ changes the length by $\pm dv$ and the direction not at all, away from $v = 0$. So $\bar v = \pm\bar\delta$, and
# nothing comes from the direction. Since $dv = dx_a$, $\bar x_a = \bar v$.

# %%
for on_a_line in (3.0, -0.5):
    o, r = view.forward(np.array([[on_a_line, 0, 0]]), np.zeros(3))
    assert view.backward(r, delta_vc_bar=np.array([[2.0]]))["x_a"][0, 0] == 2 * np.sign(on_a_line)
    assert view.backward(r, d_vc_bar=np.array([[5.0, 0, 0]]))["x_a"][0, 0] == 0

# %% [markdown]
# Three axes, the length first. Differentiate $\delta^2 = v\cdot v$ on both sides:
# $$2\,\delta\,d\delta = 2\,v\cdot dv \;\Rightarrow\; d\delta = d_{vc}\cdot dv \;\Rightarrow\; \bar v = d_{vc}\,\bar\delta.$$
# The gradient of a length is the unit vector along it. In code: `x_a_bar += res.d_vc * delta_vc_bar`. For the anchor of "By hand"
# and $\bar\delta = 7$ it is 2, -3, 6.

# %%
rng = np.random.default_rng(2)
A = 5
anchors, delta_bar, d_bar = (
    rng.normal(size=(A, 3)),
    rng.normal(size=(A, 1)),
    rng.normal(size=(A, 3)),
)
out, res = view.forward(anchors, x_c)
assert np.array_equal(view.backward(res, delta_vc_bar=delta_bar)["x_a"], out.d_vc * delta_bar)
assert np.allclose(d * 7, [2, -3, 6], rtol=1e-15)

# %% [markdown]
# Now the direction, by the rule for quotients; the last step puts in $v = \delta\,d_{vc}$ and $d\delta = d_{vc}\cdot dv$:
# $$dd_{vc} = \frac{dv}{\delta} - \frac{v\,d\delta}{\delta^2} = \frac{1}{\delta}\bigl(I - d_{vc}d_{vc}^T\bigr)\,dv$$
# On the left stands the change of $d_{vc}$. The bracket is a *projector*: it takes away what lies along $d_{vc}$ and keeps what
# lies across.

# %%
P = np.eye(3) - out.d_vc[:, :, None] * out.d_vc[:, None, :]  # (A, 3, 3)
assert np.allclose(P @ P, P, atol=1e-15) and np.allclose(P @ out.d_vc[..., None], 0, atol=1e-15)
step = 1e-6 * rng.normal(size=(A, 3))
turned = view.forward(anchors + step, x_c)[0].d_vc - view.forward(anchors - step, x_c)[0].d_vc
assert np.allclose(turned / 2, (P @ step[..., None])[..., 0] / out.delta_vc, rtol=1e-6, atol=1e-12)

# %% [markdown]
# From $dy = M\,dv$ follows $\bar y\cdot dy = (M^T\bar y)\cdot dv$: a backward uses the transpose. This matrix is its own:
# $$\bar x_a = d_{vc}\,\bar\delta_{vc} + \frac{1}{\delta_{vc}}\bigl(\bar d_{vc} - d_{vc}\,(d_{vc}\cdot\bar d_{vc})\bigr)$$
# Far anchors turn little: hence the $1/\delta$. "By hand" with $\bar d_{vc} = (343, 0, 0)$ alone: 45, 6, -12.

# %%
assert np.allclose(
    (np.array([343, 0, 0]) - d * (d @ [343, 0, 0])) / length, [45, 6, -12], rtol=1e-14
)
ours = view.backward(res, delta_bar, d_bar)["x_a"]
along = (out.d_vc * d_bar).sum(axis=1, keepdims=True)
assert np.allclose(
    ours, out.d_vc * delta_bar + (d_bar - out.d_vc * along) / out.delta_vc, rtol=1e-12
)
move = rng.normal(size=(A, 3))  # the adjoint identity
up, down = (view.forward(anchors + s * 1e-6 * move, x_c)[0] for s in (1, -1))
difference = ((up.delta_vc - down.delta_vc) * delta_bar).sum() / 2e-6 + (
    (up.d_vc - down.d_vc) * d_bar
).sum() / 2e-6
assert abs(difference - (ours * move).sum()) < 1e-8 * abs(difference)
print(f"by differences {difference:.9f}, by gradient {(ours * move).sum():.9f}")

# %% [markdown]
# In pictures: what a cotangent becomes at anchors around the camera. The length sends back arrows of one size, all radial.
# The direction sends back arrows without any radial part, shorter with distance.

# %%
angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 12, endpoint=False), [1.0, 2.5, 4.0])
ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius], axis=-1).reshape(
    -1, 3
)
seen, ring_res = view.forward(ring, np.zeros(3))
of_length = view.backward(ring_res, delta_vc_bar=np.ones((len(ring), 1)))["x_a"]
of_direction = view.backward(ring_res, d_vc_bar=np.tile([1.0, 0, 0], (len(ring), 1)))["x_a"]
assert np.allclose((of_direction * seen.d_vc).sum(axis=1), 0, atol=1e-15)
figure, axes = plt.subplots(1, 2, figsize=(11, 6), sharey=True, layout="constrained")
for ax, arrows, what in (
    (axes[0], of_length, r"$\bar\delta_{vc} = 1$ gives: along the ray, equally long"),
    (axes[1], of_direction, r"$\bar d_{vc} = (1, 0, 0)$ gives: across, fading as $1/\delta_{vc}$"),
):
    color = lessons.COLORS[0] if ax is axes[0] else lessons.COLORS[1]
    ax.plot(0, 0, "k^", ms=14, ls="none", label="camera")
    ax.plot(*ring[:, :2].T, "o", ms=6, color="0.5", label="anchors")
    ax.quiver(
        *ring[:, :2].T,
        *arrows[:, :2].T,
        color=color,
        angles="xy",
        scale_units="xy",
        scale=0.8,
        width=0.008,
        zorder=3,
    )
    ax.plot([], [], color=color, label=r"gradient $\bar x_a$, 1 drawn as 1.25")
    ax.set(xlabel="x (scene units)", aspect="equal", xlim=(-5.6, 5.6), ylim=(-5.6, 5.6))
    ax.set_title(what, fontsize=14)
    ax.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.12),
        ncols=3,
        fontsize=11,
        columnspacing=1,
        handletextpad=0.4,
    )
axes[0].set_ylabel("y (scene units)")
figure.suptitle("What a distance and a direction send back to an anchor", fontsize=16)
lessons.show(figure, "02_view")

# %% [markdown]
# One thing remains. Where the view nearly follows an axis, $1 - d_i^2$ subtracts two almost equal numbers. `view.across` puts
# in $1 = \sum_j d_j^2$ first, and then the equal terms, those with $j = i$, are gone before anything is computed:
# $$\bar d_i - d_i\,(d\cdot\bar d) = \sum_j (\bar d_i\,d_j - d_i\,\bar d_j)\,d_j$$
# Measured in single precision:

# %%
nearly_x = np.array([[1000.0, 0.125, 0]], dtype=np.float32)
small, small_res = view.forward(nearly_x, np.zeros(3))
bar = np.array([[1, 0, 0]], dtype=np.float32)
minors = view.backward(small_res, d_vc_bar=bar)["x_a"][0, 0]
literal = ((bar - small.d_vc * (small.d_vc * bar).sum()) / small.delta_vc)[0, 0]
exact = 0.125**2 / (1000.0**2 + 0.125**2) ** 1.5  # (1 - d_x^2) / delta
assert (
    minors.dtype == np.float32
    and abs(minors - exact) < 1e-6 * exact
    and abs(literal - exact) > 0.5 * exact
)
print(f"exact {exact:.6e}, by minors {minors:.6e}, literally {literal:.6e}")

# %% [markdown]
# ## Break it
# Treat the length under the fraction as a constant: $\bar v = \bar d / \delta$, no projector. The shape is right, and for every
# step *across* the ray the adjoint identity holds to the last digits. A step *along* the ray betrays it.

# %%
broken = d_bar / out.delta_vc
ours = view.backward(res, d_vc_bar=d_bar)["x_a"]
across = move - out.d_vc * (out.d_vc * move).sum(axis=1, keepdims=True)
assert abs(((broken - ours) * across).sum()) < 1e-13
further = anchors + 0.01 * out.d_vc
assert np.allclose(
    view.forward(further, x_c)[0].d_vc, out.d_vc, atol=1e-15
)  # walking away turns nothing
claimed = (broken * out.d_vc).sum(axis=1)
assert np.abs(claimed).min() > 0.01 and np.abs((ours * out.d_vc).sum(axis=1)).max() < 1e-15
print("change of the loss per unit walked away; truth: 0; broken:", claimed.round(3))

# %% [markdown]
# The other mistake is to divide without looking: one anchor inside the camera, and its direction is $0/0$. That is one row of
# many. But all rows share the weights of a network (`03_opacity_and_masking` shows how), and after one backward through it
# *every* weight that met a direction is not a number.

# %%
with np.errstate(invalid="ignore"):
    difference = np.array([[0.0, 0, 0], [1, 2, 2], [2, -3, 6]])
    literal = difference / np.linalg.norm(difference, axis=1, keepdims=True)
    W, b = mlp.random_network(rng, 3, 4, 2)
    weights_bar = mlp.backward(mlp.forward(literal, W, b)[1], np.ones((3, 2)))["weights"][0]
assert np.isnan(literal).any(axis=1).sum() == 1 and np.isnan(weights_bar).all()
print(
    f"rows not finite: one of three; weights' gradients not finite: {np.isnan(weights_bar).sum()} of {weights_bar.size}"
)

# %% [markdown]
# ## What a codec does with it
# Nothing of Eq. (2) is sent: the decoder knows the camera and computes the columns anew. Their price is the rows that read them
# in the networks' first layers. A scene of this project lists its *effects*; where looks that depend on the view are not among
# them, the columns are left out and cost nothing at all.

# %%
d, hidden = 16, 32  # the paper's synthetic scenes
columns = effects.view_width(("view_geometry",), "view_geometry")
print(
    f"{columns} columns for 0 bytes per anchor; rows that read them: {4 * columns * hidden * 2} bytes in four float16 networks"
)
assert columns == 4 and effects.view_width((), "view_geometry") == 0

# %% [markdown]
# Encoder and decoder must see the same view. Positions travel on a lattice of `2**16` values per axis, the paper's "16-bit
# uniform quantization"; what its step does to a direction is Eq. (2) once more: sideways error over distance.

# %%
cloud = rng.uniform(-1.3, 1.3, (2000, 3))
lattice, snapped = snap(cloud, *bounding_box(cloud))
camera = np.array([0.0, 0, 4])
before, after = (view.forward(x, camera)[0] for x in (cloud, snapped))
degrees = np.degrees(np.linalg.norm(before.d_vc - after.d_vc, axis=1))
assert lattice.max() == 2**16 - 1 and degrees.max() < 0.001
shift = np.abs(before.delta_vc - after.delta_vc).max()
print(f"largest change of a direction {degrees.max():.1e} degrees, of a distance {shift:.1e}")

# %% [markdown]
# ## Exercises
# **02.1** The anchor of "By hand" moves by $(0.7, 0, 0)$. By how much does its distance change, to first order?
# **02.2** Write Eq. (2); lengths near `1e200` and `1e-200` and a camera inside an anchor are among the checks: what can
# `np.hypot` and `np.where` do for you? **02.3** Write its backward: two terms, and zero where the distance is.

# %%
answer_1 = ...


def my_forward(x_a, x_c):
    """x_a (A, 3), x_c (3,) -> delta_vc (A, 1), d_vc (A, 3)."""
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """{"x_a": gradient (A, 3)} from cotangents["delta_vc_bar"] (A, 1) and ["d_vc_bar"] (A, 3)."""
    raise NotImplementedError


lessons.number(
    "02.1",
    answer_1,
    view.backward(view.forward(x_a[None], x_c)[1], np.ones((1, 1)))["x_a"][0] @ [0.7, 0, 0],
)
lessons.forward("02.2", my_forward, "view")
lessons.backward("02.3", my_backward, "view")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only view` reads what a port wrote. The usual slip is a direction from the anchor *to* the
# camera. A network trained with it hides it; a file from another encoder does not. The checker names it:

# %%
from p4dgs_ref import oracle


def to_camera(x_a, x_c):
    out = view.forward(x_a, x_c)[0]
    return out.delta_vc, -out.d_vc


print(oracle.check(lambda x_a, x_c: view.forward(x_a, x_c)[0], "view"))
assert oracle.check(lambda x_a, x_c: view.forward(x_a, x_c)[0], "view").ok
assert "to the camera" in oracle.check(to_camera, "view").first.explanation
print(oracle.check(to_camera, "view").first.explanation)
assert EQUATIONS["view"].number == "2"
