"""Eqs. (1) to (6) in decimals, from the printed formulas: from anchors to Gaussians at time t."""

from decimal import Decimal

import numpy as np

from .floats import each
from .functions import cos, sigmoid, sin, tanh

NO_LENGTH = Decimal("1e-24")  # Q4: r / sqrt(|r|^2 + 1e-24)


def network(x, weights, biases):
    """relu(... relu(x W_0 + b_0) ...) W_n + b_n."""
    for i, (W, b) in enumerate(zip(weights, biases)):
        x = x @ W + b
        if i < len(weights) - 1:
            x = np.maximum(x, Decimal(0))
    return x


def forward_mlp(x, weights, biases):
    return {"y": network(x, weights, biases)}


# --- spatial prediction --------------------------------------------------------------------------
def forward_offsets(x_a, O_a, l_a):
    return {"x": x_a[:, None, :] + O_a * l_a[:, None, :]}


def forward_view(x_a, x_c):
    v = x_a - x_c
    delta_vc = root((v * v).sum(axis=1, keepdims=True))
    return {"delta_vc": delta_vc, "d_vc": v / np.where(delta_vc == 0, Decimal(1), delta_vc)}


def root(squares):
    return each(Decimal.sqrt, squares)


def unit(r):
    """Quaternions (..., 4) divided by their safe length."""
    return r / root((r * r).sum(axis=-1, keepdims=True) + NO_LENGTH)


def predicted(f_a, delta_vc, d_vc, weights, biases, width):
    """The output of one of the four anchor networks, child by child (A, k, width)."""
    y = network(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
    return y.reshape(len(y), y.shape[1] // width, width)


def forward_opacity(f_a, delta_vc, d_vc, weights, biases):
    return {"alpha": each(tanh, predicted(f_a, delta_vc, d_vc, weights, biases, 1)[:, :, 0])}


def forward_color(f_a, delta_vc, d_vc, weights, biases):
    return {"color": each(sigmoid, predicted(f_a, delta_vc, d_vc, weights, biases, 3))}


def forward_rotation(f_a, delta_vc, d_vc, weights, biases):
    return {"r": unit(predicted(f_a, delta_vc, d_vc, weights, biases, 4))}


def forward_scale(s_a, f_a, delta_vc, d_vc, weights, biases):
    return {
        "s": s_a[:, None, :] * each(sigmoid, predicted(f_a, delta_vc, d_vc, weights, biases, 3))
    }


def forward_masking(x, s, r, alpha, color, mask, tau_alpha):
    """The children that are neither masked nor below the threshold, anchor by anchor."""
    A, k = alpha.shape
    kept = [(a, j) for a in range(A) for j in range(k) if mask[a, j] and alpha[a, j] >= tau_alpha]
    rows = tuple(np.array(kept, int).reshape(-1, 2).T)
    gathered = {name: a[rows] for name, a in dict(alpha=alpha, x=x, color=color, s=s, r=r).items()}
    return {**gathered, "index": [a * k + j for a, j in kept]}


# --- temporal prediction -------------------------------------------------------------------------
def encoded(p, L):
    """E(p) = (p, sin p, cos p, sin 2p, cos 2p, ...), each of the whole vector p (N, D)."""
    parts = [p]
    for j in range(L):
        parts += [each(sin, 2**j * p), each(cos, 2**j * p)]
    return np.concatenate(parts, axis=1)


def forward_positional_encoding(p, L):
    return {"E": encoded(p, L)}


def forward_deformation(x, t, weights, biases, L_x, L_t):
    moment = np.full((len(x), 1), t, object)
    trunk = np.concatenate([encoded(x, L_x), encoded(moment, L_t)], axis=1)
    for W, b in zip(weights[:-3], biases[:-3]):
        trunk = np.maximum(trunk @ W + b, Decimal(0))
    heads = (trunk @ W + b for W, b in zip(weights[-3:], biases[-3:]))
    return dict(zip(("delta_x", "delta_s", "delta_r"), heads))


def forward_deformed(x, s, r, delta_x, delta_s, delta_r):
    """A delta of zero width belongs to an effect that is off: its attribute passes unchanged."""
    return {
        "x_t": x + delta_x if delta_x.shape[1] else x,
        "s_t": s + delta_s if delta_s.shape[1] else s,
        "r_t": unit(r + delta_r) if delta_r.shape[1] else r,
    }


VIEW = ("f_a", "delta_vc", "d_vc", "weights", "biases")
FORMULAS = {  # key -> formula, inputs that receive a gradient
    "mlp": (forward_mlp, ("x", "weights", "biases")),
    "offsets": (forward_offsets, ("x_a", "O_a", "l_a")),
    "view": (forward_view, ("x_a",)),
    "opacity": (forward_opacity, VIEW),
    "masking": (forward_masking, ("alpha", "x", "color", "s", "r")),
    "color": (forward_color, VIEW),
    "rotation": (forward_rotation, VIEW),
    "scale": (forward_scale, ("s_a", *VIEW)),
    "positional_encoding": (forward_positional_encoding, ("p",)),
    "deformation": (forward_deformation, ("x", "weights", "biases")),
    "deformed": (forward_deformed, ("x", "s", "r", "delta_x", "delta_s", "delta_r")),
}
