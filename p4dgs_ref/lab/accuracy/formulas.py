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


def as_printed(f_noisy, mu, sigma, q):
    """Return Eq. (11) as printed, in the precision of the inputs, with no more work than needed."""
    per_sigma = 1 / sigma
    middle, half = (f_noisy - mu) * per_sigma, 0.5 * q * per_sigma
    low, high = middle - half, middle + half
    at_low, at_high = np.exp(-0.5 * low * low), np.exp(-0.5 * high * high)  # phi / PHI_0
    with np.errstate(divide="ignore", invalid="ignore"):
        p = ndtr(high) - ndtr(low)
        per_unit = (-PHI_0 / math.log(2)) * per_sigma / p
        f_slope, q_slope = per_unit * (at_high - at_low), 0.5 * per_unit * (at_high + at_low)
        sigma_slope = per_unit * (low * at_low - high * at_high)
        return 0.0 - np.log2(p), (f_slope, sigma_slope, q_slope)  # not -0 where p is 1


def with_floor(least):
    """Return the printed formula with p >= least. On this floor the gradient is 0."""
    most = -math.log2(least)

    def formula(f_noisy, mu, sigma, q):
        bits, saved = as_printed(f_noisy, mu, sigma, q)
        above = bits <= most  # False for NaN as well
        return np.where(above, bits, most), tuple(np.where(above, slope, 0) for slope in saved)

    return formula


def phi(v):
    """Return the density of the standard Gaussian."""
    return PHI_0 * np.exp(-0.5 * v**2)


FORMULAS = {
    "as printed": as_printed,
    "p at least 1e-30": with_floor(1e-30),
    "HAC's floor": with_floor(1e-6),  # at most 19.93 bits
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
