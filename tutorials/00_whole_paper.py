# %% [markdown]
# # The whole paper in one file
#
# A moving scene can be described by thousands of soft coloured ellipsoids, *Gaussians*, which a
# graphics card draws from any side in a few milliseconds. The problem is the size of the file.
# Every Gaussian takes 59 numbers, and the methods that P-4DGS (arXiv 2510.10030) is compared with
# need 11 to 752 MB for a few seconds of one object or room. P-4DGS needs 0.6 to 2 MB. It predicts
# as video codecs do, within a frame and from frame to frame, and has three ideas:
#
# 1. **Space.** Neighbouring Gaussians look alike. Store one *anchor*, and let small networks
#    predict the k Gaussians around it, its children.
# 2. **Time.** Store the scene once, and let one more network say where every Gaussian is at time t.
# 3. **Bits.** Round the anchors' numbers as coarsely as the pictures allow, and write likely values
#    with few bits. Two more networks predict how coarsely to round and which values are likely.
#
# This program does all of that for two moving balls: it trains, writes bytes, forgets everything
# except these bytes and its own constants, decodes, and draws.
#
# ![Truth, decoded pictures, their error, and the bytes of the file](pictures/whole_paper.png)
#
#     anchors -> Gaussians -> Gaussians at time t -> image -> L_render      Eqs. (1) to (6), (16)
#     positions -> grid -> steps and probabilities -> bits -> L_rate        Eqs. (7) to (14), (17)
#     L_total = L_render + lambda_rate L_rate                               Eq. (15)
#
# `python tutorials/00_whole_paper.py` takes 10 to 20 seconds and puts the pictures of its sections
# on one page; with `--check` it compares gradients with finite differences.
#
# **How to read it.** Each equation with a gradient is a function that returns its result and its
# own backward, `back`. This backward takes the gradients of the results and returns those of the
# trained inputs, in their order. `x_bar` is the gradient of the loss with respect to x, and `p`
# holds the parameters. A anchors with k children are N = A k Gaussians, drawn in P pixels. Lengths
# are in scene units, t is in [0, 1]. (Q1), (Q2), ... are [choices](reference.md#choices) left open.

# %%
import struct
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.special import expit as sigmoid
from scipy.special import ndtr as Phi  # the normal distribution function of Eq. (11)

SHOW = __name__ == "__main__" and "--check" not in sys.argv  # not where a test imports this file
if SHOW:
    plt.style.use("default")  # the pictures look the same whatever your settings are
A, k, d = 80, 4, 8  # anchors, children of each, features of each; the paper has k = 10, d = 16

# %% [markdown]
# ## From anchors to Gaussians: Eqs. (1) to (4)


# %%
def offsets(x_a, O, l):
    """Eq. (1): the centres of the children, x = x_a + O l."""
    x = x_a[:, None] + O * l[:, None]

    def back(x_bar):
        # one anchor moves all its children: sum over k
        return x_bar.sum(axis=1), x_bar * l[:, None], (x_bar * O).sum(axis=1)

    return x, back


def view(x_a, x_c):
    """Eq. (2): distance and direction, delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc."""
    away = x_a - x_c
    delta_vc = np.sqrt((away**2).sum(axis=1, keepdims=True))
    d_vc = away / delta_vc

    def back(delta_vc_bar, d_vc_bar):
        along = (d_vc * d_vc_bar).sum(axis=1, keepdims=True)
        return d_vc * delta_vc_bar + (d_vc_bar - d_vc * along) / delta_vc

    return (delta_vc, d_vc), back


# %% [markdown]
# Networks predict everything else from `seen`: the anchor's features, distance and direction. A
# network is a list `[W0, b0, W1, b1, W2, b2]`: two hidden layers with ReLU, then a linear one. Its
# outputs can be any numbers, so each attribute has a function that maps them to its range. For
# opacity, the paper's predecessors use tanh (Q4). A child with a negative opacity is not drawn, so
# the network can switch children on and off.


# %%
def mlp(x, psi):
    """y = relu(relu(x W0 + b0) W1 + b1) W2 + b2 for every row of x; `back` gives (x, psi)."""
    W0, b0, W1, b1, W2, b2 = psi
    first = np.maximum(x @ W0 + b0, 0)
    second = np.maximum(first @ W1 + b1, 0)

    def back(y_bar):
        second_bar = (y_bar @ W2.T) * (second > 0)
        first_bar = (second_bar @ W1.T) * (first > 0)
        psi_bar = [x.T @ first_bar, first_bar.sum(axis=0)]
        psi_bar += [first.T @ second_bar, second_bar.sum(axis=0)]
        psi_bar += [second.T @ y_bar, y_bar.sum(axis=0)]
        return first_bar @ W0.T, psi_bar

    return second @ W2 + b2, back


def opacity(seen, psi):
    """Eq. (3): alpha = tanh(psi_alpha(f, delta_vc, d_vc)) of every child."""
    y, back_mlp = mlp(seen, psi)
    alpha = np.tanh(y)
    return alpha, lambda alpha_bar: back_mlp(alpha_bar * (1 - alpha**2))


def color(seen, psi):
    """Eq. (3) for colour: c = sigmoid(psi_c(f, delta_vc, d_vc)), red, green and blue."""
    y, back_mlp = mlp(seen, psi)
    c = sigmoid(y).reshape(len(y), -1, 3)
    return c, lambda c_bar: back_mlp((c_bar * c * (1 - c)).reshape(y.shape))


def normalise(y):
    """r = y / |y| for every quaternion. A gradient along r would only change the length of y."""
    length = np.sqrt((y**2).sum(axis=-1, keepdims=True))
    r = y / length
    return r, lambda bar: (bar - r * (r * bar).sum(axis=-1, keepdims=True)) / length


def rotation(seen, psi):
    """Eq. (3) for rotation: r = psi_r / |psi_r|, a unit quaternion (w, x, y, z) for every child."""
    y, back_mlp = mlp(seen, psi)
    r, back_normalise = normalise(y.reshape(len(y), -1, 4))
    return r, lambda r_bar: back_mlp(back_normalise(r_bar).reshape(y.shape))


def scale(s_a, seen, psi):
    """Eq. (4): s = s_a sigmoid(psi_s(f, delta_vc, d_vc)) for every child."""
    y, back_mlp = mlp(seen, psi)
    share = sigmoid(y).reshape(len(y), -1, 3)
    s = s_a[:, None] * share

    def back(s_bar):
        y_bar = s_bar * s * (1 - share)
        return ((s_bar * share).sum(axis=1), *back_mlp(y_bar.reshape(y.shape)))

    return s, back


# %% [markdown]
# An anchor is a position x_a and n = 26 numbers that will be coded: features f, scale s, scaling l
# of its offsets, and offsets O. Training keeps log s and log l, so s and l stay positive (Q5).


# %%
WIDTHS = (d, 3, 3, 3 * k)  # numbers of an anchor in the groups f, s, l, O
STARTS = np.cumsum((0, *WIDTHS[:3]))  # where the groups begin
GROUP = np.repeat(range(4), WIDTHS)  # the group of each of an anchor's numbers
n = len(GROUP)


def attributes(p):
    """The numbers of every anchor that are rounded and coded, [A, n]: f, s, l, O."""
    s, l = np.exp(p["log_s"]), np.exp(p["log_l"])
    return np.concatenate([p["f"], s, l, p["O"].reshape(A, -1)], axis=1)


def groups(values):
    """The inverse of `attributes`: f [A, d], s [A, 3], l [A, 3] and O [A, k, 3]."""
    f, s, l, O = np.split(values, STARTS[1:], axis=1)
    return f, s, l, O.reshape(A, k, 3)


def network(p, name):
    """The arrays of a network."""
    return [p[f"{name}.{i}"] for i in range(6)]


def predict(x_a, values, p, x_c):
    """Eqs. (1) to (4): the Gaussians (x, s, r, alpha, c) of all anchors, N = A k of each."""
    f, s_a, l, O = groups(values)
    (delta_vc, d_vc), back_view = view(x_a, x_c)
    seen = np.concatenate([f, delta_vc, d_vc], axis=1)
    x, back_x = offsets(x_a, O, l)
    s, back_s = scale(s_a, seen, network(p, "psi_s"))
    r, back_r = rotation(seen, network(p, "psi_r"))
    alpha, back_alpha = opacity(seen, network(p, "psi_alpha"))
    c, back_c = color(seen, network(p, "psi_c"))
    x, s, r, c = (a.reshape(A * k, -1) for a in (x, s, r, c))

    def back(*bars):
        x_bar, s_bar, r_bar, alpha_bar, c_bar = (bar.reshape(A, k, -1) for bar in bars)
        x_a_bar, O_bar, l_bar = back_x(x_bar)
        s_a_bar, seen_s, psi_s = back_s(s_bar)
        seen_r, psi_r = back_r(r_bar)
        seen_alpha, psi_alpha = back_alpha(alpha_bar.reshape(A, k))
        seen_c, psi_c = back_c(c_bar)
        seen_bar = seen_s + seen_r + seen_alpha + seen_c
        x_a_bar = x_a_bar + back_view(seen_bar[:, d : d + 1], seen_bar[:, d + 1 :])
        values_bar = np.concatenate([seen_bar[:, :d], s_a_bar, l_bar, O_bar.reshape(A, -1)], axis=1)
        networks = {"psi_s": psi_s, "psi_r": psi_r, "psi_alpha": psi_alpha, "psi_c": psi_c}
        return x_a_bar, values_bar, networks

    return (x, s, r, alpha.ravel(), c), back


# %% [markdown]
# ## In time: Eqs. (5) and (6)
# One network moves all Gaussians. Its inputs are the position of a Gaussian and the time, and sines
# and cosines of both, because a network learns rapid changes too slowly from the raw numbers (Q2:
# how many). The gradient reaches the network's weights and stops there: E(x) passes none to x, as
# in D3DGS, the method on which this one builds (Q10).


# %%
L_x, L_t = 4, 4  # frequencies of the positional encoding


def encoding(x, L):
    """E(x) = (x, sin x, cos x, sin 2x, cos 2x, ..., sin 2^(L-1) x, cos 2^(L-1) x), row by row."""
    waves = [wave(2**j * x) for j in range(L) for wave in (np.sin, np.cos)]
    return np.concatenate([x, *waves], axis=1)


def deformation(x, t, psi):
    """Eq. (5): (delta_x, delta_s, delta_r) = psi_d(E(x), E(t)). `back` gives psi only."""
    E_x, E_t = encoding(x, L_x), encoding(np.full((len(x), 1), t), L_t)
    y, back_mlp = mlp(np.hstack([E_x, E_t]), psi)
    return (y[:, :3], y[:, 3:6], y[:, 6:]), lambda *bars: back_mlp(np.hstack(bars))[1]


def deformed(x, s, r, delta_x, delta_s, delta_r):
    """Eq. (6): x + delta_x, s + delta_s, and r + delta_r, normalised again (Q9)."""
    r_t, back_normalise = normalise(r + delta_r)

    def back(x_bar, s_bar, r_bar):
        r_bar = back_normalise(r_bar)
        return x_bar, s_bar, r_bar, x_bar, s_bar, r_bar

    return (x + delta_x, s + delta_s, r_t), back


# %% [markdown]
# ## What is trained
# Five arrays of the anchors, the five networks above, and, for the bits, a grid and two networks.


# %%
BOX = 1.3  # the file and the grid cover positions in [-BOX, BOX]^3
RESOLUTION, F = 8, 4  # the grid of Eq. (9) has 8 x 8 x 8 nodes with F bits each


def layers(inputs, outputs, hidden=2 * d):
    """The shapes of W0, b0, W1, b1, W2, b2."""
    return [(inputs, hidden), (hidden,), (hidden, hidden), (hidden,), (hidden, outputs), (outputs,)]


NETWORKS = {
    "psi_alpha": layers(d + 4, k),
    "psi_c": layers(d + 4, 3 * k),
    "psi_r": layers(d + 4, 4 * k),
    "psi_s": layers(d + 4, 3 * k),
    "psi_d": layers(3 * (1 + 2 * L_x) + 1 + 2 * L_t, 10, hidden=48),
    "psi_p": layers(F, 2 * n),
    "psi_q": layers(F, 4),
}
ANCHORS = {"x_a": (A, 3), "f": (A, d), "log_s": (A, 3), "log_l": (A, 3), "O": (A, k, 3)}
WEIGHTS = {f"{name}.{i}": shape for name in NETWORKS for i, shape in enumerate(NETWORKS[name])}
SHAPES = {**ANCHORS, "grid": (RESOLUTION**3, F), **WEIGHTS}  # of all parameters


def start(rng):
    """Initial parameters: random anchors, networks as in PyTorch, and visible children."""
    p = {name: np.zeros(shape) for name, shape in SHAPES.items()}
    p["x_a"] += rng.uniform(-1, 1, (A, 3))
    p["f"] += 0.1 * rng.normal(size=(A, d))
    p["log_s"] += np.log(2 / A ** (1 / 3))  # about the distance between neighbours
    p["log_l"] += p["log_s"]
    p["grid"] += rng.uniform(-1e-4, 1e-4, p["grid"].shape)
    for name in WEIGHTS:
        stem, i = name.split(".")
        bound = 1 / np.sqrt(NETWORKS[stem][int(i) // 2 * 2][0])  # by the number of inputs
        p[name] += rng.uniform(-bound, bound, p[name].shape)
    p["psi_alpha.5"] += 0.3  # most children start visible
    p["psi_r.5"] += np.tile([1, 0, 0, 0], k)  # near the identity
    p["psi_d.4"] *= 0.01  # nearly at rest
    p["psi_d.5"] *= 0.01
    return p


def strip(title, images, names=None, white=1):
    """A row of images [P, 3], or [P] with one number for each pixel, below a title.

    A number of `white` is drawn white; another one than 1 gets a scale.
    """
    figure, axes = plt.subplots(1, len(images), figsize=(9, 2.2), dpi=100)
    figure.suptitle(title, x=0.47)  # the middle of the row
    figure.subplots_adjust(left=0.01, right=0.93, bottom=0.03, top=0.76, wspace=0.05)
    for axis, image, name in zip(axes, images, names or [""] * len(images)):
        pixels = image.reshape(SIZE, SIZE, -1).squeeze().clip(0, 1)
        shown = axis.imshow(pixels, cmap="gray", vmin=0, vmax=white)
        axis.set(xticks=[], yticks=[], title=name)
    if white != 1:
        figure.colorbar(shown, cax=figure.add_axes((0.94, 0.03, 0.01, 0.73)))


def plot(title, **labels):
    """Empty axes below a title."""
    figure, axis = plt.subplots(figsize=(9, 3.5), dpi=100, layout="constrained")
    axis.set(title=title, **labels)
    return axis


if SHOW:
    rng = np.random.default_rng(0)
    x_a, O = rng.uniform(-1, 1, (A, 3)), rng.normal(size=(A, k, 3))
    x, y, _ = offsets(x_a, O, np.full((A, 3), 0.1))[0].T  # [k, A]
    axis = plot("Random anchors, and children around them, from above", aspect="equal")
    axis.plot(x, y, ".-", x_a[:, 0], x_a[:, 1], "k+", lw=0.5)

# %% [markdown]
# ## Splatting
# The paper takes this part from 3DGS (Kerbl et al. 2023). An ellipsoid has the covariance
# $Q\,\mathrm{diag}(s)^2Q^T$ with its own rotation $Q$, not the camera's $R$. A camera sees it as an
# ellipse of pixels, a *splat*. Splats are painted from front to back.
#
# The rotation matrix of a unit quaternion r = (w, x, y, z) is usually written with squares, such as
# 1 - 2 (y y + z z). It is also the product of two matrices, `left` and the transpose of `right`,
# which only hold the numbers of r, some with a minus. That makes the backward short.


# %%
SIZE, FOCAL = 24, 30.0  # pixels along a side of an image, and the focal length in pixels
BACKGROUND = np.ones(3)


def camera(azimuth, elevation, distance=4.0):
    """Rotation R [3, 3] and translation T [3] from world to camera: x right, y down, z forward."""
    (cos_a, cos_e), (sin_a, sin_e) = np.cos([azimuth, elevation]), np.sin([azimuth, elevation])
    z = -np.array([cos_e * cos_a, cos_e * sin_a, sin_e])
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z]), np.array([0, 0, distance])


def pixel_grid(finer=1):
    """Coordinates (X, Y) of the pixels from the image's centre, each cut into finer^2 parts."""
    line = (np.arange(SIZE * finer) + 0.5) / finer - SIZE / 2
    return np.meshgrid(line, line)


def factors(r):
    """The matrices `left` and `right` of quaternions r [N, 4], both [N, 3, 4]."""
    w, x, y, z = r.T
    left = np.array([[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    right = np.array([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    return left.transpose(2, 0, 1), right.transpose(2, 0, 1)


def rotation_matrix(r):
    """The rotation matrices Q = left right^T [N, 3, 3] of unit quaternions r [N, 4]."""
    left, right = factors(r)

    def back(Q_bar):
        left_bar, right_bar = Q_bar @ right, Q_bar.transpose(0, 2, 1) @ left
        in_left, in_right = factors(np.eye(4))  # w, x, y, z in turn: 1 or -1 where it stands
        r_bar = np.einsum("nij,aij->na", left_bar, in_left)
        return r_bar + np.einsum("nij,aij->na", right_bar, in_right)

    return left @ right.transpose(0, 2, 1), back


def projection(x, s, Q, R, T):
    """Centres [N, 2] from the middle of the image, conics [N, 3] and depths [N] of the splats.

    Near a Gaussian at (x, y, z) in camera coordinates, the projection is almost linear: it is JR,
    with J = FOCAL/z [[1, 0, -x/z], [0, 1, -y/z]]. The splat's covariance is m diag(s)^2 m^T with
    m = JR Q. 3DGS adds 0.3 I, because a splat smaller than a pixel could lie between pixel centres
    and vanish. The conic is the inverse K of that sum [[a, b], [b, c]]. For long thin splats
    a c - b b loses all digits. With the cross product n of m's rows, the determinant of
    m diag(s)^2 m^T is a sum of squares (Cauchy and Binet), and nothing cancels.
    """
    x_cam = x @ R.T + T
    z, uv = x_cam[:, 2:], x_cam[:, :2] / x_cam[:, 2:]
    JR = (R[:2] - uv[:, :, None] * R[2]) * (FOCAL / z)[:, :, None]  # [N, 2, 3]
    m, squares = JR @ Q, s**2
    mS = m * squares[:, None]
    (a, b), (_, c) = (mS @ m.transpose(0, 2, 1) + 0.3 * np.eye(2)).transpose(1, 2, 0)
    n = np.cross(m[:, 0], m[:, 1])
    det = (n**2 * squares[:, [1, 2, 0]] * squares[:, [2, 0, 1]]).sum(axis=1) + 0.3 * (a + c - 0.3)
    conic = np.stack([c, -b, a], axis=1) / det[:, None]

    def back(mean_bar, conic_bar):
        K, K_bar = (a[:, [0, 1, 1, 2]].reshape(-1, 2, 2) for a in (conic, conic_bar * [1, 0.5, 1]))
        Km_det = np.stack([np.cross(mS[:, 1], n), np.cross(n, mS[:, 0])], axis=1) + 0.3 * m
        K_bar_Km = K_bar @ Km_det / det[:, None, None]  # d(K) = -K d(m diag(s)^2 m^T) K
        m_bar = -2 * K @ K_bar_Km * squares[:, None]
        JR_bar, Q_bar = m_bar @ Q.transpose(0, 2, 1), JR.transpose(0, 2, 1) @ m_bar
        uv_bar = FOCAL * mean_bar - (JR_bar @ R[2]) * FOCAL / z  # uv is in the mean and in JR
        z_bar = -(uv_bar * uv).sum(axis=1) / z[:, 0]  # uv = (x, y) / z, so d(uv) / dz = -uv / z
        z_bar -= (JR_bar * JR).sum(axis=(1, 2)) / z[:, 0]  # JR ~ 1 / z, so d(JR) / dz = -JR / z
        x_bar = np.concatenate([uv_bar / z, z_bar[:, None]], axis=1) @ R
        return x_bar, -2 * s * (Km_det * K_bar_Km).sum(axis=1) / det[:, None], Q_bar

    return (FOCAL * uv, conic, z[:, 0]), back


def compositing(mean, conic, alpha, c):
    """Paint N splats from front to back: image = sum of T_i alpha_i(p) c_i + T_N background [P, 3].

        alpha_i(p) = min(0.99, alpha_i exp(-(p - mean_i)^T K_i (p - mean_i) / 2))  at pixel p
        T_i = product of 1 - alpha_j(p) over j < i    transmittance: the light that is left for i

    A more opaque splat shows more of its own colour and less of everything behind it. (The letters
    are those of 3DGS: T_i has nothing to do with the camera's T, nor p with the parameters.)

        alpha_i(p)_bar = image_bar (T_i c_i - (sum of T_j alpha_j(p) c_j over j > i, and background)
                                              / (1 - alpha_i(p)))
    """
    X, Y = (grid.reshape(-1, 1) for grid in pixel_grid())
    K_a, K_b, K_c = conic.T
    e_x, e_y = X - mean[:, 0], Y - mean[:, 1]  # from the means to the pixels [P, N]
    falloff = np.exp(-(K_a * e_x**2 + K_c * e_y**2) / 2 - K_b * e_x * e_y)
    alpha_p = np.minimum(0.99, alpha * falloff)
    T_i = np.cumprod(np.hstack([np.ones((len(X), 1)), 1 - alpha_p]), axis=1)  # [P, N + 1]
    weight = T_i[:, :-1] * alpha_p

    def back(image_bar):
        weight_bar = image_bar @ c.T  # [P, N]
        background_bar = T_i[:, -1:] * (image_bar @ BACKGROUND)[:, None]
        # from the back: the background, then the splats up to the one after the first
        from_back = np.flip(np.hstack([weight * weight_bar, background_bar])[:, 1:], axis=1)
        behind = np.flip(np.cumsum(from_back, axis=1), axis=1)  # [P, N]: the sum over j > i
        alpha_p_bar = T_i[:, :-1] * weight_bar - behind / (1 - alpha_p)
        alpha_p_bar *= alpha * falloff <= 0.99  # the clamp passes no gradient
        exponent_bar = alpha_p_bar * alpha_p
        pull_x, pull_y = exponent_bar * e_x, exponent_bar * e_y
        x_sum, y_sum = pull_x.sum(axis=0), pull_y.sum(axis=0)
        mean_bar = np.stack([K_a * x_sum + K_b * y_sum, K_b * x_sum + K_c * y_sum], axis=1)
        xx, xy, yy = ((a * b).sum(axis=0) for a, b in ((pull_x, e_x), (pull_x, e_y), (pull_y, e_y)))
        conic_bar = -np.stack([xx / 2, xy, yy / 2], axis=1)
        return mean_bar, conic_bar, (alpha_p_bar * falloff).sum(axis=0), weight.T @ image_bar

    return weight @ c + T_i[:, -1:] * BACKGROUND, back


def render(x, s, r, alpha, c, R, T):
    """The image [P, 3] of Gaussians; `back` gives the gradients of (x, s, r, alpha, c)."""
    Q, back_rotation = rotation_matrix(r)
    (mean, conic, depth), back_projection = projection(x, s, Q, R, T)
    order = np.argsort(depth, kind="stable")
    order = order[(alpha[order] > 0) & (depth[order] > 0.2)]  # visible, in front of the camera
    image, back_compositing = compositing(mean[order], conic[order], alpha[order], c[order])

    def back(image_bar):
        bars = [np.zeros_like(a) for a in (mean, conic, alpha, c)]  # no gradient where not drawn
        for bar, drawn_bar in zip(bars, back_compositing(image_bar)):
            bar[order] = drawn_bar
        mean_bar, conic_bar, alpha_bar, c_bar = bars
        x_bar, s_bar, Q_bar = back_projection(mean_bar, conic_bar)
        return x_bar, s_bar, back_rotation(Q_bar), alpha_bar, c_bar

    return image, back


def draw(p, values, R, T, t):
    """The picture [P, 3] at time t; `values` are attributes as in training or as decoded."""
    (x, s, r, alpha, c), _ = predict(p["x_a"], values, p, -R.T @ T)
    (x, s, r), _ = deformed(x, s, r, *deformation(x, t, network(p, "psi_d"))[0])
    return np.clip(render(x, s, r, alpha, c, R, T)[0], 0, 1)


if SHOW:
    conic = np.array([[0.03, 0.01, 0.05]] * 3)
    splats = np.array([[-3, 0], [1, 2], [4, -3]]), conic, np.array([0.9, 0.8, 0.7])
    image, dark = compositing(*splats, np.eye(3))[0], compositing(*splats, np.zeros((3, 3)))[0]
    names = "three splats", "weight of red", "of green", "of blue", "of the background"
    strip("Front to back: red, green, blue", [image, *(image - dark).T, dark[:, 0]], names)
    p = start(rng)
    untrained = [draw(p, attributes(p), *camera(angle, 0.4), t=0) for angle in range(4)]
    strip("The Gaussians before training, from four sides", untrained)

# %% [markdown]
# ## The scene
# One ball bounces, and another one circles halfway around it. Each moment has one picture, taken by
# a camera that looks at the origin from a different direction.


# %%
def truth(R, T, t):
    """Draw the balls at time t by tracing rays: the mean of 4 x 4 rays per pixel, [P, 3]."""
    X, Y = pixel_grid(finer=4)
    rays = np.stack([X / FOCAL, Y / FOCAL, np.ones_like(X)], axis=-1) @ R  # in world coordinates
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye, light = -R.T @ T, np.array([0.3, 0.5, 0.81])
    angle = np.pi * t
    balls = (
        (np.array([0, 0, 0.7 * abs(np.sin(2 * angle)) - 0.3]), 0.5, np.array([0.9, 0.3, 0.2])),
        (np.array([np.cos(angle), np.sin(angle), -0.2]) * 0.9, 0.35, np.array([0.2, 0.4, 0.9])),
    )
    image, nearest = np.ones(rays.shape), np.full(X.shape, np.inf)
    for center, radius, color in balls:
        along = rays @ (center - eye)
        inside = radius**2 - ((center - eye) ** 2).sum() + along**2
        depth = along - np.sqrt(np.maximum(inside, 0))
        normal = (eye + depth[..., None] * rays - center) / radius
        shade = 0.4 + 0.6 * np.maximum(normal @ light, 0)
        hit = (inside > 0) & (depth < nearest)
        image[hit] = (color * shade[..., None])[hit]
        nearest[hit] = depth[hit]
    return image.reshape(SIZE, 4, SIZE, 4, 3).mean(axis=(1, 3)).reshape(-1, 3)


def shots(count, shift):
    """`count` views (R, T, t, image): in order of time, from up to 52 degrees to either side."""
    taken = []
    for i in range(count):
        t = (i + shift) / count
        # multiples of irrational numbers, modulo 1, spread evenly
        to_the_side, up = 0.618 * (i + shift) % 1, 0.755 * (i + shift) % 1
        R, T = camera(azimuth=0.9 * (2 * to_the_side - 1), elevation=0.1 + 0.7 * up)
        taken.append((R, T, t, truth(R, T, t)))
    return taken


views, unseen = shots(24, 0), shots(8, 0.37)  # unseen: other moments, other cameras
if SHOW:
    strip("Every fourth view", [v[3] for v in views[::4]], [f"t = {v[2]:.2f}" for v in views[::4]])

# %% [markdown]
# ## The loss of a picture: Eq. (16)
# SSIM, the structural similarity, compares local means, variances and covariances of two pictures x
# and y, averaged over a Gaussian window of 11 x 11 pixels, with zeros outside the image. The window
# is separable: a blur is a product with one symmetric matrix from both sides, as is its backward.


# %%
LAMBDA_SSIM = 0.2
profile = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
profile /= profile.sum()
WINDOW = sum(np.eye(SIZE, k=j) * profile[j + 5] for j in range(-5, 6))  # [SIZE, SIZE]


def blur(images):
    """Local averages of an image [P, 3]."""
    channels = images.T.reshape(-1, SIZE, SIZE)
    return (WINDOW @ channels @ WINDOW).reshape(-1, SIZE**2).T


def ssim(x, y):
    """The mean over pixels and channels of the structural similarity of x to the truth y."""
    C_1, C_2 = 0.01**2, 0.03**2
    mu_x, mu_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mu_x**2, blur(y * y) - mu_y**2
    cov = blur(x * y) - mu_x * mu_y
    n_1, n_2 = 2 * mu_x * mu_y + C_1, 2 * cov + C_2
    d_1, d_2 = mu_x**2 + mu_y**2 + C_1, var_x + var_y + C_2
    S = n_1 * n_2 / (d_1 * d_2)

    def back(ssim_bar):
        S_bar = ssim_bar / x.size
        cov_bar = 2 * S_bar * n_1 / (d_1 * d_2)
        var_bar = -S_bar * S / d_2
        mu_bar = 2 * S_bar * (mu_y * n_2 / (d_1 * d_2) - mu_x * S / d_1)
        mu_bar -= mu_y * cov_bar + 2 * mu_x * var_bar
        return blur(mu_bar) + 2 * x * blur(var_bar) + y * blur(cov_bar)

    return S.mean(), back


def render_loss(image, y):
    """Eq. (16): (1 - lambda) L1 + lambda (1 - SSIM), with the lambda of 3DGS (Q13)."""
    similarity, back_ssim = ssim(image, y)
    L1 = np.abs(image - y).mean()

    def back(loss_bar):
        L1_bar = (1 - LAMBDA_SSIM) * loss_bar / image.size
        return L1_bar * np.sign(image - y) + back_ssim(-LAMBDA_SSIM * loss_bar)

    return (1 - LAMBDA_SSIM) * L1 + LAMBDA_SSIM * (1 - similarity), back


# %% [markdown]
# ## The bits: Eqs. (7) to (12) and (14)
# A number f (the paper's letter for a feature, and here for any number of an anchor) is stored as
# the integer round(f / q). Nothing can be learned through this staircase, whose slope is 0. But the
# error of rounding is spread about evenly between -q/2 and q/2. Training therefore adds noise of
# that kind instead: it degrades the picture as rounding will, and gradients pass.
#
# Two networks predict the steps q, the means mu and the standard deviations sigma. They read a grid
# of bits at the anchor's position; networks, positions and grid come first in the file. As psi_q
# starts near 0, q starts near its group's base step Q_0 (Q6). The paper's Q_0 of f, s, l, O are 1,
# 0.001, 0.001 and 0.2. On tiny scenes, finer steps of s and l cost bytes and gain nothing.


# %%
Q_0 = np.array([0.25, 0.01, 0.01, 0.1])  # base steps of the groups f, s, l, O


def noise(f, q, u):
    """Eq. (7): f + u q with u uniform in [-1/2, 1/2]; q [A, 4] has one step for each group."""
    noisy = f + u * q[:, GROUP]
    return noisy, lambda bar: (bar, np.add.reduceat(bar * u, STARTS, axis=1))  # sum by group


def rounding(f, q):
    """The integers round(f / q) of Eq. (10). The decoder multiplies them by the same steps."""
    return np.rint(f / q[:, GROUP]).astype(int)


def node_weights(x_a):
    """The trilinear weights [A, nodes] of all nodes of the grid at the positions x_a [A, 3]."""
    place = (np.clip(x_a / BOX, -1, 1) + 1) / 2 * (RESOLUTION - 1)
    hat = np.maximum(0, 1 - np.abs(place[:, :, None] - np.arange(RESOLUTION)))
    return np.einsum("ai,aj,ak->akji", *hat.transpose(1, 0, 2)).reshape(len(x_a), -1)


def signs(grid):
    """The bits of the grid, as -1 and 1."""
    return np.where(grid >= 0, 1.0, -1.0)


def hash_grid(weights, b):
    """Eq. (9): h = weights b [A, F], the signs b around every anchor. So few nodes need no hash."""
    return weights @ b, lambda h_bar: weights.T @ h_bar


def step(h, psi):
    """Eq. (8): q = Q_0 (1 + tanh(psi_q(h))) [A, 4], a step between 0 and 2 Q_0 for each group."""
    y, back_mlp = mlp(h, psi)
    q = Q_0 * (1 + np.tanh(y))
    return q, lambda q_bar: back_mlp(q_bar * Q_0 * (1 - np.tanh(y) ** 2))


def prior(h, psi):
    """Eq. (12): (mu, sigma) of all numbers; psi_p gives mu and log sigma, so sigma > 0 (Q8)."""
    y, back_mlp = mlp(h, psi)
    mu, sigma = y[:, :n], np.exp(y[:, n:])
    return (mu, sigma), lambda mu_bar, sigma_bar: back_mlp(np.hstack([mu_bar, sigma_bar * sigma]))


def likelihood(f, mu, sigma, q):
    """Eq. (11): bits = -log2(Phi((f + q/2 - mu) / sigma) - Phi((f - q/2 - mu) / sigma)).

    Above the mean both terms are close to 1 and lose digits, so f is mirrored to below the mean.
    The mass is at least 1e-30, or 100 bits; farther out, the gradient falls to 0 with the density.
    """
    side = np.sign(f - mu)
    upper = (q / 2 - np.abs(f - mu)) / sigma
    lower = upper - q / sigma
    mass = np.maximum(Phi(upper) - Phi(lower), 1e-30)

    def back(bits_bar):
        mass_bar = -bits_bar / (mass * np.log(2))
        upper_bar = mass_bar * np.exp(-(upper**2) / 2) / np.sqrt(2 * np.pi)
        lower_bar = -mass_bar * np.exp(-(lower**2) / 2) / np.sqrt(2 * np.pi)
        f_bar = -side * (upper_bar + lower_bar) / sigma
        sigma_bar = -(upper_bar * upper + lower_bar * lower) / sigma
        return f_bar, -f_bar, sigma_bar, (upper_bar - lower_bar) / (2 * sigma)

    return -np.log2(mass), back


def hash_rate(b):
    """Eq. (14): N+ (-log2 p+) + N- (-log2 p-) for the signs of the grid, p+ = N+ / (N+ + N-)."""
    N_plus = (1 + b).sum() / 2
    p_plus = np.clip(N_plus / b.size, 1e-6, 1 - 1e-6)
    # A minus that becomes a plus moves N+, and p+ with it. But p+ is the probability that needs the
    # fewest bits for these counts, so moving it a little changes nothing, and N+ alone counts.
    slope = np.log2((1 - p_plus) / p_plus) / 2  # half of it: b moves by 2 where N+ moves by 1
    hash_bits = -N_plus * np.log2(p_plus) - (b.size - N_plus) * np.log2(1 - p_plus)
    return hash_bits, lambda bits_bar: np.full_like(b, slope * bits_bar)


if SHOW:
    f, u = np.linspace(-1, 1, 300)[:, None].repeat(n, axis=1), rng.random((300, n)) - 0.5
    q = np.full((300, 4), 0.5)
    axis = plot("A number from -1 to 1, q = 0.5: noise (dots) and rounding (line)", xlabel="f")
    axis.plot(f[:, 0], noise(f, q, u)[0][:, 0], ".", f[:, 0], rounding(f, q)[:, 0] * 0.5)

# %% [markdown]
# ## Everything in a row: Eqs. (13), (15) and (17)
# `loss` runs all equations and returns the whole backward. Each of the paper's four stages switches
# on more parts: first the anchors alone, then the noise, the motion, and the grid with the rate.


# %%
LAMBDA_RATE = 5e-4


def context(p, weights, sign=signs):
    """Eqs. (8), (9), (12), (14): steps, means and deviations of all numbers, bits of the grid."""
    b = sign(p["grid"])
    h, back_h = hash_grid(weights, b)
    q, back_q = step(h, network(p, "psi_q"))
    (mu, sigma), back_prior = prior(h, network(p, "psi_p"))
    hash_bits, back_hash_rate = hash_rate(b)

    def back(q_bar, mu_bar, sigma_bar, hash_bits_bar):
        h_q, psi_q = back_q(q_bar)
        h_p, psi_p = back_prior(mu_bar, sigma_bar)
        b_bar = back_h(h_q + h_p) + back_hash_rate(hash_bits_bar)
        # Straight-through: as if the sign were the identity from -1 to 1 and constant beyond (Q11).
        return b_bar * (np.abs(p["grid"]) <= 1), {"psi_q": psi_q, "psi_p": psi_p}

    return (q, mu, sigma, hash_bits), back


def loss(p, shot, u, stage, weights=None, sign=signs, centers=None):
    """Eq. (15): L_render + LAMBDA_RATE L_rate for one view, its parts, and the whole backward.

    `back` returns {name: gradient}. At the signs of the grid and at E(x), it deliberately differs
    from the slope of the loss. `check` passes its own `sign`, and the `centers` [N, 3] for E(x).
    """
    R, T, t, image = shot
    values = attributes(p)
    q, bits = np.tile(Q_0, (A, 1)), 0.0
    if stage == 4:
        (q, mu, sigma, hash_bits), back_context = context(p, weights, sign)
    noisy, back_noise = noise(values, q, u if stage > 1 else 0 * u)
    (x, s, r, alpha, c), back_predict = predict(p["x_a"], noisy, p, -R.T @ T)
    parts = {"centers": x}
    if stage > 2:
        at = x if centers is None else centers
        deltas, back_deformation = deformation(at, t, network(p, "psi_d"))
        (x, s, r), back_deformed = deformed(x, s, r, *deltas)
    drawn, back_render = render(x, s, r, alpha, c, R, T)
    L_render, back_loss = render_loss(drawn, image)
    if stage == 4:
        number_bits, back_bits = likelihood(noisy, mu, sigma, q[:, GROUP])
        bits = number_bits.sum() + hash_bits  # Eq. (13) is the sum, Eq. (17) adds the grid
        # Not counted: the positions, whose bits are fixed, and the networks, stored in float16.
    L_rate = bits / values.size  # per number, so that LAMBDA_RATE fits any number of anchors (Q12)

    def back():
        networks = {}
        x_bar, s_bar, r_bar, alpha_bar, c_bar = back_render(back_loss(1.0))
        if stage > 2:
            x_bar, s_bar, r_bar, *deltas_bar = back_deformed(x_bar, s_bar, r_bar)
            networks["psi_d"] = back_deformation(*deltas_bar)
        x_a_bar, noisy_bar, heads = back_predict(x_bar, s_bar, r_bar, alpha_bar, c_bar)
        networks |= heads
        g = {"x_a": x_a_bar}
        if stage == 4:
            each = LAMBDA_RATE / values.size
            coded_bar, mu_bar, sigma_bar, q_bar = back_bits(np.full_like(noisy, each))
            noisy_bar = noisy_bar + coded_bar  # one noisy number is both drawn and coded
            values_bar, noise_q_bar = back_noise(noisy_bar)
            q_bar = noise_q_bar + np.add.reduceat(q_bar, STARTS, axis=1)
            g["grid"], context_networks = back_context(q_bar, mu_bar, sigma_bar, each)
            networks |= context_networks
        else:
            values_bar, _ = back_noise(noisy_bar)
        g["f"], s_a_bar, l_bar, g["O"] = groups(values_bar)
        g["log_s"], g["log_l"] = s_a_bar * np.exp(p["log_s"]), l_bar * np.exp(p["log_l"])
        g |= {f"{name}.{i}": a for name in networks for i, a in enumerate(networks[name])}
        return g

    parts |= {"render": L_render, "bits": bits}
    return L_render + LAMBDA_RATE * L_rate, parts, back


# %% [markdown]
# ## Checking the gradients
# Along any direction, the gradient must give the slope of the loss, which finite differences
# measure. The check removes the two places where the gradient is not the slope: the grid's
# parameters replace their signs, and E(x) reads x as it was before the nudge. A nudge can swap two
# splats in depth, which makes the loss jump. So two nudges are tried, and one of them has to agree.


# %%
def check():
    """The gradients that do not match finite differences to 1e-4, as lines of text."""
    rng = np.random.default_rng(0)
    p, u, shot = start(rng), rng.random((A, n)) - 0.5, shots(24, 0)[5]
    for name in ("f", "O", "grid"):
        p[name] = rng.uniform(-0.9, 0.9, SHAPES[name])
    p["x_a"] *= 0.6
    p["log_s"] -= 0.7
    p["psi_alpha.4"] *= 3
    p["psi_alpha.5"] += 2.5  # so that some splats reach the clamp at 0.99
    p["psi_d.4"] *= 30
    wrong = []
    for stage in (1, 2, 3, 4):
        weights = node_weights(p["x_a"]) if stage == 4 else None
        _, parts, _ = loss(p, shot, u, stage, weights)
        fixed = shot, u, stage, weights, np.copy, parts["centers"]
        for name, array_bar in loss(p, *fixed)[2]().items():
            direction = rng.normal(size=array_bar.shape)
            slope, differences = (array_bar * direction).sum(), []
            for nudge in (1e-6, 1e-7):
                above = loss(p | {name: p[name] + nudge * direction}, *fixed)[0]
                below = loss(p | {name: p[name] - nudge * direction}, *fixed)[0]
                differences.append((above - below) / (2 * nudge))
            if all(abs(slope - other) > 1e-4 * abs(other) + 1e-8 for other in differences):
                other = differences[0]
                off = abs(slope - other) / max(abs(other), 1e-300)
                text = f"gradient {slope:.6g}, by differences {other:.6g}, relative error {off:.1e}"
                wrong.append(f"stage {stage}, {name}: {text}")
    return wrong


if __name__ == "__main__" and "--check" in sys.argv:
    sys.exit("\n".join(check()) or print("all gradients match finite differences"))

# %% [markdown]
# ## Training
# Training uses Adam (Kingma and Ba 2015), one view per iteration. A child with alpha < 0 is not
# drawn, gets no gradient of its own and seldom comes back. Here, a bias and a slow start of
# psi_alpha keep the children alive; the paper grows new anchors instead (Q16).


# %%
STAGE_ENDS = (20, 40, 800, 1300)  # iterations; the paper's stages 1 and 2 take 5,000 of 40,000
# Initial learning rates; by the end they have decayed to 0.07 of these values.
RATES = {"x_a": 0.002, "f": 0.015, "log_s": 0.014, "log_l": 0.014, "O": 0.02, "grid": 0.01}
RATES |= {"psi_alpha": 0.001, "psi_c": 0.008, "psi_r": 0.008, "psi_s": 0.008}
RATES |= {"psi_d": 0.003, "psi_p": 0.005, "psi_q": 0.005}


class Adam:
    def __init__(self):
        self.m = {name: np.zeros(shape) for name, shape in SHAPES.items()}
        self.v = {name: np.zeros(shape) for name, shape in SHAPES.items()}
        self.steps = dict.fromkeys(SHAPES, 0)  # counted from the stage in which an array joins

    def step(self, p, g, decay):
        """Move every parameter that has a gradient in g; m and v are Adam's moments."""
        for name, gradient in g.items():
            self.steps[name] += 1
            count, m, v = self.steps[name], self.m[name], self.v[name]
            m += 0.1 * (gradient - m)
            v += 0.001 * (gradient**2 - v)
            rate = decay * RATES[name.split(".")[0]]
            if name.startswith("psi_alpha"):
                rate *= min(1, count / 50)
            p[name] -= rate * m / (1 - 0.9**count) / (np.sqrt(v / (1 - 0.999**count)) + 1e-15)


def lattice(x_a):
    """Positions as 16-bit integers over the box, as in the file (Q14: frozen in stage 4)."""
    return np.rint((np.clip(x_a / BOX, -1, 1) + 1) / 2 * 65535).astype("<u2")


def on_lattice(integers):
    """The positions that these integers stand for."""
    return (integers / 65535 * 2 - 1) * BOX


def train(views, seed=0):
    """Fit the parameters to the views; return them, and the first view drawn after each stage."""
    rng = np.random.default_rng(seed)
    p, adam, weights, losses = start(rng), Adam(), None, []
    R, T, t, _ = views[0]
    frames = [draw(p, attributes(p), R, T, t)]
    print(" step  stage L_render   bits")
    for stage, (first, end) in enumerate(zip((0, *STAGE_ENDS), STAGE_ENDS), 1):
        if stage == 4:
            p["x_a"] = on_lattice(lattice(p["x_a"]))  # from now on the decoder's positions
            weights = node_weights(p["x_a"])
        for iteration in range(first, end):
            if iteration % len(views) == 0:
                order = rng.permutation(len(views))
            u = rng.random((A, n)) - 0.5
            _, parts, back = loss(p, views[order[iteration % len(views)]], u, stage, weights)
            g = back()
            if stage == 4:
                del g["x_a"]
            progress = max(iteration - STAGE_ENDS[1], 0) / (STAGE_ENDS[3] - STAGE_ENDS[1])
            adam.step(p, g, decay=0.07**progress)
            losses.append(parts["render"])
            if (iteration + 1) % (STAGE_ENDS[3] // 10) == 0:
                recent = np.mean(losses[-100:])
                print(f"{iteration + 1:5} {stage:6} {recent:8.4f} {parts['bits']:6.0f}", flush=True)
        frames.append(draw(p, attributes(p), R, T, t))
        if np.abs(frames[-1] - frames[-2]).max() < 0.01:
            print(f"stage {stage} changed nothing in the picture: no steps, or no visible child?")
    return p, frames


if SHOW:
    p, frames = train(views)
    shown = [frames[0], *(1 - 4 * (1 - frame) for frame in frames[1:3]), *frames[3:]]
    title = "The first view; after stages 1 and 2 with four times the contrast"
    strip(title, shown, ["before", *(f"after stage {i}" for i in (1, 2, 3, 4))])

# %% [markdown]
# Stages 1 and 2 leave nearly white pictures, drawn here with four times their contrast. Most pixels
# are background, so the first 40 steps mainly remove the grey of the untrained Gaussians. More of
# them would help little: even after 300, a model at rest draws only a red smear where the red ball
# is most often. Stage 3, in which the Gaussians move, therefore begins early.
#
# ## Bytes
# The entropy coder counts probabilities in units of 2^-24, at least one for each symbol: `cdf` is
# the cumulative distribution of Eq. (11) in these units. Symbol i is the integer lowest + i. Of the
# numbers from 0 to 2^24 - 1 it owns as many as it has units, its `width`: from cdf[i] to
# cdf[i + 1] - 1. rANS (Duda 2013) turns all symbols into one large integer, `state`. To add a
# symbol, it divides the state by the symbol's width. The remainder, from 0 to width - 1, selects
# one of the symbol's own numbers, which becomes the last 24 binary digits of the new state; the
# quotient becomes the digits before them. The decoder looks up who owns the number in the last 24
# digits. This is the symbol that was added last, and the decoder can now undo the step.
#
# In units of 1/4, let A own 0, 1 and 2, and B own 3. Adding A to the state 5 gives the quotient 1
# and the remainder 2, so the new state is 4 * 1 + 2 = 6. The decoder finds that 6 % 4 = 2 is A's,
# and returns to 3 * 1 + 2 = 5. A symbol of probability 1/8 multiplies the state by about 8, which
# adds 3 bits. Both sides compute the same probabilities, in the same floats on the same machine.


# %%
UNIT_BITS = 24  # probabilities are multiples of 2^-24


def rans_encode(symbols, cdfs):
    """Code the symbols, the last one first; `cdfs` has the cumulative distribution of each."""
    state = 1
    for symbol, cdf in zip(reversed(symbols.tolist()), reversed(cdfs.tolist())):
        first, width = cdf[symbol], cdf[symbol + 1] - cdf[symbol]
        state = (state // width << UNIT_BITS) + state % width + first
    return state.to_bytes(state.bit_length() // 8 + 1, "little")


def rans_decode(data, cdfs):
    """The inverse of `rans_encode`."""
    state, symbols = int.from_bytes(data, "little"), []
    for cdf in cdfs:
        owned = state % 2**UNIT_BITS  # one of the numbers that the last symbol owns
        symbol = int(np.searchsorted(cdf, owned, side="right")) - 1
        first, width = int(cdf[symbol]), int(cdf[symbol + 1] - cdf[symbol])
        state = width * (state >> UNIT_BITS) + owned - first
        symbols.append(symbol)
    return np.array(symbols)


def in_units(cumulative):
    """Cumulative probabilities [count, size + 1], from 0 to 1, as integers up to 2^24."""
    size = cumulative.shape[1] - 1
    return np.rint(cumulative * (2**UNIT_BITS - size)).astype(int) + np.arange(size + 1)


def number_cdfs(lowest, highest, q, mu, sigma):
    """The distributions of the integers from lowest to highest, for all numbers of all anchors."""
    q, mu, sigma = (a.reshape(-1, 1) for a in (q[:, GROUP], mu, sigma))
    cumulative = Phi(((np.arange(lowest, highest + 2) - 0.5) * q - mu) / sigma)
    cumulative[:, 0], cumulative[:, -1] = 0, 1
    return in_units(cumulative)


def sign_cdfs(ones):
    """The distributions of the grid's signs, of which `ones` are 1."""
    count = RESOLUTION**3 * F
    return np.repeat(in_units(np.array([[0, 1 - ones / count, 1]])), count, axis=0)


HEAD = "<2hH4I"  # lowest and highest integer, count of positive signs, bytes of each part


def encode(p):
    """The file: {part: bytes}. A decoder also needs the constants of this program."""
    positive = (p["grid"] >= 0).ravel().astype(int)
    networks = np.concatenate([p[name].ravel() for name in WEIGHTS])
    parts = {
        "networks": networks.astype("<f2").tobytes(),  # 16 bits a weight (Q18)
        "positions": lattice(p["x_a"]).tobytes(),
        "grid": rans_encode(positive, sign_cdfs(positive.sum())),
    }
    _, (q, mu, sigma, _) = read_base(*parts.values(), positive.sum())  # what the decoder will see
    integers = rounding(attributes(p), q).ravel()
    ends = integers.min(), integers.max()
    parts["anchors"] = rans_encode(integers - ends[0], number_cdfs(*ends, q, mu, sigma))
    head = struct.pack(HEAD, *ends, positive.sum(), *map(len, parts.values()))
    return {"header": head, **parts}


def read_base(networks, positions, grid, ones):
    """The parameters that the decoder reads first, and the context that it computes from them."""
    ends = np.cumsum([np.prod(shape) for shape in WEIGHTS.values()])
    arrays = np.split(np.frombuffer(networks, "<f2").astype(float), ends[:-1])
    p = {name: array.reshape(WEIGHTS[name]) for name, array in zip(WEIGHTS, arrays)}
    p["x_a"] = on_lattice(np.frombuffer(positions, "<u2").reshape(A, 3))
    p["grid"] = rans_decode(grid, sign_cdfs(ones)).reshape(-1, F) * 2.0 - 1
    return p, context(p, node_weights(p["x_a"]))[0]


def decode(data):
    """Everything needed to draw: the parameters of a file, and the rounded attributes [A, n]."""
    lowest, highest, ones, *lengths = struct.unpack_from(HEAD, data)
    ends = np.cumsum((struct.calcsize(HEAD), *lengths))
    networks, positions, grid, anchors = (data[a:b] for a, b in zip(ends, ends[1:]))
    p, (q, mu, sigma, _) = read_base(networks, positions, grid, ones)
    integers = rans_decode(anchors, number_cdfs(lowest, highest, q, mu, sigma)) + lowest
    return p, integers.reshape(A, n) * q[:, GROUP]


def coded_bits(p, values):
    """The bits of every anchor [A] by Eq. (11), and those of the grid by Eq. (14)."""
    (q, mu, sigma, hash_bits), _ = context(p, node_weights(p["x_a"]))
    return likelihood(values, mu, sigma, q[:, GROUP])[0].sum(axis=1), hash_bits


if SHOW:
    file = encode(p)
    decoded, values = decode(b"".join(file.values()))
    axis = plot("Bits of every anchor, from above", aspect="equal")
    dots = axis.scatter(*decoded["x_a"][:, :2].T, c=coded_bits(decoded, values)[0], s=60)
    axis.figure.colorbar(dots, label="bits")

# %% [markdown]
# ## All of it
# Keep nothing but the file, and draw from it views that were not used in training.


# %%
def psnr(p, values, views):
    """The mean over views of the peak signal-to-noise ratio in dB."""
    errors = [((draw(p, values, R, T, t) - image) ** 2).mean() for R, T, t, image in views]
    return float(np.mean(-10 * np.log10(errors)))


def report(p, file, views, unseen):
    """Print and return the quality and size of the file; remark on what is odd."""
    before = psnr(p, attributes(p), unseen)
    decoded, values = decode(b"".join(file.values()))
    after = psnr(decoded, values, unseen)
    print(f"unseen views: {before:.2f} dB before coding, {after:.2f} dB from the decoded bytes")
    mean_view = np.mean([image for *_, image in views], axis=0)
    blank = np.mean([-10 * np.log10(((image - mean_view) ** 2).mean()) for *_, image in unseen])
    if after < blank + 1:
        print(f"That is no better than the mean of the training views, {blank:.2f} dB.")
    print("bytes:", ", ".join(f"{part} {len(data)}" for part, data in file.items()))
    anchor_bits, hash_bits = coded_bits(decoded, values)
    bits, coded = anchor_bits.sum() + hash_bits, len(file["grid"] + file["anchors"])
    print(f"entropy coded: {coded} bytes, {bits / 8:.1f} by Eqs. (11) and (14)")
    if abs(8 * coded / bits - 1) > 0.03:
        print("They differ: an unlikely number costs up to 100 bits in Eq. (11), 24 in the coder;")
        print("and every possible integer takes a unit of 2^-24 from the likely ones.")
    return {"before": before, "after": after, "coded": coded, "bits": bits}


def page(file, numbers):
    """Write figures, given by their numbers, below each other into one picture."""
    figures = [plt.figure(number) for number in numbers]
    for figure in figures:
        figure.canvas.draw()
    plt.imsave(file, np.vstack([figure.canvas.buffer_rgba() for figure in figures]))


if SHOW:
    report(p, file, views, unseen)
    times, truths = zip(*((f"t = {t:.2f}", image) for *_, t, image in unseen[::2]))
    pictures = [draw(decoded, values, R, T, t) for R, T, t, _ in unseen[::2]]
    strip("Views that were not used in training", truths, times)
    strip("From the decoded file", pictures)
    errors = np.abs(np.subtract(pictures, truths)).mean(axis=2)  # over the three colours
    strip("Absolute error, 4 times as bright: white is 0.25 or more", errors, white=0.25)
    axis = plot(f"The file: {sum(map(len, file.values())):,} bytes", xlabel="bytes")
    axis.bar_label(axis.barh(list(file), [len(part) for part in file.values()]), padding=3)
    axis.margins(x=0.1)
    axis.invert_yaxis()

# %%
if SHOW:
    folder = (Path(__file__).parent if "__file__" in globals() else Path()) / "out"
    folder.mkdir(exist_ok=True)
    (folder / "00_whole_paper.p4dgs").write_bytes(b"".join(file.values()))
    if figures := plt.get_fignums():  # a notebook has shown and closed them
        page(folder / "00_pictures.png", figures)
        page(folder / "00_whole_paper.png", figures[-4:])
    print(f"all pictures: {folder / '00_pictures.png'}; {time.process_time():.1f} s of one core")

# %% [markdown]
# ## What the numbers say, and what is left out
# Nine tenths of the bytes are networks, stored as float16 and not entropy coded. The paper names
# this limit in its last section; with only 80 anchors it is extreme. An anchor costs about 14 bytes
# for its 26 numbers, and 6 for its position. Most signs of the grid are equal, so h varies little.
# Compared with one mean and deviation for each of the 26 numbers, the context saves 4, 6, 0, 2 and
# 5 % of the anchors' bits with seeds 0 to 4: less than 70 bytes, but its two networks take 3,312.
#
# The package has what this file leaves out: masks and growing (`training/density.py`); tiles and
# clamps (`splatting/`); levels, planes and hashing of the grid (`equations/grid_nodes.py`); an
# entropy coder in integers, the same on every machine (`codec/`); formulas without cancellation,
# a floor under q and a clamp of sigma (Q7, Q8); scenes in which nothing moves (`effects.py`).
# As in the paper, a network gives the colour from each side, where 3DGS stores 48 numbers.
