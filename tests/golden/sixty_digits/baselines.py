"""D1 to D3, H1 to H3 and G1 to G4 in decimals, from the formulas of the baselines' authors."""

from decimal import Decimal

import numpy as np

from .floats import each
from .functions import HALF, cos, exp, pi, sigmoid
from .prediction import NO_LENGTH, encoded, network, unit

ONE = Decimal(1)


def forward_activations(log_s, raw_r, logit_alpha):
    return {"s": each(exp, log_s), "r": unit(raw_r), "alpha": each(sigmoid, logit_alpha)}


def forward_sh_color(d, sh):
    Y = np.stack(harmonics(*d.T)[: sh.shape[2]], axis=1)
    return {"color": np.maximum(HALF + (sh * Y[:, None, :]).sum(axis=2), Decimal(0))}


def harmonics(x, y, z):
    """The real spherical harmonics up to degree 3, with constants from their norms."""

    def norm(above, below):
        return (Decimal(above) / (below * pi())).sqrt()

    xx, yy, zz = x * x, y * y, z * z
    return [
        norm(1, 4) * (xx * 0 + 1),
        -norm(3, 4) * y,
        norm(3, 4) * z,
        -norm(3, 4) * x,
        norm(15, 4) * x * y,
        -norm(15, 4) * y * z,
        norm(5, 16) * (2 * zz - xx - yy),
        -norm(15, 4) * x * z,
        norm(15, 16) * (xx - yy),
        -norm(35, 32) * y * (3 * xx - yy),
        norm(105, 4) * x * y * z,
        -norm(21, 32) * y * (4 * zz - xx - yy),
        norm(7, 16) * z * (2 * zz - 3 * xx - 3 * yy),
        -norm(21, 32) * x * (4 * zz - xx - yy),
        norm(105, 16) * z * (xx - yy),
        -norm(35, 32) * x * (xx - 3 * yy),
    ]


def forward_deformation_d3dgs(x, t, weights, biases, time_weights, time_biases, L_x, L_t):
    time = encoded(np.full((len(x), 1), t, object), L_t)
    if len(time_weights):
        time = network(time, time_weights, time_biases)
    inputs = h = np.concatenate([encoded(x, L_x), time], axis=1)
    for W, b in zip(weights[:-3], biases[:-3]):
        if W.shape[0] > h.shape[1]:  # the skip
            h = np.concatenate([inputs, h], axis=1)
        h = np.maximum(h @ W + b, Decimal(0))
    heads = (h @ W + b for W, b in zip(weights[-3:], biases[-3:]))
    return dict(zip(("delta_x", "delta_s", "delta_r"), heads))


def forward_plane_features(x, t, lo, hi, planes):
    rows = []
    for point in x:
        u = [(p - a) / (b - a if b > a else ONE) for p, a, b in zip(point, lo, hi)]
        u = [min(max(v, Decimal(0)), ONE) for v in (*u, t)]
        levels = [planes[i : i + 6] for i in range(0, len(planes), 6)]
        rows.append(np.concatenate([level_features(u, level) for level in levels]))
    features = planes[0].shape[2] * (len(planes) // 6)
    return {"features": np.array(rows, object).reshape(len(x), features)}


def level_features(u, level):
    """The product of the six planes xy, xz, yz, xt, yt, zt at one point."""
    product = ONE
    for pair, plane in zip(((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)), level):
        product = product * bilinear(plane, *(u[axis] for axis in pair))
    return product


def bilinear(plane, u, v):
    """A plane [I, J, F] between its nodes; the first and the last are at 0 and 1."""
    (i, k, a), (j, m, b) = (neighbours(w, n) for w, n in zip((u, v), plane.shape))
    above = (1 - b) * plane[i, j] + b * plane[i, m]
    below = (1 - b) * plane[k, j] + b * plane[k, m]
    return (1 - a) * above + a * below


def neighbours(w, n):
    """The two of n nodes around w, and how far w is from the first to the second."""
    low = int(w * (n - 1))
    return low, min(low + 1, n - 1), w * (n - 1) - low


def forward_plane_decoder(features, weights, biases):
    h = np.maximum(network(features, weights[:-6], biases[:-6]), Decimal(0))
    pairs = [slice(len(weights) - i, len(weights) - i + 2) for i in (6, 4, 2)]
    heads = (network(h, weights[pair], biases[pair]) for pair in pairs)
    return dict(zip(("delta_x", "delta_log_s", "delta_raw_r"), heads))


def forward_plane_losses(planes):
    L_space = L_time = L_one = Decimal(0)
    for i, P in enumerate(planes):
        if i % 6 < 3:
            L_space += mean_square(P[1:] - P[:-1]) + mean_square(P[:, 1:] - P[:, :-1])
        else:
            L_time += mean_square(P[:, 2:] - 2 * P[:, 1:-1] + P[:, :-2])
            L_one += sum(abs(v - 1) for v in P.ravel()) / P.size
    return {"L_space": L_space, "L_time": L_time, "L_one": L_one}


def mean_square(a):
    return sum((v * v for v in a.ravel()), Decimal(0)) / max(a.size, 1)


def forward_rotation_4d(raw_l, raw_r):
    l, r = unit(raw_l), unit(raw_r)
    conjugate = r * np.array([1, -1, -1, -1])
    R = np.full((len(l), 4, 4), Decimal(0), object)
    for axis in range(4):
        v = np.full(l.shape, Decimal(0), object)
        v[:, (axis + 1) % 4] = ONE  # the axes x, y, z, t are those of i, j, k and 1
        R[:, :, axis] = np.roll(hamilton(hamilton(l, v), conjugate), -1, axis=1)
    return {"R": R}


def hamilton(p, q):
    """The products of quaternions (w, x, y, z)."""
    a, b, c, d = p.T
    e, f, g, h = q.T
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        axis=1,
    )


def forward_conditional(x, mu_t, s, R, t):
    M = R * s[:, None, :]
    Sigma = (M[:, :, None, :] * M[:, None, :, :]).sum(axis=3)
    A, b, var_t = Sigma[:, :3, :3], Sigma[:, :3, 3], Sigma[:, 3, 3] + NO_LENGTH
    velocity = b / var_t[:, None]
    return {
        "x_t": x + velocity * (t - mu_t)[:, None],
        "Sigma_t": A - velocity[:, :, None] * b[:, None, :],
        "var_t": var_t,
    }


def forward_marginal(alpha, mu_t, var_t, t):
    weight = each(exp, -((t - mu_t) ** 2) / (2 * var_t))
    return {"alpha_t": alpha * weight, "weight": weight}


def forward_spherindrical(sh, mu_t, t):
    waves = [each(cos, 2 * n * pi() * (t - mu_t)) for n in range(sh.shape[2])]
    terms = (wave[:, None, None] * sh[:, :, n] for n, wave in enumerate(waves))
    return {"sh_t": sum(terms)}


FORMULAS = {  # key -> formula, inputs that receive a gradient
    "activations": (forward_activations, ("log_s", "raw_r", "logit_alpha")),
    "sh_color": (forward_sh_color, ("d", "sh")),
    "deformation_d3dgs": (
        forward_deformation_d3dgs,
        ("x", "weights", "biases", "time_weights", "time_biases"),
    ),
    "plane_features": (forward_plane_features, ("x", "planes")),
    "plane_decoder": (forward_plane_decoder, ("features", "weights", "biases")),
    "plane_losses": (forward_plane_losses, ("planes",)),
    "rotation_4d": (forward_rotation_4d, ("raw_l", "raw_r")),
    "conditional": (forward_conditional, ("x", "mu_t", "s", "R")),
    "marginal": (forward_marginal, ("alpha", "mu_t", "var_t")),
    "spherindrical": (forward_spherindrical, ("sh", "mu_t")),
}
