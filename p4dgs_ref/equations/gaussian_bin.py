"""Numerics of Eq. (11): the mass p of a Gaussian in one bin, and its slopes, in three ways.

Seen from mu, in units of sigma, the bin reaches from low = z - w/2 to high = z + w/2 with z = |x - mu| / sigma and
w = q / sigma.  `stable` takes differences of tails below mu, where they are small numbers with all their digits, and
leaves to others what they do better: `narrow_bin` where the two tails nearly agree, `far_bin` out in the tail.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import erfcx, ndtr

NARROW = (
    1 / 16
)  # of w max(1, z): above, a difference loses 4 bits at most; below, the series ends at 3e-16
FAR = 2.0  # of low: from here on the scaled tails have more digits than those of ndtr, 2 more at 8 sigma
HAC_FLOOR = 1e-6  # of p, in HAC: 19.93 bits at most
PIECE = 4096  # bins at a time, so that what is computed on the way stays in the cache: time only
PHI_0 = 1 / math.sqrt(2 * math.pi)  # density of the standard Gaussian at 0


class Bin(NamedTuple):
    """Log mass of a bin and its slopes; z is signed: (x - mu) / sigma."""

    log_p: np.ndarray
    z: np.ndarray
    w: np.ndarray
    slope_z: np.ndarray  # d log p / dz = (phi(upper edge) - phi(lower edge)) / p
    slope_w: np.ndarray  # d log p / dw = (phi(upper edge) + phi(lower edge)) / 2p


def stable(x, mu, sigma, q):
    """The bin of width q about x, all of one shape (A, n), computed in float64 whatever comes in, piece by piece.

    Bits are right to 1e-12 (or to what the inputs' own rounding leaves) for |x - mu| <= 1000 sigma and
    1e-12 <= q / sigma <= 1e6; slopes to 1e-12 of the larger density ratio.  Where p rounds to 1, bits fade to 0.
    """
    whole = np.empty((5, x.size))
    flat = [v.reshape(-1) for v in (x, mu, sigma, q)]
    for a in range(0, x.size, PIECE):
        whole[:, a : a + PIECE] = _stable(
            *(v[a : a + PIECE].astype(np.float64, copy=False) for v in flat)
        )
    return Bin(*whole.reshape(5, *x.shape))


def _stable(x, mu, sigma, q):
    """`stable` for vectors (n,) of float64."""
    offset, half = x - mu, 0.5 * q
    distance = np.abs(offset)  # the Gaussian is even
    # The edges are subtracted before the division: the one next to mu keeps its digits.
    low, high, z, w = (v / sigma for v in (distance - half, distance + half, distance, q))
    zw = z * w
    inside = low < 0  # the bin holds mu: one minus the tail on either side
    near, beyond = ndtr(-np.abs(low)), ndtr(-high)
    tails = near + beyond
    p = np.where(inside, 1 - tails, near - beyond)
    narrow = np.maximum(w, zw) < NARROW
    far = (low > FAR) & ~narrow
    with np.errstate(divide="ignore", invalid="ignore"):  # of bins that the next lines replace
        log_p = np.where(inside, np.log1p(-tails), np.log(p))
        ratio = PHI_0 * np.exp(-0.5 * low * low) / p  # phi(low) / p, the larger of the two
    for which, regime in ((narrow, narrow_bin), (far, far_bin)):
        if which.any():
            log_p[which], ratio[which] = regime(low[which], high[which], w[which], zw[which])
    drop = -np.expm1(-zw)  # 1 - phi(high) / phi(low): phi(low) - phi(high) without a difference
    return Bin(
        log_p, offset / sigma, w, np.copysign(ratio * drop, -offset), ratio * (1 - 0.5 * drop)
    )


def narrow_bin(low, high, w, zw):
    """log p and phi(low) / p by integrating the Taylor series of the density about the bin's centre."""
    y, v = zw * zw, w * w
    series = (
        1 + (y - v) / 24 + (y * y - 6 * y * v + 3 * v * v) / 1920
    )  # Hermite polynomials He_2, He_4, He_6 of z
    series += (y**3 - 15 * y * y * v + 45 * y * v * v - 15 * v**3) / 322560
    slope = v / 8 - zw / 2  # log phi(z) - log phi(low)
    log_g = np.log(w * series) + slope  # of p / phi(low)
    return math.log(PHI_0) - 0.5 * low * low + log_g, np.exp(-log_g)


def far_bin(low, high, w, zw):
    """log p and phi(low) / p with e^(-low^2/2) factored out of both tails: erfcx(v) = e^(v^2) erfc(v)."""
    root = math.sqrt(0.5)
    g = 0.5 * (erfcx(low * root) - np.exp(-zw) * erfcx(high * root))
    return np.log(g) - 0.5 * low * low, PHI_0 / g


def literal(x, mu, sigma, q):
    """The printed formula in the inputs' precision: infinite or not a number from 6 (float32) or 9 sigma on."""
    up, down = (x + q / 2 - mu) / sigma, (x - q / 2 - mu) / sigma
    p = ndtr(up) - ndtr(down)
    phi_up, phi_down = (PHI_0 * np.exp(-0.5 * edge * edge) for edge in (up, down))
    with np.errstate(divide="ignore", invalid="ignore"):
        return Bin(
            np.log(p),
            (x - mu) / sigma,
            q / sigma,
            (phi_up - phi_down) / p,
            0.5 * (phi_up + phi_down) / p,
        )


def hac(x, mu, sigma, q):
    """The printed formula under HAC's floor: at most 19.93 bits, and no gradient from there on."""
    b = literal(x, mu, sigma, q)
    alive = b.log_p >= math.log(HAC_FLOOR)  # False for NaN as well
    return b._replace(
        log_p=np.where(alive, b.log_p, math.log(HAC_FLOOR)).astype(b.z.dtype),
        slope_z=np.where(alive, b.slope_z, 0),
        slope_w=np.where(alive, b.slope_w, 0),
    )
