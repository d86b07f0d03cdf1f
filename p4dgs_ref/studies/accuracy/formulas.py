"""Other formulas for Eq. (11) that trade accuracy for time, measured beside those of `gaussian_bin`, and their truth.

All take x, mu, sigma, q of one shape and return a `gaussian_bin.Bin`; with z = |x - mu| / sigma and w = q / sigma a bin
reaches from low = z - w/2 to high = z + w/2.
"""

from functools import cache

import numpy as np
from scipy.special import log_ndtr, ndtr, roots_legendre

from ...equations.gaussian_bin import PHI_0, Bin, hac, literal, stable

TABLE_REACH = 8.0  # sigmas: beyond, the tables are constant
TABLE_FLOOR = 2.0**-24  # the least mass a table gives, as a coder with 24-bit frequencies has


def edges(x, mu, sigma, q):
    """z with its sign, w, and the bin's two edges seen from mu in sigmas, the nearer one first."""
    z, w = (x - mu) / sigma, q / sigma
    distance = np.abs(z)
    return z, w, distance - w / 2, distance + w / 2


def slopes(z, phi_low, phi_high):
    """The slopes of log p in z and in w from the densities at the edges, each divided by p."""
    return np.where(z < 0, -1, 1).astype(z.dtype) * (phi_high - phi_low), 0.5 * (phi_high + phi_low)


def symmetric(x, mu, sigma, q):
    """The difference of the two tails on the bin's own side of mu: no cancellation of values near one."""
    z, w, low, high = edges(x, mu, sigma, q)
    p = ndtr(-low) - ndtr(-high)
    with np.errstate(divide="ignore", invalid="ignore"):
        densities = (PHI_0 * np.exp(-0.5 * edge * edge) / p for edge in (low, high))
        return Bin(np.log(p), z, w, *slopes(z, *densities))


def log_domain(x, mu, sigma, q):
    """log(a - b) = log a + log(1 - b/a) on the logarithms of the two tails: nothing underflows."""
    z, w, low, high = edges(x, mu, sigma, q)
    near, beyond = log_ndtr(-low), log_ndtr(-high)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        log_p = near + np.log(-np.expm1(beyond - near))
        densities = (PHI_0 * np.exp(-0.5 * edge * edge - log_p) for edge in (low, high))
        return Bin(log_p, z, w, *slopes(z, *densities))


@cache
def normal_table(entries, dtype):
    """Phi at `entries` equal steps a sigma from -TABLE_REACH to TABLE_REACH."""
    return ndtr(np.arange(-TABLE_REACH * entries, TABLE_REACH * entries + 1) / entries).astype(
        dtype
    )


def table(entries):
    """The formula that reads Phi from a table with linear interpolation, and its density from the same table's slope."""

    def log_mass(x, mu, sigma, q):
        z, w, low, high = edges(x, mu, sigma, q)
        values = normal_table(entries, z.dtype)

        def read(edge):
            place = (
                np.clip(edge, -TABLE_REACH, TABLE_REACH) + z.dtype.type(TABLE_REACH)
            ) * z.dtype.type(entries)
            i = np.minimum(place.astype(np.int64), len(values) - 2)
            rise = values[i + 1] - values[i]
            return values[i] + (place - i).astype(z.dtype) * rise, rise * z.dtype.type(entries)

        (at_low, phi_low), (at_high, phi_high) = read(-low), read(-high)
        p = np.maximum(at_low - at_high, z.dtype.type(TABLE_FLOOR))
        return Bin(np.log(p), z, w, *slopes(z, phi_low / p, phi_high / p))

    return log_mass


FORMULAS = {
    "literal": literal,
    "HAC, floor 1e-6": hac,
    "tail-symmetric": symmetric,
    "log domain": log_domain,
    "table, 256 a sigma": table(256),
    "stable": stable,
}
TABLES = (16, 64, 256, 1024, 4096)


@cache
def quadrature(panels=8, points=20):
    """Gauss-Legendre nodes and weights on [0, 1], in panels, because the weights of a long rule lose digits at its ends."""
    nodes, weights = roots_legendre(points)
    starts = np.arange(panels)[:, None] / panels
    return (starts + (nodes + 1) / (2 * panels)).ravel(), np.tile(weights / (2 * panels), panels)


def scaled_mass(a, w):
    """The mass from a to a + w over the density at a, for a >= 0, by quadrature: every term is positive.

    The integral of exp(-a t - t^2/2) over 0 ... w, ended where the integrand has fallen to e^-40.
    """
    end = np.minimum(w, 80 / (a + np.sqrt(a * a + 80)))
    nodes, weights = quadrature()
    t = end[..., None] * nodes
    return end * (np.exp(-(a[..., None] + t / 2) * t) @ weights)


def truth(z, w):
    """log p and its slopes in z and w for z >= 0, sigma = 1, by quadrature instead of by any formula of Phi.

    Shapes     z, w (n,) float64 -> three arrays (n,)
    Domain     z >= 0, w > 0; the error is a few units of float64's last place, as all sums are of positive terms
    """
    low, high, drop = z - w / 2, z + w / 2, -np.expm1(-z * w)  # 1 - phi(high) / phi(low)
    ends = np.abs(low)
    log_phi = np.log(PHI_0) - 0.5 * ends * ends
    outside = low >= 0
    mass = scaled_mass(ends, np.where(outside, w, np.inf))
    nodes, weights = quadrature()
    # A bin that holds mu: the integral itself where it is short, one minus both tails where it is long.
    direct = w * (PHI_0 * np.exp(-0.5 * (low[..., None] + w[..., None] * nodes) ** 2) @ weights)
    infinite = np.full_like(w, np.inf)
    tails = np.exp(log_phi) * scaled_mass(ends, infinite) + PHI_0 * np.exp(
        -0.5 * high * high
    ) * scaled_mass(high, infinite)
    short = np.log(np.where(outside, 1, np.where(w < 2, direct, 1)))
    log_p = np.where(
        outside,
        log_phi + np.log(mass),
        np.where(w < 2, short, np.log1p(-np.where(outside, 0, tails))),
    )
    density = np.where(outside, 1 / mass, np.exp(log_phi - np.where(outside, 0, log_p)))
    return log_p, -density * drop, density * (1 - drop / 2)
