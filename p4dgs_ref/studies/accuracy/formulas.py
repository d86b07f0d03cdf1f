"""Other formulas for Eq. (11), which trade accuracy for time, and the true values.

Each takes and returns what `likelihood.forward` does, so that `likelihood.backward` serves all of
them. Their log masses are functions of x, mu, sigma and q of one shape that return a `Bin`; with z
= |x - mu| / sigma and w = q / sigma a bin reaches from low = z - w/2 to high = z + w/2.
"""

import math
from functools import cache, wraps
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, ndtr, roots_legendre

from ...equations import likelihood
from ...equations.likelihood import PHI_0

HAC_FLOOR = 1e-6  # of p, in HAC: 19.93 bits at most
TABLE_REACH = 8.0  # sigmas: beyond, the tables are constant
TABLE_FLOOR = 2.0**-24  # the least mass a table gives, as a coder with 24-bit frequencies has


class Bin(NamedTuple):
    """Log mass of a bin and its slopes; z is signed: (x - mu) / sigma."""

    log_p: np.ndarray
    z: np.ndarray
    w: np.ndarray
    slope_z: np.ndarray  # d log p / dz
    slope_w: np.ndarray  # d log p / dw


def priced(log_mass):
    """The function like `likelihood.forward` that takes its log mass from `log_mass`."""

    @wraps(log_mass)
    def forward(f_noisy, mu, sigma, q):
        b = log_mass(f_noisy, mu, sigma, q)
        per_unit = -1 / (math.log(2) * sigma)
        with np.errstate(invalid="ignore"):  # infinite slopes of infinite bits
            slopes = (b.slope_z, -(b.z * b.slope_z + b.w * b.slope_w), b.slope_w)
            saved = tuple((per_unit * s).astype(f_noisy.dtype, copy=False) for s in slopes)
        bits = b.log_p * (-1 / math.log(2)) + 0.0  # adding 0 turns -0 into 0
        return bits.astype(f_noisy.dtype, copy=False), saved

    return forward


def printed(x, mu, sigma, q):
    """The printed formula as a `Bin`, in the precision of the inputs."""
    up, down = (x + q / 2 - mu) / sigma, (x - q / 2 - mu) / sigma
    p = ndtr(up) - ndtr(down)
    phi_up, phi_down = (PHI_0 * np.exp(-0.5 * edge * edge) for edge in (up, down))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_z, slope_w = (phi_up - phi_down) / p, 0.5 * (phi_up + phi_down) / p
        return Bin(np.log(p), (x - mu) / sigma, q / sigma, slope_z, slope_w)


literal = priced(printed)


@priced
def hac(x, mu, sigma, q):
    """The printed formula under HAC's floor: at most 19.93 bits, and no gradient from there on."""
    b = printed(x, mu, sigma, q)
    alive = b.log_p >= math.log(HAC_FLOOR)  # False for NaN as well
    return b._replace(
        log_p=np.where(alive, b.log_p, math.log(HAC_FLOOR)).astype(b.z.dtype),
        slope_z=np.where(alive, b.slope_z, 0),
        slope_w=np.where(alive, b.slope_w, 0),
    )


def edges(x, mu, sigma, q):
    """z with its sign, w, and the bin's two edges seen from mu in sigmas, the nearer one first."""
    z, w = (x - mu) / sigma, q / sigma
    distance = np.abs(z)
    return z, w, distance - w / 2, distance + w / 2


def slopes(z, phi_low, phi_high):
    """The slopes of log p in z and in w from the densities at the edges, each divided by p."""
    return np.where(z < 0, -1, 1).astype(z.dtype) * (phi_high - phi_low), 0.5 * (phi_high + phi_low)


@priced
def symmetric(x, mu, sigma, q):
    """The difference of the two tails on the bin's own side of mu: no cancellation of values near one."""
    z, w, low, high = edges(x, mu, sigma, q)
    p = ndtr(-low) - ndtr(-high)
    with np.errstate(divide="ignore", invalid="ignore"):
        densities = (PHI_0 * np.exp(-0.5 * edge * edge) / p for edge in (low, high))
        return Bin(np.log(p), z, w, *slopes(z, *densities))


@priced
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

    return priced(log_mass)


FORMULAS = {
    "literal": literal,
    "HAC, floor 1e-6": hac,
    "tail-symmetric": symmetric,
    "log domain": log_domain,
    "table, 256 a sigma": table(256),
    "stable": likelihood.forward,
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

    Shapes     z, w (n,) float64 -> three arrays (n,) Domain     z >= 0, w > 0; the error is a few
    units of float64's last place, as all sums are of positive terms
    """
    low, high, drop = z - w / 2, z + w / 2, -np.expm1(-z * w)  # 1 - phi(high) / phi(low)
    ends = np.abs(low)
    log_phi = np.log(PHI_0) - 0.5 * ends * ends
    outside = low >= 0
    mass = scaled_mass(ends, np.where(outside, w, np.inf))
    nodes, weights = quadrature()
    # A bin that holds mu: the integral itself where it is short, one minus both tails where it is
    # long.
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
