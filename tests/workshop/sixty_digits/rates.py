"""Eqs. (7) to (15), (17) and B1 in decimals, as printed: context, quantisation, bits."""

from decimal import ROUND_FLOOR, ROUND_HALF_EVEN, Decimal
from itertools import product

import numpy as np

from .floats import each
from .functions import exp, log, log1p, log_mass, sigmoid
from .prediction import network

FLOOR = Decimal(2) ** -10  # Q7, of Q_0
RAW = Decimal(-14), Decimal(6)  # Q8
PRIMES = 1, 2654435761, 805459861  # Q11


def forward_noise(f, u, q):
    return {"f_noisy": f + u * q}


def forward_step(h, weights, biases, Q_0):
    """Q_0 (1 + tanh v) = 2 Q_0 sigmoid(2v), which keeps its digits, but not below the floor."""
    return {"q": Q_0 * np.maximum(2 * each(sigmoid, 2 * network(h, weights, biases)), FLOOR)}


def forward_rounding(f, q):
    """Ties are those of the exact quotient.

    With this many digits, no quotient of two floats is near a tie without being one.
    """
    symbols = each(lambda ratio: ratio.to_integral_value(ROUND_HALF_EVEN), f / q)
    return {"symbols": symbols, "f_hat": symbols * q}


# --- the context ---------------------------------------------------------------------------------
def forward_hash_grid(x_a, lo, hi, grids, resolutions, held=None):
    """Multilinear reads of signs.

    `held` are the parameters whose signs stay, while the clipped ones move (straight-through).
    """
    signs = [sign_of(grid, at) for grid, at in zip(grids, grids if held is None else held)]
    h = [
        [
            value
            for grid, (axes, res) in zip(signs, resolutions)
            for value in read(grid, axes, res, point, lo, hi)
        ]
        for point in x_a
    ]
    return {"h": np.array(h, object).reshape(len(x_a), sum(grid.shape[1] for grid in grids))}


def sign_of(grid, held):
    return np.where(held >= 0, Decimal(1), Decimal(-1)) + _clipped(grid) - _clipped(held)


def _clipped(a):
    return np.clip(a, Decimal(-1), Decimal(1))


def read(grid, axes, res, point, lo, hi):
    """The F features of one level at one point: the sum over the 2^D corners of its cell."""
    base, fraction = [], []
    for axis in ("xyz".index(letter) for letter in axes):
        extent = hi[axis] - lo[axis]
        u = (point[axis] - lo[axis]) / extent if extent > 0 else Decimal(0)
        node = min(max(u, Decimal(0)), Decimal(1)) * (res - 1)
        base.append(int(node.to_integral_value(ROUND_FLOOR)))
        fraction.append(node - base[-1])
    total = 0 * grid[0]
    for corner in product((0, 1), repeat=len(base)):
        weight = Decimal(1)
        for step, part in zip(corner, fraction):
            weight *= part if step else 1 - part
        total = (
            total
            + weight
            * grid[entry([min(b + step, res - 1) for b, step in zip(base, corner)], res, len(grid))]
        )
    return total


def entry(node, res, table):
    """Row of the table: dense where every node has its own, else Instant-NGP's hash in 32 bits."""
    if res ** len(node) <= table:
        return sum(i * res**axis for axis, i in enumerate(node))
    hashed = 0
    for i, prime in zip(node, PRIMES):
        hashed ^= i * prime % 2**32
    return hashed % table


def forward_prior(h, weights, biases, widths):
    """In each group all mu come first, then all raw sigma."""
    y, mu, raw, start = network(h, weights, biases), [], [], 0
    for width in widths:
        mu.append(y[:, start : start + width])
        raw.append(y[:, start + width : start + 2 * width])
        start += 2 * width
    return {
        "mu": np.concatenate(mu, axis=1),
        "sigma": each(exp, np.clip(np.concatenate(raw, axis=1), *RAW)),
    }


# --- bits ----------------------------------------------------------------------------------------
def forward_likelihood(f_noisy, mu, sigma, q):
    return {"bits": -each(log_mass, (f_noisy - mu) / sigma, q / sigma) / log(Decimal(2))}


def forward_anchor_rate(bits_f, bits_O, bits_l, bits_s, mask):
    """Masked offsets cost nothing."""
    return {
        "R_anchor": sum((bits.sum() for bits in (bits_f, bits_O[mask], bits_l, bits_s)), Decimal(0))
    }


def forward_hash_rate(grids, held=None):
    """N+ is a count; with `held` signs it moves by half the change of every clipped parameter."""
    n = Decimal(sum(grid.size for grid in grids))
    n_pos = sum(
        ((1 + sign_of(grid, at)) / 2).sum()
        for grid, at in zip(grids, grids if held is None else held)
    )
    return {"R_hash": _cost(n_pos, n) + _cost(n - n_pos, n), "n_pos": n_pos, "n_neg": n - n_pos}


def _cost(count, n):
    """-count log2(count / n), as log(1 + rest / count); 0 for a sign that does not occur."""
    return count * log1p((n - count) / count) / log(Decimal(2)) if count > 0 else Decimal(0)


def forward_total_loss(L_render, L_rate, lambda_rate):
    return {"L_total": lambda_rate * L_rate + L_render}


def forward_rate_loss(R_anchor, R_hash, n_parameters):
    bits = R_anchor + R_hash
    return {"bits": bits, "L_rate": bits / n_parameters if n_parameters else 0 * bits}


CONTEXT_NET = ("h", "weights", "biases")
FORMULAS = {  # key -> formula, inputs that receive a gradient
    "noise": (forward_noise, ("f", "q")),
    "step": (forward_step, CONTEXT_NET),
    "hash_grid": (forward_hash_grid, ("grids",)),
    "rounding": (forward_rounding, ()),
    "likelihood": (forward_likelihood, ("f_noisy", "mu", "sigma", "q")),
    "prior": (forward_prior, CONTEXT_NET),
    "anchor_rate": (forward_anchor_rate, ("bits_f", "bits_O", "bits_l", "bits_s")),
    "hash_rate": (forward_hash_rate, ("grids",)),
    "total_loss": (forward_total_loss, ("L_render", "L_rate")),
    "rate_loss": (forward_rate_loss, ("R_anchor", "R_hash")),
}
