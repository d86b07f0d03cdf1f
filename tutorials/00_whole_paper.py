# %% [markdown]
# # The whole paper in one file
#
# P-4DGS (arXiv 2510.10030) stores a moving scene as a few *anchors* and some small networks. The
# networks predict Gaussians from the anchors and move them in time. They also predict how finely
# the anchors are quantised, and the probabilities with which an entropy coder writes them. This
# file does all of it on a scene that it draws itself, two moving balls: it trains, writes bytes,
# forgets all but these bytes and the constants below, decodes, and draws pictures.
#
# ![Truth, decoded pictures, their error, and the bytes of the file](pictures/whole_paper.png)
#
#     anchors -> Gaussians -> Gaussians at time t -> image -> L_render      Eqs. (1) to (6), (16)
#     positions -> grid -> steps and probabilities -> bits -> L_rate        Eqs. (7) to (14), (17)
#     L_total = L_render + lambda_rate L_rate                               Eq. (15)
#
# `python tutorials/00_whole_paper.py` takes 10 to 20 seconds; with `--check` it compares gradients
# with finite differences. It needs NumPy, SciPy and matplotlib, and nothing of the package.
#
# **How to read it.** An equation with a gradient is a function that returns its result and its own
# backward, `back`. A name that ends in `_bar` is the gradient of the loss by that name, and `back`
# returns the gradients of those inputs that training changes, in their order. There are A anchors
# with k children each, which are N Gaussians, and an image [P, 3] has P pixels. Lengths are in
# scene units, times run from 0 to 1. Where the paper leaves something open, (Q10) and the like name
# our [choices](reference.md#choices). The last cell lists what this file leaves out.

# %%
import struct
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.special import expit as sigmoid
from scipy.special import ndtr as Phi  # the normal distribution function of Eq. (11)

# Constants of this small scene. The paper's have k = 10, d = 16 and 40,000 iterations, of which
# stages 1 and 2 take 5,000; here they are short, because without motion there is little to learn.
SIZE = 24  # pixels along a side of an image
FOCAL = 30.0  # pixels
A, k, d = 80, 4, 8  # anchors, children of each, features of each
L_x, L_t = 4, 4  # frequencies of the positional encoding
RESOLUTION, F = 8, 4  # the grid of Eq. (9) has 8 x 8 x 8 nodes with F bits each
BOX = 1.3  # anchors stay in [-BOX, BOX]^3
WIDTHS = (d, 3, 3, 3 * k)  # numbers of an anchor in the groups f, s, l, O
GROUP = np.repeat(range(4), WIDTHS)  # the group of each of an anchor's numbers
n = len(GROUP)  # numbers of an anchor
Q_0 = np.array([0.25, 0.01, 0.01, 0.1])  # base steps of the groups (Q6)
BACKGROUND = np.ones(3)
LAMBDA_SSIM, LAMBDA_RATE = 0.2, 5e-4
STAGE_ENDS = (20, 40, 800, 1300)  # iterations

# %% [markdown]
# ## The scene
# Two balls on a white background: one bounces, the other walks half a circle around it. There is
# one picture for each moment, taken by a camera that looks at the origin from another direction.


# %%
def camera(azimuth, elevation, distance=4.0):
    """Rotation R [3, 3] and translation T [3] from world to camera: x right, y down, z forward."""
    (cos_a, cos_e), (sin_a, sin_e) = np.cos([azimuth, elevation]), np.sin([azimuth, elevation])
    z = -np.array([cos_e * cos_a, cos_e * sin_a, sin_e])
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z]), np.array([0, 0, distance])


def pixel_grid(size, finer=1):
    """Coordinates (X, Y) of the pixels from the image's centre, each cut into finer^2 parts."""
    line = (np.arange(size * finer) + 0.5) / finer - size / 2
    return np.meshgrid(line, line)


def truth(R, T, t):
    """Draw the balls at time t by tracing rays: the mean of 4 x 4 rays a pixel, [P, 3]."""
    X, Y = pixel_grid(SIZE, finer=4)
    rays = np.stack([X / FOCAL, Y / FOCAL, np.ones_like(X)], axis=-1) @ R  # in the world
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


# %% [markdown]
# ## From anchors to Gaussians: Eqs. (1) to (4)
# A network is a list `[W0, b0, W1, b1, W2, b2]`: two hidden layers with ReLU, then a linear one.


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


def offsets(x_a, O, l):
    """Eq. (1): the centres of the children, x = x_a + O l."""
    x = x_a[:, None] + O * l[:, None]

    def back(x_bar):
        # one anchor moves all its children: sum over k
        return x_bar.sum(axis=1), x_bar * l[:, None], (x_bar * O).sum(axis=1)

    return x, back


def view(x_a, x_c):
    """Eq. (2): distance and direction from the camera, delta = |x_a - x_c|, (x_a - x_c) / delta."""
    v = x_a - x_c
    delta = np.sqrt((v**2).sum(axis=1, keepdims=True))
    direction = v / delta

    def back(delta_bar, direction_bar):
        along = (direction * direction_bar).sum(axis=1, keepdims=True)
        return direction * delta_bar + (direction_bar - direction * along) / delta

    return (delta, direction), back


def opacity(seen, psi):
    """Eq. (3): alpha = tanh(psi_alpha(f, delta, direction)) of every child; the tanh is (Q4)."""
    y, back_mlp = mlp(seen, psi)
    alpha = np.tanh(y)
    return alpha, lambda alpha_bar: back_mlp(alpha_bar * (1 - alpha**2))


def color(seen, psi):
    """Eq. (3) for colour: c = sigmoid(psi_c(f, delta, direction)), red, green and blue."""
    y, back_mlp = mlp(seen, psi)
    c = sigmoid(y).reshape(len(y), -1, 3)
    return c, lambda c_bar: back_mlp((c_bar * c * (1 - c)).reshape(y.shape))


def normalise(y):
    """r = y / |y| for every quaternion."""
    length = np.sqrt((y**2).sum(axis=-1, keepdims=True))
    r = y / length
    return r, lambda bar: (bar - r * (r * bar).sum(axis=-1, keepdims=True)) / length


def rotation(seen, psi):
    """Eq. (3) for rotation: r = psi_r / |psi_r|, a unit quaternion (w, x, y, z) for every child."""
    y, back_mlp = mlp(seen, psi)
    r, back_normalise = normalise(y.reshape(len(y), -1, 4))
    return r, lambda r_bar: back_mlp(back_normalise(r_bar).reshape(y.shape))


def scale(s_a, seen, psi):
    """Eq. (4): s = s_a sigmoid(psi_s(f, delta, direction)) for every child."""
    y, back_mlp = mlp(seen, psi)
    share = sigmoid(y).reshape(len(y), -1, 3)
    s = s_a[:, None] * share

    def back(s_bar):
        y_bar = s_bar * s * (1 - share)
        return ((s_bar * share).sum(axis=1), *back_mlp(y_bar.reshape(y.shape)))

    return s, back


# %% [markdown]
# ## In time: Eqs. (5) and (6)
# One network moves all Gaussians. It sees where a Gaussian is and what time it is, both in sines of
# several frequencies (Q2). No gradient flows from E(x) back to x (Q10).


# %%
def encoding(v, L):
    """E(v) = (v, sin v, cos v, sin 2v, cos 2v, ..., sin 2^(L-1) v, cos 2^(L-1) v), row by row."""
    waves = [wave(2**j * v) for j in range(L) for wave in (np.sin, np.cos)]
    return np.concatenate([v, *waves], axis=1)


def deformation(x, t, psi):
    """Eq. (5): (delta_x, delta_s, delta_r) = psi_d(E(x), E(t)). `back` gives psi only."""
    E_x, E_t = encoding(x, L_x), encoding(np.full((len(x), 1), t), L_t)
    y, back_mlp = mlp(np.hstack([E_x, E_t]), psi)
    return (y[:, :3], y[:, 3:6], y[:, 6:]), lambda *bars: back_mlp(np.hstack(bars))[1]


def deformed(x, s, r, dx, ds, dr):
    """Eq. (6): x + dx, s + ds, and r + dr brought back to length 1 (Q9)."""
    r_t, back_normalise = normalise(r + dr)

    def back(x_bar, s_bar, r_bar):
        r_bar = back_normalise(r_bar)
        return x_bar, s_bar, r_bar, x_bar, s_bar, r_bar

    return (x + dx, s + ds, r_t), back


# %% [markdown]
# ## Splatting
# The paper takes this part from 3DGS (Kerbl et al. 2023). An ellipsoid has the covariance
# $R\,\mathrm{diag}(s)^2R^T$. Seen by a camera it becomes an ellipse of pixels. Ellipses are painted
# from front to back.


# %%
def covariance(s, r):
    """Sigma = R(r) diag(s)^2 R(r)^T [N, 3, 3] of scales s [N, 3] and unit quaternions r [N, 4]."""
    w, x, y, z = r.T
    R = 2 * np.array(
        [
            [0.5 - y * y - z * z, x * y - w * z, x * z + w * y],
            [x * y + w * z, 0.5 - x * x - z * z, y * z - w * x],
            [x * z - w * y, y * z + w * x, 0.5 - x * x - y * y],
        ]
    )
    R = R.transpose(2, 0, 1)
    M = R * s[:, None]

    def back(Sigma_bar):
        M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ M
        g = (M_bar * s[:, None]).transpose(1, 2, 0)  # the gradient of R
        w_bar = z * (g[1, 0] - g[0, 1]) + y * (g[0, 2] - g[2, 0]) + x * (g[2, 1] - g[1, 2])
        x_bar = y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2])
        y_bar = x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0])
        z_bar = x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1])
        x_bar -= 2 * x * (g[1, 1] + g[2, 2])
        y_bar -= 2 * y * (g[0, 0] + g[2, 2])
        z_bar -= 2 * z * (g[0, 0] + g[1, 1])
        return (M_bar * R).sum(axis=1), 2 * np.stack([w_bar, x_bar, y_bar, z_bar], axis=1)

    return M @ M.transpose(0, 2, 1), back


def projection(x, Sigma, R, T):
    """Centres [N, 2] of the splats from the image's centre, conics [N, 3] and depths [N].

    The covariance of a splat is J R Sigma R^T J^T + 0.3 I with the Jacobian J of the projection,
    its conic (a, b, c) is the inverse [[a, b], [b, c]]. Unit: pixels.
    """
    x_cam = x @ R.T + T
    z = x_cam[:, 2:]
    uv = x_cam[:, :2] / z
    m = (R[:2] - uv[:, :, None] * R[2]) * (FOCAL / z)[:, :, None]  # J R [N, 2, 3]
    cov = m @ Sigma @ m.transpose(0, 2, 1) + 0.3 * np.eye(2)
    K = np.linalg.inv(cov)

    def back(mean_bar, conic_bar):
        a_bar, b_bar, c_bar = conic_bar.T
        K_bar = np.array([[a_bar, b_bar / 2], [b_bar / 2, c_bar]]).transpose(2, 0, 1)
        cov_bar = -K @ K_bar @ K  # d(K) = -K d(cov) K
        m_bar = 2 * cov_bar @ m @ Sigma
        uv_bar = FOCAL * mean_bar - (m_bar @ R[2]) * FOCAL / z
        z_bar = -(uv_bar * uv).sum(axis=1) / z[:, 0]
        z_bar -= (m_bar * m).sum(axis=(1, 2)) / z[:, 0]  # m is proportional to 1 / z
        x_bar = np.concatenate([uv_bar / z, z_bar[:, None]], axis=1) @ R
        return x_bar, m.transpose(0, 2, 1) @ cov_bar @ m

    return (FOCAL * uv, np.stack([K[:, 0, 0], K[:, 0, 1], K[:, 1, 1]], axis=1), z[:, 0]), back


X, Y = (grid.ravel() for grid in pixel_grid(SIZE))
PIXELS = np.stack([X * X, X * Y, Y * Y, X, Y, np.ones_like(X)], axis=1)  # [P, 6]


def compositing(mean, conic, alpha, c):
    """Paint N splats from front to back: image [P, 3] = sum of weight_i c_i + light_N background.

    cover_i = min(0.99, alpha_i exp(-(p - mean_i) K_i (p - mean_i) / 2)) is what splat i covers of
    pixel p, light_i = product of 1 - cover_j over all j before i is what reaches it, and weight_i =
    cover_i light_i. The exponent is quadratic in the pixel's coordinates, so one matrix product
    gives it for all splats at all pixels. Backward, with value_i = c_i image_bar,

        cover_bar_i = light_i value_i - (sum of weight_j value_j behind i, background too)
                                        / (1 - cover_i)
    """
    (u, v), (K_a, K_b, K_c) = mean.T, conic.T
    to_x, to_y = K_a * u + K_b * v, K_b * u + K_c * v
    constant = np.log(alpha) - (to_x * u + to_y * v) / 2
    exponent = PIXELS @ np.array([-K_a / 2, -K_b, -K_c / 2, to_x, to_y, constant])
    unclamped = np.exp(exponent)  # [P, N]
    cover = np.minimum(unclamped, 0.99)
    light = np.cumprod(np.hstack([np.ones((len(cover), 1)), 1 - cover]), axis=1)  # [P, N + 1]
    weight = cover * light[:, :-1]

    def back(image_bar):
        value = image_bar @ c.T
        last = light[:, -1] * (image_bar @ BACKGROUND)
        gains = np.hstack([weight * value, last[:, None]])
        behind = np.cumsum(gains[:, ::-1], axis=1)[:, ::-1][:, 1:]
        cover_bar = light[:, :-1] * value - behind / (1 - cover)
        exponent_bar = cover_bar * unclamped * (unclamped <= 0.99)  # the clamp passes no gradient
        xx, xy, yy, x, y, one = PIXELS.T @ exponent_bar
        x, y = x - one * u, y - one * v  # from here on relative to the splat's centre
        mean_bar = np.stack([K_a * x + K_b * y, K_b * x + K_c * y], axis=1)
        xx -= 2 * u * x + one * u * u
        xy -= u * y + v * x + one * u * v
        yy -= 2 * v * y + one * v * v
        conic_bar = -np.stack([xx / 2, xy, yy / 2], axis=1)
        return mean_bar, conic_bar, one / alpha, weight.T @ image_bar

    return weight @ c + np.outer(light[:, -1], BACKGROUND), back


def render(x, s, r, alpha, c, R, T):
    """The image [P, 3] of Gaussians; `back` gives the gradients of (x, s, r, alpha, c)."""
    Sigma, back_covariance = covariance(s, r)
    (mean, conic, depth), back_projection = projection(x, Sigma, R, T)
    order = np.argsort(depth, kind="stable")
    # Only what is visible (tau_alpha = 0, Q4) and in front of the camera.
    order = order[(alpha[order] > 0) & (depth[order] > 0.2)]
    image, back_compositing = compositing(mean[order], conic[order], alpha[order], c[order])

    def back(image_bar):
        bars = [np.zeros_like(a) for a in (mean, conic, alpha, c)]  # no gradient where not drawn
        for bar, drawn_bar in zip(bars, back_compositing(image_bar)):
            bar[order] = drawn_bar
        mean_bar, conic_bar, alpha_bar, c_bar = bars
        x_bar, Sigma_bar = back_projection(mean_bar, conic_bar)
        return (x_bar, *back_covariance(Sigma_bar), alpha_bar, c_bar)

    return image, back


# %% [markdown]
# ## The loss of a picture: Eq. (16)
# SSIM, the structural similarity, compares local means, variances and covariances of two pictures.
# Each is an average over a Gaussian window of 11 x 11 pixels, with zeros outside the image. The
# window is separable, so a blur is a product with one symmetric matrix from both sides, and its
# backward is the same blur.


# %%
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
    """Eq. (16): (1 - lambda) L1 + lambda (1 - SSIM) (Q13)."""
    similarity, back_ssim = ssim(image, y)
    L1 = np.abs(image - y).mean()

    def back(loss_bar):
        L1_bar = (1 - LAMBDA_SSIM) * loss_bar / image.size
        return L1_bar * np.sign(image - y) + back_ssim(-LAMBDA_SSIM * loss_bar)

    return (1 - LAMBDA_SSIM) * L1 + LAMBDA_SSIM * (1 - similarity), back


# %% [markdown]
# ## The bits: Eqs. (7) to (12) and (14)
# A number f is stored as the integer round(f / q). Rounding has no gradient, so training adds noise
# of the same size instead. Two networks predict the steps q, the means mu and the standard
# deviations sigma. Their input is read from a binary grid at the anchor's position, which the
# decoder knows before everything else.


# %%
STARTS = np.cumsum((0, *WIDTHS[:3]))  # where the groups begin


def noise(f, q, u):
    """Eq. (7): f + u q with u uniform in [-1/2, 1/2]; q [A, 4] has one step for each group."""
    noisy = f + u * q[:, GROUP]
    return noisy, lambda bar: (bar, np.add.reduceat(bar * u, STARTS, axis=1))


def rounding(f, q):
    """The integers round(f / q) of Eq. (10). The decoder multiplies them by the same steps."""
    return np.rint(f / q[:, GROUP]).astype(int)


def node_weights(x_a):
    """The trilinear weights [A, nodes] of all nodes of the grid at the positions x_a [A, 3]."""
    place = (np.clip(x_a / BOX, -1, 1) + 1) / 2 * (RESOLUTION - 1)
    hat = np.maximum(0, 1 - np.abs(place[:, :, None] - np.arange(RESOLUTION)))
    return np.einsum("ai,aj,ak->akji", *hat.transpose(1, 0, 2)).reshape(len(x_a), -1)


def signs(grid):
    """The bits of the grid as -1 and 1. Their gradients pass straight through to the parameters."""
    return np.where(grid >= 0, 1.0, -1.0)


def hash_grid(weights, b):
    """Eq. (9): h = weights b [A, F], the bits around every anchor; every node has its own entry."""
    return weights @ b, lambda h_bar: weights.T @ h_bar


def step(h, psi):
    """Eq. (8): q = Q_0 (1 + tanh(psi_q(h))) [A, 4], one step for each group of every anchor."""
    y, back_mlp = mlp(h, psi)
    q = Q_0 * (1 + np.tanh(y))
    return q, lambda q_bar: back_mlp(q_bar * Q_0 * (1 - np.tanh(y) ** 2))


def prior(h, psi):
    """Eq. (12): mean and deviation (mu, sigma) of all numbers; psi_p gives mu, log sigma (Q8)."""
    y, back_mlp = mlp(h, psi)
    mu, sigma = y[:, :n], np.exp(y[:, n:])
    return (mu, sigma), lambda mu_bar, sigma_bar: back_mlp(np.hstack([mu_bar, sigma_bar * sigma]))


def likelihood(f, mu, sigma, q):
    """Eq. (11): bits = -log2(Phi((f + q/2 - mu) / sigma) - Phi((f - q/2 - mu) / sigma)).

    Above the mean both terms are close to 1, and their difference would lose its digits. So the
    number is mirrored to the other side. Below p = 1e-30 the gradient fades out.
    """
    side = np.sign(f - mu)
    upper = (q / 2 - np.abs(f - mu)) / sigma
    lower = upper - q / sigma
    p = np.maximum(Phi(upper) - Phi(lower), 1e-30)

    def back(bits_bar):
        p_bar = -bits_bar / (p * np.log(2))
        upper_bar = p_bar * np.exp(-(upper**2) / 2) / np.sqrt(2 * np.pi)
        lower_bar = -p_bar * np.exp(-(lower**2) / 2) / np.sqrt(2 * np.pi)
        f_bar = -side * (upper_bar + lower_bar) / sigma
        sigma_bar = -(upper_bar * upper + lower_bar * lower) / sigma
        return f_bar, -f_bar, sigma_bar, (upper_bar - lower_bar) / (2 * sigma)

    return -np.log2(p), back


def hash_rate(b):
    """Eq. (14): N+ (-log2 p+) + N- (-log2 p-) for the signs of the grid, p+ = N+ / (N+ + N-)."""
    plus = (1 + b).sum() / 2
    p = np.clip(plus / b.size, 1e-6, 1 - 1e-6)
    slope = np.log2((1 - p) / p) / 2  # a sign moves N+ by one half; at p = N+ / N, dR / dp = 0
    hash_bits = -plus * np.log2(p) - (b.size - plus) * np.log2(1 - p)
    return hash_bits, lambda bits_bar: np.full_like(b, slope * bits_bar)


# %% [markdown]
# ## Everything in a row: Eqs. (13), (15) and (17)
# `loss` runs all equations forward and returns the whole backward. The paper's four stages switch
# parts on: first the anchors alone, then the noise, then the motion, and at last the grid with its
# networks, and the rate.


# %%
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


def network(p, name):
    """The arrays of a network."""
    return [p[f"{name}.{i}"] for i in range(6)]


def attributes(p):
    """The numbers of every anchor that are rounded and coded, [A, n]: f, s, l, O (Q5)."""
    s, l = np.exp(p["log_s"]), np.exp(p["log_l"])
    return np.concatenate([p["f"], s, l, p["O"].reshape(A, -1)], axis=1)


def groups(values):
    """The inverse of `attributes`: f [A, d], s [A, 3], l [A, 3] and O [A, k, 3]."""
    f, s, l, O = np.split(values, STARTS[1:], axis=1)
    return f, s, l, O.reshape(A, k, 3)


def predict(x_a, values, p, x_c):
    """Eqs. (1) to (4): the Gaussians (x, s, r, alpha, c) of all anchors, N = A k of each."""
    f, s_a, l, O = groups(values)
    (delta, direction), back_view = view(x_a, x_c)
    seen = np.concatenate([f, delta, direction], axis=1)
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


def context(p, weights, relaxed=False):
    """Eqs. (8), (9), (12), (14): steps, means and deviations of all numbers, bits of the grid."""
    b = p["grid"] if relaxed else signs(p["grid"])
    h, back_h = hash_grid(weights, b)
    q, back_q = step(h, network(p, "psi_q"))
    (mu, sigma), back_prior = prior(h, network(p, "psi_p"))
    hash_bits, back_hash_rate = hash_rate(b)

    def back(q_bar, mu_bar, sigma_bar, hash_bits_bar):
        h_q, psi_q = back_q(q_bar)
        h_p, psi_p = back_prior(mu_bar, sigma_bar)
        # straight through where |parameter| <= 1 (Q11)
        grid_bar = (back_h(h_q + h_p) + back_hash_rate(hash_bits_bar)) * (np.abs(p["grid"]) <= 1)
        return grid_bar, {"psi_q": psi_q, "psi_p": psi_p}

    return (q, mu, sigma, hash_bits), back


def loss(p, shot, u, stage, weights=None, relaxed=None):
    """Eq. (15): L_render + LAMBDA_RATE L_rate for one view, its parts, and the whole backward.

    `back` returns {name: gradient}. `relaxed` is for `check`: centres [N, 3] at which psi_d is
    evaluated instead of x, while the grid's parameters take the place of their signs. Then
    differences see what `back` computes.
    """
    R, T, t, image = shot
    values = attributes(p)
    q, bits = np.tile(Q_0, (A, 1)), 0.0
    if stage == 4:
        (q, mu, sigma, hash_bits), back_context = context(p, weights, relaxed is not None)
    noisy, back_noise = noise(values, q, u if stage > 1 else 0 * u)
    (x, s, r, alpha, c), back_predict = predict(p["x_a"], noisy, p, -R.T @ T)
    parts = {"centers": x}
    if stage > 2:
        centers = x if relaxed is None else relaxed
        deltas, back_deformation = deformation(centers, t, network(p, "psi_d"))
        (x, s, r), back_deformed = deformed(x, s, r, *deltas)
    drawn, back_render = render(x, s, r, alpha, c, R, T)
    L_render, back_loss = render_loss(drawn, image)
    if stage == 4:
        number_bits, back_bits = likelihood(noisy, mu, sigma, q[:, GROUP])
        bits = number_bits.sum() + hash_bits  # Eq. (13) is the sum, Eq. (17) adds the grid
        # Only the networks pay nothing. A few lines change that and go beyond the paper (B1): give
        # every array of WEIGHTS a step, learned as its logarithm; add noise of this step with
        # `noise` before `network` reads the array, and at last round; divide by the step, and add
        # the bits of the result under a density around 0 to `bits`. LAMBDA_RATE then shrinks the
        # networks, too (beyond_networks.py).
    L_rate = bits / values.size  # bits per number (Q12)

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
            noisy_bar = noisy_bar + coded_bar  # one noisy number is drawn and coded (Q23)
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
# ## Training
# Adam (Kingma and Ba 2015), one view an iteration. A child whose alpha falls to 0 is not drawn,
# gets no gradient and has no way back. Here a bias and a slow start of psi_alpha keep the children
# alive; the paper grows new anchors instead (Q16).


# %%
# Learning rates at the start; until the end they fall to 0.07 times as much.
RATES = {
    "x_a": 0.002,
    "f": 0.015,
    "log_s": 0.014,
    "log_l": 0.014,
    "O": 0.02,
    "psi_alpha": 0.001,
    "psi_c": 0.008,
    "psi_r": 0.008,
    "psi_s": 0.008,
    "psi_d": 0.003,
    "psi_p": 0.005,
    "psi_q": 0.005,
    "grid": 0.01,
}


def start(rng):
    """The first parameters: random anchors, networks as in PyTorch, children that are visible."""
    p = {name: np.zeros(shape) for name, shape in SHAPES.items()}
    p["x_a"] += rng.uniform(-1, 1, (A, 3))
    p["f"] += 0.1 * rng.normal(size=(A, d))
    p["log_s"] += np.log(2 / A ** (1 / 3))  # about the distance of neighbours
    p["log_l"] += p["log_s"]
    p["grid"] += rng.uniform(-1e-4, 1e-4, p["grid"].shape)
    for name in WEIGHTS:
        stem, i = name.split(".")
        bound = 1 / np.sqrt(NETWORKS[stem][int(i) // 2 * 2][0])  # the layer's inputs
        p[name] += rng.uniform(-bound, bound, p[name].shape)
    p["psi_alpha.5"] += 0.3  # most children start visible
    p["psi_r.5"] += np.tile([1, 0, 0, 0], k)  # near the identity
    p["psi_d.4"] *= 0.01  # nearly at rest
    p["psi_d.5"] *= 0.01
    return p


class Adam:
    """Adam. An array that joins in a later stage counts its steps from then on."""

    def __init__(self):
        self.m = {name: np.zeros(shape) for name, shape in SHAPES.items()}
        self.v = {name: np.zeros(shape) for name, shape in SHAPES.items()}
        self.steps = dict.fromkeys(SHAPES, 0)

    def step(self, p, g, decay):
        """Move the parameters against their gradients g, where they have any."""
        for name, gradient in g.items():
            self.steps[name] += 1
            t, m, v = self.steps[name], self.m[name], self.v[name]
            m += 0.1 * (gradient - m)
            v += 0.001 * (gradient**2 - v)
            rate = decay * RATES[name.split(".")[0]]
            if name.startswith("psi_alpha"):
                rate *= min(1, t / 50)
            p[name] -= rate * m / (1 - 0.9**t) / (np.sqrt(v / (1 - 0.999**t)) + 1e-15)


def lattice(x_a):
    """Positions as 16-bit integers over the box (Q14)."""
    return np.rint((np.clip(x_a / BOX, -1, 1) + 1) / 2 * 65535).astype("<u2")


def on_lattice(integers):
    """The positions that these integers stand for."""
    return (integers / 65535 * 2 - 1) * BOX


def train(views, seed=0):
    """Fit the parameters to the views, and return them."""
    rng = np.random.default_rng(seed)
    p, adam, weights, losses = start(rng), Adam(), None, []
    print(" step  stage L_render   bits")
    for iteration in range(STAGE_ENDS[3]):
        stage = 1 + sum(iteration >= end for end in STAGE_ENDS[:3])
        if stage == 4 and weights is None:
            p["x_a"] = on_lattice(lattice(p["x_a"]))  # from now on the decoder's positions
            weights = node_weights(p["x_a"])
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
            row = f"{iteration + 1:5} {stage:6} {np.mean(losses[-100:]):8.4f} {parts['bits']:6.0f}"
            print(row, flush=True)
    return p


# %% [markdown]
# ## Bytes
# The entropy coder divides 2^24 slots among the symbols, by the probabilities of Eq. (11) and at
# least one for each. rANS (Duda 2013) turns all symbols into a single large integer, since Python's
# integers have no limit. A symbol with a share p of the slots multiplies this integer by about 1/p
# and so adds -log2 p bits. The decoder takes the symbols off in the opposite order. It needs the
# same probabilities, and computes them as the encoder did, in the same floats on the same machine.


# %%
SLOTS = 24  # bits


def put(symbols, firsts):
    """Code the symbols, the last one first. Symbol s owns the slots firsts[s] to firsts[s + 1]."""
    state = 1
    for symbol, first in zip(reversed(symbols.tolist()), reversed(firsts.tolist())):
        start, width = first[symbol], first[symbol + 1] - first[symbol]
        state = (state // width << SLOTS) + state % width + start
    return state.to_bytes(state.bit_length() // 8 + 1, "little")


def take(data, firsts):
    """The inverse of `put`."""
    state, symbols = int.from_bytes(data, "little"), []
    for first in firsts:
        slot = state % 2**SLOTS
        symbol = int(np.searchsorted(first, slot, side="right")) - 1
        start, width = int(first[symbol]), int(first[symbol + 1] - first[symbol])
        state = width * (state >> SLOTS) + slot - start
        symbols.append(symbol)
    return np.array(symbols)


def slots(cumulative):
    """Where the slots of every symbol begin; `cumulative` [count, size + 1] goes from 0 to 1."""
    size = cumulative.shape[1] - 1
    return np.rint(cumulative * (2**SLOTS - size)).astype(int) + np.arange(size + 1)


def number_slots(lowest, highest, q, mu, sigma):
    """The slots of the integers from lowest to highest, for every number of every anchor."""
    q, mu, sigma = (a.reshape(-1, 1) for a in (q[:, GROUP], mu, sigma))
    cumulative = Phi(((np.arange(lowest, highest + 2) - 0.5) * q - mu) / sigma)
    cumulative[:, 0], cumulative[:, -1] = 0, 1
    return slots(cumulative)


def sign_slots(ones):
    """The slots of the grid's signs, of which `ones` are 1."""
    count = RESOLUTION**3 * F
    return np.repeat(slots(np.array([[0, 1 - ones / count, 1]])), count, axis=0)


HEAD = "<2hH4I"  # lowest and highest integer, how many signs are 1, the bytes of all parts


def encode(p):
    """The file: {part: bytes}. All else that a decoder needs stands at the top of this program."""
    positive = (p["grid"] >= 0).ravel().astype(int)
    networks = np.concatenate([p[name].ravel() for name in WEIGHTS])
    parts = {
        "networks": networks.astype("<f2").tobytes(),  # (Q18)
        "positions": lattice(p["x_a"]).tobytes(),
        "grid": put(positive, sign_slots(positive.sum())),
    }
    _, (q, mu, sigma, _) = read_base(*parts.values(), positive.sum())  # what the decoder will see
    integers = rounding(attributes(p), q).ravel()
    ends = integers.min(), integers.max()
    parts["anchors"] = put(integers - ends[0], number_slots(*ends, q, mu, sigma))
    head = struct.pack(HEAD, *ends, positive.sum(), *map(len, parts.values()))
    return {"header": head, **parts}


def read_base(networks, positions, grid, ones):
    """The parameters that the decoder reads first, and the context that it computes from them."""
    ends = np.cumsum([np.prod(shape) for shape in WEIGHTS.values()])
    arrays = np.split(np.frombuffer(networks, "<f2").astype(float), ends[:-1])
    p = {name: array.reshape(WEIGHTS[name]) for name, array in zip(WEIGHTS, arrays)}
    p["x_a"] = on_lattice(np.frombuffer(positions, "<u2").reshape(A, 3))
    p["grid"] = take(grid, sign_slots(ones)).reshape(-1, F) * 2.0 - 1
    return p, context(p, node_weights(p["x_a"]))[0]


def decode(data):
    """All that is needed to draw: the parameters of a file, and the rounded attributes [A, n]."""
    lowest, highest, ones, *lengths = struct.unpack_from(HEAD, data)
    ends = np.cumsum((struct.calcsize(HEAD), *lengths))
    networks, positions, grid, anchors = (data[a:b] for a, b in zip(ends, ends[1:]))
    p, (q, mu, sigma, _) = read_base(networks, positions, grid, ones)
    integers = take(anchors, number_slots(lowest, highest, q, mu, sigma)) + lowest
    return p, integers.reshape(A, n) * q[:, GROUP]


def draw(p, values, R, T, t):
    """The picture [P, 3] at time t; `values` are attributes as in training or as decoded."""
    (x, s, r, alpha, c), _ = predict(p["x_a"], values, p, -R.T @ T)
    (x, s, r), _ = deformed(x, s, r, *deformation(x, t, network(p, "psi_d"))[0])
    return np.clip(render(x, s, r, alpha, c, R, T)[0], 0, 1)


def psnr(p, values, views):
    """The mean over views of the peak signal-to-noise ratio in dB."""
    errors = [((draw(p, values, R, T, t) - image) ** 2).mean() for R, T, t, image in views]
    return float(np.mean(-10 * np.log10(errors)))


# %% [markdown]
# ## Checking the gradients
# Along a random direction the gradient must give the slope of the loss, and finite differences
# measure that slope. In two places the gradient is not the slope, on purpose: the grid's signs pass
# it straight through, and E(x) passes none to x. `relaxed` takes both out of the comparison. A
# nudge can swap two splats in depth, which makes the loss jump. So there are two nudges, and one of
# them has to agree.


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
        fixed = shot, u, stage, weights, parts["centers"]
        for name, array_bar in loss(p, *fixed)[2]().items():
            direction = rng.normal(size=array_bar.shape)
            slope, differences = (array_bar * direction).sum(), []
            for nudge in (1e-6, 1e-7):
                ends = [
                    loss(p | {name: p[name] + side * nudge * direction}, *fixed)[0]
                    for side in (1, -1)
                ]
                differences.append((ends[0] - ends[1]) / (2 * nudge))
            if all(abs(slope - other) > 1e-4 * abs(other) + 1e-8 for other in differences):
                off = abs(slope - differences[0]) / max(abs(differences[0]), 1e-300)
                wrong.append(
                    f"stage {stage}, {name}: gradient {slope:.6g}, by differences "
                    f"{differences[0]:.6g}, relative error {off:.1e}"
                )
    return wrong


# %% [markdown]
# ## All of it
# Train, write the file, keep nothing but the file, and draw from it views that were not used in
# training.


# %%
def picture(p, values, views, file):
    """Truth, decoded picture and error of some views, and the bytes by part."""
    figure, axes = plt.subplots(3, len(views) + 2, figsize=(9, 4), layout="constrained")
    for column, (R, T, t, image) in zip(axes.T, views):
        decoded = draw(p, values, R, T, t)
        column[0].set_title(f"t = {t:.2f}")
        for axis, pixels in zip(column, (image, decoded, np.abs(decoded - image))):
            axis.imshow(pixels.reshape(SIZE, SIZE, 3).clip(0, 1))
            axis.set(xticks=[], yticks=[])
    for axis, name in zip(axes[:, 0], ("truth", "decoded", "error")):
        axis.set_ylabel(name)
    for axis in axes[:, -2:].ravel():
        axis.remove()
    bars = figure.add_subplot(axes[0, 0].get_gridspec()[:, -2:])
    bars.bar_label(bars.barh(list(file), [len(part) for part in file.values()]), padding=3)
    bars.invert_yaxis()
    bars.margins(x=0.4)
    bars.set(xlabel="bytes", title=f"{sum(map(len, file.values())):,} bytes")
    return figure


def main(seed=0, folder=None):
    """Train, encode, decode, measure, draw. Returns the measured numbers."""
    began = time.process_time()
    here = Path(__file__).parent if "__file__" in globals() else Path()
    folder = folder or here / "out"
    folder.mkdir(exist_ok=True)
    views, unseen = shots(24, 0), shots(8, 0.37)
    p = train(views, seed)
    before = psnr(p, attributes(p), unseen)
    file = encode(p)
    (folder / "00_whole_paper.p4dgs").write_bytes(b"".join(file.values()))

    del p
    p, values = decode((folder / "00_whole_paper.p4dgs").read_bytes())
    after = psnr(p, values, unseen)
    (q, mu, sigma, hash_bits), _ = context(p, node_weights(p["x_a"]))
    bits = likelihood(values, mu, sigma, q[:, GROUP])[0].sum() + hash_bits
    coded = len(file["grid"]) + len(file["anchors"])
    print(f"unseen views: {before:.2f} dB before coding, {after:.2f} dB from the decoded bytes")
    print("bytes:", ", ".join(f"{part} {len(data)}" for part, data in file.items()))
    print(f"entropy coded: {coded} bytes, {bits / 8:.1f} by Eqs. (11) and (14)")
    picture(p, values, unseen[::2], file).savefig(folder / "00_whole_paper.png", dpi=100)
    print(f"{time.process_time() - began:.1f} seconds of one core")
    return {"before": before, "after": after, "coded": coded, "bits": bits, "file": file}


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit("\n".join(check()) or print("all gradients match finite differences"))
    main()

# %% [markdown]
# ## What the numbers say, and what is left out
# Nine tenths of the bytes are networks, as float16 and not entropy coded. This is the limit that
# the paper names in its last section, in an extreme form: this scene needs only 80 anchors. An
# anchor costs about 14 bytes for its 26 numbers, and 6 for its position. Most of the grid's signs
# are equal, so h varies little from anchor to anchor. With seeds 0 to 4 the context saves 4, 6, 0,
# 2 and 5 % of the anchors' bits against one mean and deviation for each of the 26 numbers: less
# than 70 bytes, and its two networks take 3,312. `p4dgs-ref accuracy --only context` measures
# from how many anchors on it pays.
#
# The package has what this file leaves out: permanent masks and growing (`training/density.py`);
# tiles and the clamp of the projection (`splatting/`); several levels, planes and hashing of the
# grid (`equations/grid_nodes.py`); an entropy coder that uses integers alone, so that every machine
# decodes the same numbers (`codec/`); formulas that keep their digits, a floor under q and a clamp
# of sigma (Q7, Q8; `equations/numerics.py`, `likelihood.py`); scenes in which nothing moves or
# nothing depends on the view (`effects.py`). Spherical harmonics are missing because the paper has
# none: a network predicts the colour from the view.
