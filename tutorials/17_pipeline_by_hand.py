# %% [markdown]
# # Eq. (1) to Eq. (17): the whole pipeline by hand, one anchor and one pixel
#
# **Promise.** After this tutorial you have followed one anchor through every equation, to a colour
# and to a number of bits, with code as simple as a pocket calculator, and you know what is lost if
# two right equations are connected wrongly. **Before it:** `01_offsets` to `16_render_loss`.
# **Takes** five seconds on two cores, 40 minutes of reading and 50 of exercises.
#
# **Files:** [model.py](../p4dgs_ref/model.py), [render.py](../p4dgs_ref/splatting/render.py),
# [objective.py](../p4dgs_ref/training/objective.py).

# %%
import math
from dataclasses import replace

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("17_pipeline_by_hand")

# %% [markdown]
# ## What fails without it
# Every equation can be right and the picture wrong, because one output is connected to the wrong
# input. All shapes fit, so nothing is reported: the direction stands where a network expects the
# distance, or four quaternions are read component by component instead of child by child.
#
# The cell makes three such mistakes in the trained scene of `demo.p4dgs`, one at a time, and
# changes no equation. The pictures show one view, and the numbers above them are means over the ten
# test views. The splats of *anchor 29*, which leads through the tutorials, are ringed in purple.

# %%
from p4dgs_ref import evaluate, load_scene

trained, thread, scene = tour.MODEL, figures.THREAD, load_scene("bouncing")
d, k = trained.design.d, trained.design.k


def with_network(name, first, last, last_bias):
    """The trained model with other first and last layers in one network."""
    (_, *middle, _), (*biases, _) = trained.networks[name]
    network = [first, *middle, last], [*biases, last_bias]
    return replace(trained, networks=trained.networks | {name: network})


(first, *_, last), (*_, last_bias) = trained.networks["psi_c"]
direction_first = [*range(d), d + 3, d, d + 1, d + 2]  # the row that meets each input
wrong_order = with_network("psi_c", first[direction_first], last, last_bias)
(first, *_, last), (*_, last_bias) = trained.networks["psi_r"]
axis_by_axis = np.arange(4 * k).reshape(4, k).T.ravel()
wrong_axes = with_network("psi_r", first, last[:, axis_by_axis], last_bias[axis_by_axis])
s_a, l_a = trained.anchors.s_a, trained.anchors.l_a
exchanged = replace(trained, anchors=trained.anchors._replace(s_a=l_a, l_a=s_a))
joined = {
    "as trained": trained,
    "direction before distance": wrong_order,
    "quaternions out of order": wrong_axes,
    "$s_a$ and $l_a$ exchanged": exchanged,
}
scores = {name: evaluate(model, scene)[0]["psnr_db"] for name, model in joined.items()}
print({name: f"{score:.1f} dB" for name, score in scores.items()})
assert np.allclose([*scores.values()], [33.5, 21.3, 25.3, 16.0], atol=0.1)

# %%
titles = {f"{name}\n{scores[name]:.1f} dB": model for name, model in joined.items()}
show.compared("17_joined_wrongly", titles, tour.CAMERA, tour.T, tour.VIEW)

# %% [markdown]
# ## Claim
# Sixteen tutorials explained one part each. This one connects them. Two chains of computation start
# at an anchor. The first computes what we *see*: the Gaussians, the Gaussians at time $t$, the
# colour $C(p)$ of a pixel $p$, and its error. The second computes what we *pay*: the hash feature
# at the anchor's position, steps and probabilities, and bits. Eq. (15) adds the two results.
# $$\begin{gathered}
#   \text{anchor} \xrightarrow{(1)-(4)} \text{Gaussians} \xrightarrow{(5), (6)}
#   \text{Gaussians at } t \to C(p) \xrightarrow{(16)} \mathcal{L}_{render}\\
#   x_a \xrightarrow{(9)} h \xrightarrow{(8), (12)} q, \mu, \sigma
#   \xrightarrow{(7), (11)} \text{bits} \xrightarrow{(13), (14), (17)} \mathcal{L}_{rate}
#   \end{gathered}$$
#
# Training asks the opposite question: how should each number of the anchor change to reduce the
# loss? The backward therefore follows the same arrows from right to left. No other order is
# possible, because the gradient of a child depends on the gradient of its splat, which depends on
# the gradient of the pixel. So the backward goes through compositing, projection and deformation to
# Eqs. (4) to (1). Read the table downwards for the forward and upwards for the backward:
#
# | stage | reads | makes | backward: from gradients of | to gradients of |
# |---|---|---|---|---|
# | (1) to (4) | anchor, camera | Gaussians | Gaussians | anchor, its networks |
# | (5), (6) | Gaussians, $t$ | Gaussians at $t$ | Gaussians at $t$ | Gaussians, $\psi_d$ |
# | projection | Gaussians at $t$, camera | splats | splats | Gaussians at $t$ |
# | compositing | splats | picture | picture | splats |
# | (16) | picture, truth | $\mathcal{L}_{render}$ | $\mathcal{L}_{render}$ | picture |
#
# Where one number is used several times, its gradients add up. The feature $f_a$ is an input of
# four networks in the first chain, and the second counts its bits. It therefore receives five
# gradients: four to improve the picture, and one to make the file smaller.

# %% [markdown]
# ## By hand
# A person can compute only with a smaller model than the demo's, in which an anchor has 16 features
# and 34 coded numbers. Ours has one anchor, at the origin, with the features $(0.5, -1)$ and two
# children, $k = 2$. The camera is at $(0, 0, -4)$ and looks along the z axis. The weights of the
# networks are random multiples of one sixteenth. An anchor network has 2 + 1 + 3 = 6 inputs, namely
# the features, the distance and the direction, and one hidden layer of 3 units.

# %%
from p4dgs_ref.model import Anchors, Design, context, predict
from p4dgs_ref.scenes.scene import MODEL_EFFECTS

design = Design(
    d=2,
    k=2,
    hidden=(3,),
    deformation=(3,),
    L_x=1,
    L_t=1,
    context=(),
    F=1,
    table=(8, 4),
    tau_alpha=0.0,
    grid=(("xyz", 2), ("xy", 2), ("xz", 2), ("yz", 2)),
    Q_0=(0.25, 0.0625, 0.0625, 0.125),
    effects=MODEL_EFFECTS,
)
x_a = [0, 0, 0]
f_a = [0.5, -1.0]
s_a = [0.75, 0.5, 0.625]
l_a = [0.5, 0.5, 0.5]
O_a = [[0.5, 0.0, 0.0], [-0.5, 0.5, 1.0]]
x_c = [0, 0, -4]
t = 0.5
p = (18, 12)  # column and row of our pixel
white = [1.0, 1.0, 1.0]


def say(name, values):
    print(f"{name:26s}", " ".join(f"{v:.4f}" for v in np.ravel(values)))


# %%
rng = np.random.default_rng(3524)


def draw(*shape):
    return rng.integers(-8, 9, shape) / 16


networks = {}
for name, layers in design.layers().items():
    weights = [draw(*rows_and_columns) for rows_and_columns in layers]
    biases = [draw(columns) for _, columns in layers]
    networks[name] = (weights, biases)
networks["psi_alpha"][1][-1] += [1, 1]  # both children are visible
for part in networks["psi_d"]:
    for head in part[1:]:
        head /= 8  # the changes of Eq. (5) stay small
assert design.layers()["psi_alpha"] == [(6, 3), (3, 2)]

# %% [markdown]
# **View**, Eq. (2): the distance is 4 and the direction $(0, 0, 1)$. **Offsets**, Eq. (1): the
# children are at $(0.25, 0, 0)$ and $(-0.25, 0.25, 0.5)$. **Prediction**, Eqs. (3) and (4): four
# networks read the features, the distance and the direction, and return opacities, colours,
# rotations and scales.


# %%
def dense(x, W, b):
    y = [sum(x[n] * W[n][j] for n in range(len(x))) + b[j] for j in range(len(b))]
    return y


def relu(x):
    return [max(0.0, v) for v in x]


def sigmoid(v):
    return 1 / (1 + math.exp(-v))


def unit(r):
    length = math.sqrt(sum(v * v for v in r))
    return [v / length for v in r]


def add(a, b):
    return [u + v for u, v in zip(a, b)]


def spatial(f_a):
    """Eqs. (1) to (4): the two children of the anchor, and what its networks read."""
    to_anchor = [a - c for a, c in zip(x_a, x_c)]
    delta_vc = math.sqrt(sum(v * v for v in to_anchor))
    d_vc = [v / delta_vc for v in to_anchor]
    seen = [*f_a, delta_vc, *d_vc]
    psi = {}
    for name in ("psi_alpha", "psi_c", "psi_r", "psi_s"):
        (W0, W1), (b0, b1) = networks[name]
        hidden = relu(dense(seen, W0, b0))
        psi[name] = dense(hidden, W1, b1)
    children = []
    for j in range(2):
        psi_s = psi["psi_s"][3 * j : 3 * j + 3]
        psi_r = psi["psi_r"][4 * j : 4 * j + 4]
        psi_c = psi["psi_c"][3 * j : 3 * j + 3]
        child = dict(
            x=[x_a[i] + O_a[j][i] * l_a[i] for i in range(3)],
            s=[s_a[i] * sigmoid(psi_s[i]) for i in range(3)],
            r=unit(psi_r),
            alpha=math.tanh(psi["psi_alpha"][j]),
            color=[sigmoid(v) for v in psi_c],
        )
        children.append(child)
    return children, seen


canonical, seen = spatial(f_a)
assert seen == [0.5, -1, 4, 0, 0, 1]
assert canonical[0]["x"] == [0.25, 0, 0]
assert canonical[1]["x"] == [-0.25, 0.25, 0.5]
for name in canonical[0]:
    say(f"{name} of both children", [child[name] for child in canonical])

# %% [markdown]
# **Deformation**, Eqs. (5) and (6), at $t = 0.5$: the position and the time are encoded as sines
# and cosines, and $\psi_d$ turns them into ten changes, three for x, three for s and four for r.
# The changes are added, and the quaternion is normalised again. Opacity and colour do not change
# with time.


# %%
def temporal(child, t):
    """Eqs. (5) and (6): a child at time t, and its changes of x, s and r."""
    x = child["x"]
    E = [*x, *map(math.sin, x), *map(math.cos, x)]
    E += [t, math.sin(t), math.cos(t)]
    (W0, *heads), (b0, *biases) = networks["psi_d"]
    hidden = relu(dense(E, W0, b0))
    delta = [dense(hidden, W, b) for W, b in zip(heads, biases)]
    at_t = dict(
        child,
        x=add(x, delta[0]),
        s=add(child["s"], delta[1]),
        r=unit(add(child["r"], delta[2])),
    )
    return at_t, delta


moved = [temporal(child, t)[0] for child in canonical]
delta = temporal(canonical[0], t)[1]
assert [len(change) for change in delta] == [3, 3, 4]
say("changes of child 0", np.concatenate(delta))

# %% [markdown]
# **Projection.** The camera is not rotated, so camera coordinates are $x' - x_c$. With a focal
# length of 40 pixels and the optical axis at pixel $(16, 12)$ we get a mean in pixels and a
# covariance $J\Sigma J^T + 0.3\,I$ in square pixels. The inverse of this covariance is the conic.


# %%
def rotation_matrix(r):
    w, x, y, z = r
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def splat(child):
    """Mean, covariance, conic and depth of a child in the picture."""
    X, Y, Z = (a - c for a, c in zip(child["x"], x_c))
    J = [
        [40 / Z, 0, -40 * X / Z**2],
        [0, 40 / Z, -40 * Y / Z**2],
    ]
    R = rotation_matrix(child["r"])
    # The columns of J R, each scaled by a deviation: their products are J Sigma J^T.
    M = np.zeros((2, 3))
    for i in range(2):
        for n in range(3):
            M[i, n] = child["s"][n] * sum(J[i][m] * R[m][n] for m in range(3))
    a = sum(M[0] * M[0]) + 0.3
    b = sum(M[0] * M[1])
    c = sum(M[1] * M[1]) + 0.3
    det = a * c - b * b
    return dict(
        mean2d=[40 * X / Z + 16, 40 * Y / Z + 12],
        cov2d=[a, b, c],
        conic=[c / det, -b / det, a / det],
        depth=Z,
    )


for name in splat(moved[0]):
    say(f"{name} of both children", [splat(child)[name] for child in moved])

# %% [markdown]
# **Compositing** at pixel $(18, 12)$, from front to back. Each splat takes a share of the light,
# which is its opacity at this pixel, and leaves the rest to the splats behind it.


# %%
def look(children):
    """The colour of our pixel, and the weights and colours of which it is made."""
    light = 1.0
    parts = []
    for child in sorted(children, key=lambda child: splat(child)["depth"]):
        u, v = splat(child)["mean2d"]
        a, b, c = splat(child)["conic"]
        e_x, e_y = p[0] - u, p[1] - v
        form = a * e_x**2 + 2 * b * e_x * e_y + c * e_y**2
        alpha = min(0.99, child["alpha"] * math.exp(-0.5 * form))
        parts.append((light * alpha, child["color"]))
        light *= 1 - alpha
    parts.append((light, white))
    color = [sum(w * c[i] for w, c in parts) for i in range(3)]
    return color, parts


pixel, parts = look(moved)
assert math.isclose(sum(w for w, _ in parts), 1)
assert parts[0][1] == moved[0]["color"]  # child 0 is in front
say("weights, background last", [w for w, _ in parts])
say("red, green, blue of p", pixel)

# %% [markdown]
# **The rate.** The anchor is in the middle of a box that extends from -1 to 1. At this point every
# level of the hash grid, Eq. (9), returns the plain mean of its signs: 8 signs in the 3D level and
# 4 in each 2D level. These four means are the hash feature $h$. From $h$, two networks compute
# steps, means and standard deviations, Eqs. (8) and (12). The anchor has $2 + 3 + 3 + 6 = 14$
# attributes, whose bits Eq. (11) gives. Eq. (14) gives those of the 20 signs of the grid. The noise
# of Eq. (7) is random; here we set it to 0. Eqs. (13) and (17) add everything up, and the sum is
# divided by 14 (choice Q12; `reference.md` lists all choices).

# %%
levels = [draw(T, F) for T, F in design.levels()]
signs = [[1 if v >= 0 else -1 for v in level.ravel()] for level in levels]
assert [len(level) for level in signs] == [8, 4, 4, 4]
h = [sum(level) / len(level) for level in signs]
(W_q,), (b_q,) = networks["psi_q"]
(W_p,), (b_p,) = networks["psi_p"]
q = [Q * (1 + math.tanh(v)) for Q, v in zip(design.Q_0, dense(h, W_q, b_q))]
psi_p = dense(h, W_p, b_p)
mu, sigma, steps = [], [], []
start = 0
for step, width in zip(q, design.widths):
    # Each group has all its means first, then the logarithms of its deviations.
    mu += psi_p[start : start + width]
    start += width
    sigma += [math.exp(v) for v in psi_p[start : start + width]]
    start += width
    steps += width * [step]


# %%
def Phi(z):
    return 0.5 * math.erfc(-z / math.sqrt(2))


values = [*f_a, *s_a, *l_a, *O_a[0], *O_a[1]]
bits = []
for f, step, m, d in zip(values, steps, mu, sigma):
    mass = Phi((f + step / 2 - m) / d) - Phi((f - step / 2 - m) / d)
    bits.append(-math.log2(mass))
count = sum(len(level) for level in signs)
n_pos = sum(level.count(1) for level in signs)
R_hash = 0
for n in (n_pos, count - n_pos):
    R_hash -= n * math.log2(n / count)
R_anchor = sum(bits)
L_rate = (R_anchor + R_hash) / len(values)
assert len(values) == 14 and count == 20
say("h: xyz, xy, xz, yz", h)
say("q of f, s, l, O", q)
say("bits of f, s, l, O", bits)
say("R_anchor, R_hash, L_rate", [R_anchor, R_hash, L_rate])

# %% [markdown]
# **The loss.** Let the true picture be our own picture of 33 x 25 pixels, except that our pixel has
# the gray value 0.5. With $\lambda_{SSIM} = 0$, Eq. (16) is then the error of this one pixel
# divided by the 2475 numbers of the picture. With $\lambda_{rate} = 0.001$, Eq. (15) completes the
# pipeline.

# %%
gray = 0.5
numbers = 33 * 25 * 3
L_render = sum(abs(c - gray) for c in pixel) / numbers
L_total = 0.001 * L_rate + L_render
print(f"L_render {L_render:.6f}, L_total {L_total:.6f}")

# %% [markdown]
# ## In code
# The package does this in four calls. `predict` is Fig. 1 up to the Gaussians at time $t$,
# `render.forward` is the last box of Fig. 1, `context` is the first half of Fig. 2, and
# `objective.loss` runs both chains and adds their results. All four must return our numbers. The
# pixel $(u, v)$ of a picture is `image[v, u]`.

# %%
from p4dgs_ref import SETTINGS, Camera, View, decode, oracle
from p4dgs_ref.equations import deformation, hash_grid
from p4dgs_ref.splatting import covariance, projection, render

EXACT = SETTINGS["exact"]


def close(a, b):
    return np.allclose(a, b, rtol=1e-12)


mask = np.ones((1, 2), bool)
background = np.array(white)
arrays = [np.array([a], float) for a in (x_a, f_a, s_a, l_a, O_a)]
anchors = Anchors(*arrays, mask)
camera = Camera(
    np.eye(3),
    -np.array(x_c, float),
    40.0,
    40.0,
    16.0,
    12.0,
    33,
    25,
)
g, _, back_g = predict(design, networks, anchors, camera.center, t)
(image, *_), saved_r = render.forward(*g[:5], camera, background, EXACT)
for name in moved[0]:
    assert close(getattr(g, name), [child[name] for child in moved])
assert close(image[p[1], p[0]], pixel)

Sigma, _ = covariance.forward(g.s, g.r)
projected, _ = projection.forward(
    g.x,
    Sigma,
    camera.R,
    camera.T,
    focal=np.array([40.0, 40.0]),
    center=np.array([16.0, 12.0]),
    size=np.array([33, 25]),
)
for name, array in zip(("mean2d", "cov2d", "conic", "depth"), projected):
    assert close(array, [splat(child)[name] for child in moved])

located = hash_grid.locate(
    arrays[0],
    -np.ones(3),
    np.ones(3),
    design.grid,
    [len(level) for level in levels],
)
ctx, _ = context(design, networks, levels, located)
assert close(ctx.q[0], q) and close(ctx.mu[0], mu) and close(ctx.sigma[0], sigma)

# %% [markdown]
# The loss expects all parameters in one object, which stores scales as logarithms (choice Q5).

# %%
from p4dgs_ref.training import objective
from p4dgs_ref.training.parameters import Parameters

flat = dict(
    x_a=arrays[0],
    f_a=arrays[1],
    log_s=np.log(arrays[2]),
    log_l=np.log(arrays[3]),
    O_a=arrays[4],
)
for name, (weights, biases) in networks.items():
    for i, (W, b) in enumerate(zip(weights, biases)):
        flat[f"{name}.W{i}"] = W
        flat[f"{name}.b{i}"] = b
for i, level in enumerate(levels):
    flat[f"grid.{i}"] = level
parameters = Parameters(flat, np.float64)
truth = image.copy()
truth[p[1], p[0]] = gray
inputs = objective.StepInputs(
    mask,
    located,
    background,
    stage=4,
    lambda_rate=0.001,
    lambda_ssim=0.0,
    settings=EXACT,
)
losses = objective.loss(
    parameters,
    design,
    networks,
    levels,
    inputs,
    View("", truth, None, camera, t),
    np.zeros((1, 14)),
)[0]
assert close(losses.L_rate, L_rate)
assert close(losses.L_render, L_render)
assert close(losses.L_total, L_total)

# %%
figure, (seen_at_t, bars) = plt.subplots(
    1, 2, figsize=(12, 4.4), layout="constrained", width_ratios=(1.25, 1)
)
seen_at_t.imshow(image.clip(0, 1))
mean2d, cov2d, *_ = show.splats(g, camera)
show.ellipses(seen_at_t, mean2d, cov2d, fc="none", ec=("C1", "C2"), lw=2)
seen_at_t.plot(*p, "s", ms=11, mfc="none", mec="k", mew=2.5)
figures.finish(
    seen_at_t,
    xlabel="u (pixels)",
    ylabel="v (pixels)",
    title="Our anchor's two children at t = 0.5 (1 sigma)",
    grid=False,
)
for i, place in enumerate(((22, 15), (6, 21))):
    seen_at_t.text(*place, f"child {i}", color=f"C{i + 1}")
seen_at_t.text(17, 8, "our pixel")
bottom = np.zeros(3)
looks = (
    ("child 0", "//", "C1", "C1"),
    ("child 1", "..", "C2", "C2"),
    ("background", "", "0.9", "k"),
)
for (weight, color), (name, hatch, paint, ink) in zip(parts, looks):
    height = weight * np.array(color)
    bars.bar(range(3), height, bottom=bottom, color=paint, hatch=hatch, edgecolor="k")
    bars.text(2.5, bottom[2] + height[2] / 2, name, color=ink, va="center")
    bottom += height
bars.grid(axis="x", visible=False)
figures.finish(
    bars,
    xticks=range(3),
    xticklabels=["red", "green", "blue"],
    ylabel="value",
    title="The contributions to our pixel",
    xlim=(-0.5, 3.5),
    ylim=(0, 0.7),
)
figures.show(figure, "17_pipeline_by_hand")

# %% [markdown]
# **Anchor 29** goes through the same two chains. The cell takes the pixel on which its child 2 is
# centred. Many Gaussians lie there, one behind another, and anchor 29 gives 7 percent of the
# pixel's light. The second chain counts what it costs in the file.

# %%
from p4dgs_ref.report.inspect import anchor_bits

of_view = trained.gaussians(tour.T, tour.CAMERA)
mine = of_view.index // k == thread.index
(child,) = np.flatnonzero(of_view.index == k * thread.index + thread.child)
at = np.rint(show.to_pixels(of_view.x[child], tour.CAMERA))
order, given, behind = show.front_to_back(of_view, tour.CAMERA, at)
share = given[mine[order]].sum()
_, costs = anchor_bits(tour.DATA)
print(f"pixel {at.astype(int)}: anchor 29 gives {share:.0%} of its light")
assert round(share, 2) == 0.07
print(f"anchor 29 costs {costs[thread.index]:.0f} bits, the mean anchor {costs.mean():.0f}")

# %% [markdown]
# ## Backward by hand
# How does the blue value of the pixel depend on feature 0? There are many paths. One of them goes
# through the blue value $c$ of child 0. Follow it backwards from the pixel, and sum over the active
# hidden units $m$ of $\psi_c$ (their input is positive, so the ReLU passes the gradient):
# $$\frac{\partial C_{blue}}{\partial f_0} = \underbrace{\alpha_0 T_0}_{weight}\cdot
#   \underbrace{c(1-c)}_{sigmoid'}\cdot
#   \sum_{m:\,\text{active}} W^0_{0,m}\,W^1_{m,2} + \text{other paths}.$$

# %%
(W0, W1), (b0, b1) = networks["psi_c"]
active = [v > 0 for v in dense(seen, W0, b0)]
weight = parts[0][0]
blue = canonical[0]["color"][2]
through_network = sum(W0[0][m] * W1[m][2] for m in range(3) if active[m])
path = weight * blue * (1 - blue) * through_network

zero = {
    f"{name}_bar": np.zeros_like(getattr(g, name)) for name in ("x", "s", "r", "alpha", "color")
}


def feature_0_bar(**cotangents):
    """The gradient of feature 0 for cotangents of the Gaussians; those left out are zero."""
    anchors_bar, _ = back_g(**{**zero, **cotangents})
    return anchors_bar["f_a"][0, 0]


color_bar = np.zeros_like(g.color)
color_bar[0, 2] = weight  # the cotangent that compositing sends to this colour
assert math.isclose(feature_0_bar(color_bar=color_bar), path, rel_tol=1e-10)
say("weight, slope, product", [weight, blue * (1 - blue), path])

# %% [markdown]
# Now take all paths together. We set the cotangent of our pixel's blue value to one and all others
# to zero. `render.backward` returns the gradients of all Gaussians at $t$, and `back_g` takes them
# back through Eqs. (6) to (1), where each of the four networks adds its share to the gradient of
# $f_0$. The positions add nothing, because Eq. (1) contains no feature. We compare the sum with a
# finite difference of our pocket-calculator code. This single number tests the derivations of
# Eqs. (3), (4) and (6) and of all of splatting.


# %%
def blue_at(f_0):
    children, _ = spatial([f_0, f_a[1]])
    color, _ = look([temporal(child, t)[0] for child in children])
    return color[2]


image_bar = np.zeros_like(image)
image_bar[p[1], p[0], 2] = 1
bars_g = render.backward(saved_r, image_bar)
shares = {
    name: feature_0_bar(**{f"{name}_bar": bars_g[name]})
    for name in ("x", "s", "r", "alpha", "color")
}
together = sum(shares.values())
by_difference = (blue_at(f_a[0] + 1e-6) - blue_at(f_a[0] - 1e-6)) / 2e-6
assert shares["x"] == 0
assert abs(by_difference - together) < 1e-9
print("through", {name: f"{value:+.5f}" for name, value in shares.items()})
print(f"together {together:+.6f}, by differences {by_difference:+.6f}")

# %% [markdown]
# ## Break it
# Not every wrong connection is as visible as those at the beginning. Suppose we forget to normalise
# the quaternion after adding $\Delta r$. This mistake is easy to make, because Eq. (6) does not
# print the normalisation (choice Q9). The picture still looks right: with a quaternion of another
# length, the splat is rotated and stretched only a little differently, and no pixel changes by more
# than 0.1. The golden vectors of this stage compare $r'$ itself, so they find the mistake and name
# Eq. (6).


# %%
def careless(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    delta, _ = deformation.forward(x, t, psi_d_weights, psi_d_biases, L_x, L_t)
    changed = [a + change if change.shape[1] else a for a, change in zip((x, s, r), delta)]
    return tuple(changed)


places = np.array([child["x"] for child in canonical])
scales = np.array([child["s"] for child in canonical])
turns = np.array([child["r"] for child in canonical])
odd = careless(places, scales, turns, t, 1, 1, *networks["psi_d"])
(odd_image, *_), _ = render.forward(*odd, g.alpha, g.color, camera, background, EXACT)
change = np.abs(odd_image - image).max()
verdict = oracle.check(careless, "temporal_prediction")
print(f"largest change of the picture {change:.3f}")
print(f"first divergence: {verdict.first.equation}, {verdict.first.findings[0].tensor}")
assert verdict.first.equation == "deformed"
assert 0 < change < 0.1

# %% [markdown]
# ## What this idea buys
# A wrong connection can cost as much as a wrong equation: the three mistakes at the beginning cost
# 8 to 17 dB. Others cost little and may stay unnoticed for years. The next cell gives the networks
# the translation $T$ of the camera's matrix where Eq. (2) means the camera's centre, $-R^T T$. The
# colours still change with the view, only not as in training. The paper has no numbers for
# mistakes.

# %%
errors = []
for view in scene.test:
    drawn = predict(trained.design, trained.networks, trained.anchors, view.camera.T, view.time)[0]
    (picture, *_), _ = render.forward(*drawn[:5], view.camera, trained.background, EXACT)
    errors.append(np.mean((picture.clip(0, 1) - view.image) ** 2))
quality = np.mean(-10 * np.log10(errors))
print(f"T in place of the centre: {quality:.1f} dB instead of 33.5 dB")
assert 32 < quality < 33

# %% [markdown]
# **In short**
# - Two chains start at an anchor: what is seen, and what is paid. Eq. (15) adds their ends.
# - The backward follows the same connections from right to left and adds where a number is used
#   more than once.
# - A wrong connection has right shapes. Only a comparison of numbers shows it.
#
# **Often misunderstood**
# - *If every equation is checked, the pipeline is right.* Equations say nothing of the order of
#   inputs, or of which axis comes first.
# - *A missing gradient shows in the loss.* The rest of the gradient still makes a part of the loss
#   fall, and the picture gets worse (`19_one_training_step` tries it).
# - *Each network has a feature of its own.* All four read $f_a$, which gets four gradients from the
#   picture, and one from its bits.

# %% [markdown]
# ## Exercises
# **17.1** ● What is the colour of the pixel at $t = 0$, as three numbers? (At $t = 0.5$ it is
# `pixel`.)
#
# **17.2** ●● Write Eqs. (1) to (4) and the masking for arrays. If `effects` lacks `view_geometry`,
# the networks $\psi_\alpha$, $\psi_r$ and $\psi_s$ read the features only. If it lacks
# `view_color`, the same holds for $\psi_c$. To leave the view out, give a network two arrays of
# shape `(A, 0)` in place of the outputs of Eq. (2).
#
# **17.3** ●●● Write the backward of all these equations together. You may use the modules of
# `p4dgs_ref.equations`, because the exercise is about how they are connected.
#
# **Predict, then run.** The anchor and the camera move together by $(1, 0, 0)$. Which of the
# canonical Gaussian's attributes change? Does the pixel at $t = 0.5$ change?

# %%
answer_1 = ...


def my_forward(x_a, f_a, s_a, l_a, O_a, mask, x_c, tau_alpha, effects, **networks):
    """Return {"x", "s", "r", "alpha", "color", "index"} of the Gaussians that are kept.

    `networks` holds psi_alpha_weights, psi_alpha_biases, psi_c_weights and so on.
    """
    raise NotImplementedError


def my_backward(inputs, cotangents):
    """Return the gradients {"x_a", "f_a", "s_a", "l_a", "O_a"}.

    The cotangents are "x_bar", "s_bar", "r_bar", "alpha_bar" and "color_bar".
    """
    raise NotImplementedError


lessons.check_number("17.1", answer_1)
lessons.check_forward("17.2", my_forward, "spatial_prediction")
lessons.check_backward("17.3", my_backward, "spatial_prediction", "x_a", "f_a", "s_a", "l_a", "O_a")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only frames` compares whole pictures of a trained model, so run it
# last. The port below decodes the model from its file and renders it with the cameras of the
# vectors. If frames differ although all single equations agree, a connection between them is wrong:
# the order of features, distance and direction, the camera's centre, or the depth order. The
# renderer's setting `kernel`, which follows the published kernel of 3DGS, has the name "paper" in
# the vectors.

# %%
golden = decode((oracle.path() / "model.p4dgs").read_bytes())


def port(W, T, focal, center, size, t, renderer, **of_the_model):
    width, height = (int(n) for n in size)
    seen_by = Camera(W, T, *focal, *center, width, height)
    settings = SETTINGS["kernel" if renderer == "paper" else renderer]._replace(dtype="float64")
    return golden.render(seen_by, t, settings)


lessons.passes("frames", port=port)
