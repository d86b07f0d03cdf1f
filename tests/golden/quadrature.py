"""The true values of Eq. (11) for the search: quadrature of the density in the longest float.

For other equations the search asks the equation itself in a longer precision. Eq. (11) computes in
float64 whatever the precision of its inputs.
"""

import math

import numpy as np

LONG = np.longdouble
PI = LONG(math.pi) + LONG(1.2246467991473532e-16)
# Gauss-Legendre: over an exponent of 45, four pieces of order 30 leave errors below 1e-20.
ORDER, PIECES = 30, 4


def _nodes():
    """Points and weights on [-1, 1]: those of NumPy, refined to LONG by Newton's method."""
    x = np.polynomial.legendre.leggauss(ORDER)[0].astype(LONG)
    for _ in range(2):
        before, p = np.ones_like(x), x
        for n in range(2, ORDER + 1):
            before, p = p, ((2 * n - 1) * x * p - (n - 1) * before) / n
        slope = ORDER * (x * p - before) / (x * x - 1)
        x = x - p / slope
    return x, 2 / ((1 - x * x) * slope**2)


POINTS, WEIGHTS = _nodes()


def mass(low, length):
    """p / phi(low) of a bin: the integral of exp(-low t - t^2/2) over 0 <= t <= length.

    For low >= -1.
    """
    end = np.where(low > 4, 45 / np.maximum(low, 4), 13)  # beyond, the integrand is below e^-45
    end = np.minimum(length, end)
    total = np.zeros_like(low)
    for piece in range(PIECES):
        t = (end / PIECES)[..., None] * (piece + (1 + POINTS) / 2)
        total += end / (2 * PIECES) * (np.exp(-(low[..., None] + t / 2) * t) @ WEIGHTS)
    return total


def likelihood(inputs, cotangents):
    """Bits and their gradients, ({"bits": ...}, {"f_noisy": ..., ...}), in LONG."""
    x, mu, sigma, q = (np.asarray(inputs[name], LONG) for name in ("f_noisy", "mu", "sigma", "q"))
    offset, log_2 = x - mu, np.log(LONG(2))
    z, w = np.abs(offset) / sigma, q / sigma
    low, high = (np.abs(offset) - q / 2) / sigma, (np.abs(offset) + q / 2) / sigma
    root = np.sqrt(2 * PI)
    tails = sum(np.exp(-v * v / 2) * mass(v, np.full_like(v, 99)) for v in (np.abs(low), high))
    tails = tails / root
    # A mean well inside the bin: one minus both tails.
    around, beside = low < -1, mass(np.maximum(low, -1), w)
    log_p = np.where(
        around,
        np.log1p(-np.where(around, tails, 0)),
        np.log(beside) - low * low / 2 - np.log(2 * PI) / 2,
    )
    ratio = np.where(around, np.exp(-low * low / 2 - log_p) / root, 1 / beside)  # phi(low) / p
    drop = -np.expm1(-z * w)
    bar = -np.asarray(cotangents["bits_bar"], LONG) / (log_2 * sigma)
    f_bar, q_bar = -np.sign(offset) * bar * ratio * drop, bar * ratio * (1 - drop / 2)
    sigma_bar = -(f_bar * offset + q_bar * q) / sigma
    return {"bits": -log_p / log_2}, {
        "f_noisy": f_bar,
        "mu": -f_bar,
        "q": q_bar,
        "sigma": sigma_bar,
    }
