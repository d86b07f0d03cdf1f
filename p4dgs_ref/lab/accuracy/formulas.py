"""Formulas for Eq. (11) that trade accuracy for time, and their true values.

Each takes and returns the same as `likelihood.forward`, so that `likelihood.backward` serves all of
them. With z = |f_noisy - mu| / sigma and w = q / sigma, a bin reaches from low = z - w/2 to
high = z + w/2, in sigmas from the mean.
"""

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
from scipy.special import log_ndtr, ndtr, roots_legendre

from ...equations import likelihood
from ...equations.likelihood import PHI_0

# Bits and slopes of points of the plane of bins, from 60-digit arithmetic.
# `python -m tests.golden.likelihood_points` writes them in a checkout.
DIGITS = Path(__file__).with_name("sixty_digits.json")
LEAST_BITS = 1e-6  # errors of fewer bits are relative to this
HAC_FLOOR = 1e-6  # of p, in HAC: at most 19.93 bits
TABLE_REACH = 8.0  # sigmas: beyond, the tables are constant
TABLE_FLOOR = 2.0**-24  # the smallest mass of a table, as in a coder with 24-bit frequencies


def literal(f_noisy, mu, sigma, q):
    """Eq. (11) as printed, in the precision of the inputs."""
    return in_bits(f_noisy, mu, sigma, q, *_literal(f_noisy, mu, sigma, q))


def _literal(x, mu, sigma, q):
    """log p and its slopes in z and w."""
    up, down = (x + q / 2 - mu) / sigma, (x - q / 2 - mu) / sigma
    p = ndtr(up) - ndtr(down)
    phi_up, phi_down = density(up), density(down)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(p), (phi_up - phi_down) / p, 0.5 * (phi_up + phi_down) / p


def hac(f_noisy, mu, sigma, q):
    """The printed formula with HAC's floor under p. On the floor the gradient is 0."""
    log_p, slope_z, slope_w = _literal(f_noisy, mu, sigma, q)
    floor = math.log(HAC_FLOOR)
    above = log_p >= floor  # False for NaN as well
    log_p = np.where(above, log_p, floor).astype(log_p.dtype)
    kept = np.where(above, slope_z, 0), np.where(above, slope_w, 0)
    return in_bits(f_noisy, mu, sigma, q, log_p, *kept)


def symmetric(f_noisy, mu, sigma, q):
    """The difference of the two tails on the bin's side of the mean: no values near one cancel."""
    low, high = edges(f_noisy, mu, sigma, q)
    p = ndtr(-low) - ndtr(-high)
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = slopes_of(f_noisy - mu, density(low) / p, density(high) / p)
        return in_bits(f_noisy, mu, sigma, q, np.log(p), *slopes)


def log_domain(f_noisy, mu, sigma, q):
    """log(a - b) = log a + log(1 - b/a) of the two tails' logarithms: nothing underflows."""
    low, high = edges(f_noisy, mu, sigma, q)
    near, beyond = log_ndtr(-low), log_ndtr(-high)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        log_p = near + np.log(-np.expm1(beyond - near))
        ratios = (PHI_0 * np.exp(-0.5 * edge * edge - log_p) for edge in (low, high))
        return in_bits(f_noisy, mu, sigma, q, log_p, *slopes_of(f_noisy - mu, *ratios))


def table(entries):
    """The formula that reads Phi from a table of `entries` per sigma, interpolating linearly.

    It takes the density from the slope of the same table.
    """

    def formula(f_noisy, mu, sigma, q):
        low, high = edges(f_noisy, mu, sigma, q)
        number = low.dtype.type
        values = normal_table(entries, low.dtype)

        def read(edge):
            place = np.clip(edge, -TABLE_REACH, TABLE_REACH) + number(TABLE_REACH)
            place = place * number(entries)
            i = np.minimum(place.astype(np.int64), len(values) - 2)
            rise = values[i + 1] - values[i]
            return values[i] + (place - i).astype(low.dtype) * rise, rise * number(entries)

        (at_low, phi_low), (at_high, phi_high) = read(-low), read(-high)
        p = np.maximum(at_low - at_high, number(TABLE_FLOOR))
        ratios = phi_low / p, phi_high / p
        return in_bits(f_noisy, mu, sigma, q, np.log(p), *slopes_of(f_noisy - mu, *ratios))

    return formula


@cache
def normal_table(entries, dtype):
    """Phi at `entries` equal steps per sigma from -TABLE_REACH to TABLE_REACH."""
    steps = np.arange(-TABLE_REACH * entries, TABLE_REACH * entries + 1)
    return ndtr(steps / entries).astype(dtype)


FORMULAS = {
    "literal": literal,
    "HAC, floor 1e-6": hac,
    "tail-symmetric": symmetric,
    "log domain": log_domain,
    "table, 256 per sigma": table(256),
    "stable": likelihood.forward,
}
TABLES = (16, 64, 256, 1024, 4096)


# --- the parts that formulas share ---------------------------------------------------------------
def edges(x, mu, sigma, q):
    """The two edges of the bin in sigmas from the mean, the nearer one first."""
    distance, w = np.abs((x - mu) / sigma), q / sigma
    return distance - w / 2, distance + w / 2


def density(v):
    """Density of the standard Gaussian."""
    return PHI_0 * np.exp(-0.5 * v * v)


def slopes_of(offset, low_ratio, high_ratio):
    """The slopes of log p in z and in w, from the densities at the edges divided by p."""
    sign = np.where(offset < 0, -1, 1).astype(offset.dtype)
    return sign * (high_ratio - low_ratio), 0.5 * (high_ratio + low_ratio)


def in_bits(x, mu, sigma, q, log_p, slope_z, slope_w):
    """From log p and its slopes in z and w to bits, and their slopes in x, sigma and q."""
    z, w = (x - mu) / sigma, q / sigma
    per_unit = -1 / (math.log(2) * sigma)
    with np.errstate(invalid="ignore"):  # inf - inf where the bits are infinite
        sigma_slope = -(z * slope_z + w * slope_w)  # sigma divides both z and w
    bits = log_p * (-1 / math.log(2)) + 0.0  # adding 0 turns -0 into 0
    slopes = per_unit * slope_z, per_unit * sigma_slope, per_unit * slope_w
    saved = tuple(slope.astype(x.dtype, copy=False) for slope in slopes)
    return bits.astype(x.dtype, copy=False), saved


# --- the truth -----------------------------------------------------------------------------------
def truth(z, w):
    """log p and its slopes in z and w for vectors z >= 0 and w > 0, in float64.

    Computed by quadrature of the density instead of a formula of Phi. All sums are of positive
    terms, so the error is a few units in the last place.
    """
    low, high = z - w / 2, z + w / 2
    drop = -np.expm1(-z * w)  # 1 - phi(high) / phi(low)
    distance = np.abs(low)
    log_phi = np.log(PHI_0) - 0.5 * distance * distance
    outside = low >= 0
    mass = scaled_mass(distance, np.where(outside, w, np.inf))
    # A bin around the mean: the integral itself if the bin is short, else one minus both tails.
    short = ~outside & (w < 2)
    nodes, weights = quadrature()
    points = low[..., None] + w[..., None] * nodes
    direct = w * (PHI_0 * np.exp(-0.5 * points**2) @ weights)
    infinite = np.full_like(w, np.inf)
    right_tail = PHI_0 * np.exp(-0.5 * high * high) * scaled_mass(high, infinite)
    tails = np.exp(log_phi) * scaled_mass(distance, infinite) + right_tail
    inside = np.where(
        short, np.log(np.where(short, direct, 1)), np.log1p(-np.where(outside, 0, tails))
    )
    log_p = np.where(outside, log_phi + np.log(mass), inside)
    ratio = np.where(outside, 1 / mass, np.exp(log_phi - np.where(outside, 0, log_p)))
    return log_p, -ratio * drop, ratio * (1 - drop / 2)


def scaled_mass(a, w):
    """The mass from a to a + w, divided by the density at a, for a >= 0.

    It is the integral of exp(-a t - t^2/2) over 0 ... w, cut where the integrand is e^-40.
    """
    end = np.minimum(w, 80 / (a + np.sqrt(a * a + 80)))
    nodes, weights = quadrature()
    t = end[..., None] * nodes
    return end * (np.exp(-(a[..., None] + t / 2) * t) @ weights)


@cache
def quadrature(panels=8, points=20):
    """Gauss-Legendre nodes and weights on [0, 1].

    The interval is cut into panels because the weights of one long rule lose digits at its ends.
    """
    nodes, weights = roots_legendre(points)
    starts = np.arange(panels)[:, None] / panels
    return (starts + (nodes + 1) / (2 * panels)).ravel(), np.tile(weights / (2 * panels), panels)


def check_truth():
    """The largest relative distance of the quadrature from 60-digit values: of bits, of slopes."""
    points = json.loads(DIGITS.read_text(encoding="utf-8"))
    z, w, bits, *slopes = np.array(points).T
    found_bits, *found_slopes = (-a / math.log(2) for a in truth(z, w))
    bits_error = np.abs(found_bits - bits) / np.maximum(bits, LEAST_BITS)
    gap = np.abs(np.array(found_slopes) - slopes).max(axis=0)
    return bits_error.max(), relative_to(np.abs(slopes).max(axis=0), gap).max()


# --- errors --------------------------------------------------------------------------------------
def inputs(z, w, dtype):
    """Inputs of Eq. (11) with mu = 0 and sigma = 1, as one row."""
    z, w = (np.asarray(a, dtype).reshape(1, -1) for a in (z, w))
    return dict(f_noisy=z, mu=np.zeros_like(z), sigma=np.ones_like(z), q=w)


def errors(formula, z, w, dtype):
    """Errors of the bits, relative above LEAST_BITS, and of the slopes, relative to the larger one.

    z and w are vectors of numbers that float32 can hold, so that both precisions have one truth.
    """
    with np.errstate(all="ignore"):
        bits, (f_slope, _, q_slope) = formula(**inputs(z, w, dtype))
    true_bits, *true_slopes = (-a / math.log(2) for a in truth(z, w))
    bits_error = np.abs(bits[0].astype(float) - true_bits) / np.maximum(true_bits, LEAST_BITS)
    slopes = np.concatenate([f_slope, q_slope]).astype(float)
    gap = np.abs(slopes - true_slopes).max(axis=0)
    return bits_error, relative_to(np.abs(true_slopes).max(axis=0), gap)


def relative_to(largest, gap):
    """gap / largest; where both are 0 there is no error, where only `largest` is 0 it is 1.

    Gaps that float64 holds with fewer digits than others are none.
    """
    gap = np.where(gap < np.finfo(float).tiny, 0.0, gap)
    without_scale = np.where(gap == 0, 0.0, np.where(np.isfinite(gap), 1.0, gap))
    return np.divide(gap, largest, out=without_scale, where=largest > 0)
