"""Formulas for Eq. (11) that trade accuracy for time, and their true values.

Each takes and returns the same as `likelihood.forward`, so that `likelihood.backward` serves all of
them. A bin reaches from low to high, in sigmas from the mean: z - w/2 and z + w/2, with
z = (f_noisy - mu) / sigma and w = q / sigma.
"""

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
from scipy.special import ndtr, roots_legendre

from ...equations import likelihood

# Bits and slopes of points of the plane of bins, from 60-digit arithmetic.
# `python -m tests.workshop.likelihood_points` writes them in a checkout.
DIGITS = Path(__file__).with_name("sixty_digits.json")
PHI_0 = 1 / math.sqrt(2 * math.pi)  # density of the standard Gaussian at its mean
SMALLEST_BITS = 1e-6  # errors of fewer bits are relative to this
HAC_FLOOR = 1e-6  # of p, in HAC: at most 19.93 bits
TABLE_REACH = 8.0  # sigmas: beyond, the tables are constant
TABLE_FLOOR = 2.0**-24  # the smallest mass of a table, as in a coder with 24-bit frequencies


def formula_of(log_p_of, folded=True):
    """Return a formula in the form of `likelihood.forward`, from a function of a bin's two edges.

    The function takes low and high and returns log p and its slopes in z and w. `folded` mirrors a
    bin below the mean to the other side.
    """

    def formula(f_noisy, mu, sigma, q):
        low, high = (f_noisy - q / 2 - mu) / sigma, (f_noisy + q / 2 - mu) / sigma
        mirrored = (f_noisy < mu) & folded
        edges = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            log_p, slope_z, slope_w = log_p_of(*edges)
            slope_z = np.where(mirrored, -1, 1) * slope_z
            # sigma divides both z and w
            sigma_slope = -((f_noisy - mu) / sigma * slope_z + q / sigma * slope_w)
            per_unit = -1 / (math.log(2) * sigma)
            saved = [per_unit * slope for slope in (slope_z, sigma_slope, slope_w)]
            bits = log_p * (-1 / math.log(2)) + 0.0  # adding 0 turns -0 into 0
        bits, *saved = (a.astype(f_noisy.dtype, copy=False) for a in (bits, *saved))
        return bits, tuple(saved)

    return formula


def phi(v):
    """Return the density of the standard Gaussian."""
    return PHI_0 * np.exp(-0.5 * v**2)


def slopes(at_low, at_high):
    """Return the slopes of p in z and w, from the densities at the edges."""
    return at_high - at_low, 0.5 * (at_high + at_low)


def difference(low, high):
    """Return Eq. (11) as printed, in the precision of the inputs."""
    p = ndtr(high) - ndtr(low)
    return np.log(p), *(slope / p for slope in slopes(phi(low), phi(high)))


def with_floor(low, high):
    """Return the printed formula with HAC's floor under p.

    On the floor the gradient is 0.
    """
    log_p, *rest = difference(low, high)
    above = log_p >= math.log(HAC_FLOOR)  # False for NaN as well
    return np.where(above, log_p, math.log(HAC_FLOOR)), *(np.where(above, a, 0) for a in rest)


def tails(low, high):
    """Return the difference of both tails on the bin's side: no values near one cancel."""
    p = ndtr(-low) - ndtr(-high)
    return np.log(p), *(slope / p for slope in slopes(phi(low), phi(high)))


def lookup_table(entries):
    """Return the formula that interpolates Phi in a table of `entries` per sigma.

    It takes the density from the slope of the same table.
    """
    values = ndtr(np.arange(-TABLE_REACH * entries, TABLE_REACH * entries + 1) / entries)

    def read(edge):
        place = (np.clip(edge, -TABLE_REACH, TABLE_REACH) + TABLE_REACH) * entries
        i = np.minimum(place.astype(np.int64), len(values) - 2)
        rise = values[i + 1] - values[i]
        return values[i] + (place - i) * rise, rise * entries

    def interpolate(low, high):
        (at_low, phi_low), (at_high, phi_high) = read(-low), read(-high)
        p = np.maximum(at_low - at_high, TABLE_FLOOR)
        return np.log(p), *(slope / p for slope in slopes(phi_low, phi_high))

    return formula_of(interpolate)


literal, hac = formula_of(difference, folded=False), formula_of(with_floor, folded=False)
FORMULAS = {
    "as printed": literal,
    "HAC's floor": hac,
    "mirrored": formula_of(tails),
    "table, 256 per σ": lookup_table(256),
    "ours": likelihood.forward,
}


# --- the truth -----------------------------------------------------------------------------------
def truth(z, w):
    """Return log p and its slopes in z and w for vectors z and w > 0, in float64.

    Computed by quadrature of the density instead of a formula of Phi. All sums are of positive
    terms, so the error is a few units in the last place.
    """
    side, z = np.sign(z), np.abs(z)
    low, high = z - w / 2, z + w / 2
    distance, outside = np.abs(low), low >= 0
    log_phi = np.log(PHI_0) - 0.5 * distance * distance
    # Of a bin on one side of the mean the mass itself, of one around the mean the tail before it.
    mass = scaled_mass(distance, np.where(outside, w, np.inf))
    after = phi(high) * scaled_mass(high, np.full_like(w, np.inf))
    with np.errstate(invalid="ignore", divide="ignore"):
        # A bin around the mean: both of its sides if it is short, else one minus both tails.
        sides = PHI_0 * (scaled_mass(0 * z, distance) + scaled_mass(0 * z, high))
        inside = np.where(w < 2, np.log(sides), np.log1p(-(np.exp(log_phi) * mass + after)))
    log_p = np.where(outside, log_phi + np.log(mass), inside)
    ratio = np.where(outside, 1 / mass, np.exp(log_phi - log_p))
    drop = -np.expm1(-z * w)  # 1 - phi(high) / phi(low)
    return log_p, -side * ratio * drop, ratio * (1 - drop / 2)


def scaled_mass(a, w):
    """Return the mass from a to a + w, divided by the density at a, for a >= 0.

    It is the integral of exp(-a t - t^2/2) over 0 ... w, cut where the integrand is e^-40.
    """
    end = np.minimum(w, 80 / (a + np.sqrt(a * a + 80)))
    nodes, weights = quadrature()
    t = end[..., None] * nodes
    return end * (np.exp(-(a[..., None] + t / 2) * t) @ weights)


@cache
def quadrature(panels=8, points=20):
    """Return Gauss-Legendre nodes and weights on [0, 1].

    The interval is cut into panels because the weights of one long rule lose digits at its ends.
    """
    nodes, weights = roots_legendre(points)
    starts = np.arange(panels)[:, None] / panels
    return (starts + (nodes + 1) / (2 * panels)).ravel(), np.tile(weights / (2 * panels), panels)


def check_truth():
    """Return the largest relative distance of bits and slopes from 60-digit values."""
    z, w, *exact = np.array(json.loads(DIGITS.read_text(encoding="utf-8"))).T
    bits_error, slopes_error = relative_errors(in_bits(truth(z, w)), exact)
    return bits_error.max(), slopes_error.max()


# --- errors --------------------------------------------------------------------------------------
def inputs(z, w, dtype):
    """Return inputs of Eq. (11) with mu = 0 and sigma = 1, as one row."""
    z, w = (np.asarray(a, dtype).reshape(1, -1) for a in (z, w))
    return dict(f_noisy=z, mu=np.zeros_like(z), sigma=np.ones_like(z), q=w)


def errors(formula, z, w, dtype):
    """Return errors of bits, relative above SMALLEST_BITS, and of slopes, relative to the larger.

    z and w are vectors of numbers of float32, so that both precisions have one truth.
    """
    with np.errstate(all="ignore"):
        bits, (f_slope, _, q_slope) = formula(**inputs(z, w, dtype))
    numbers = np.concatenate([bits, f_slope, q_slope]).astype(float)
    return relative_errors(numbers, in_bits(truth(z, w)))


def in_bits(logarithms):
    """Return the negative of log p and of its slopes, in bits."""
    return [-a / math.log(2) for a in logarithms]


def relative_errors(numbers, exact):
    """Return the relative errors of bits and slopes against exact ones: of bits, and of slopes."""
    gap = np.abs(np.array(numbers) - exact)
    largest = np.abs(exact[1:]).max(axis=0)
    return gap[0] / np.maximum(exact[0], SMALLEST_BITS), relative_to(largest, gap[1:].max(axis=0))


def relative_to(largest, gap):
    """Return gap / largest.

    If both are 0 there is no error; if only `largest` is 0, it is 1.

    Gaps below the normal range of float64 count as zero, because they have fewer digits.
    """
    gap = np.where(gap < np.finfo(float).tiny, 0.0, gap)
    without_scale = np.where(gap == 0, 0.0, np.where(np.isfinite(gap), 1.0, gap))
    return np.divide(gap, largest, out=without_scale, where=largest > 0)
