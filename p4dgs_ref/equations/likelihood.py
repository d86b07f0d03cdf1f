"""Eq. (11): the bits that a value costs under its predicted Gaussian.

    p    = Phi((f_noisy + q/2 - mu) / sigma) - Phi((f_noisy - q/2 - mu) / sigma)
    bits = -log2(p)

P-4DGS, section 3.3 (context entropy coding). `literal` is this formula. For a bin one sigma wide it
is infinite from 9 sigma above the mean on (6 in float32), because both Phi round to 1. It loses
digits wherever the bin is narrow or far from the mean, because it subtracts two nearly equal
numbers. `forward` returns the true bits to 1e-12: it measures from the mean outwards, where both
tails are small numbers with all their digits, and computes log p in one of four ways:

    where is the bin            log p                                         function
    around the mean             log(1 - left tail - right tail)               `around_the_mean`
    beside it                   log(near tail - tail beyond)                  `beside_the_mean`
    far out, low > 2            the same with exp(-low**2 / 2) taken out      `far_from_the_mean`
    narrow, max(w, z w) < 1/16  log of the density's Taylor series            `narrow_bin`

Notation: z = |f_noisy - mu| / sigma, w = q / sigma; the bin reaches from low = z - w/2 to
high = z + w/2, in sigmas from the mean.
"""

import numpy as np
from scipy.special import erfcx, ndtr

NARROW = 1 / 16  # of max(w, z w): a difference loses 4 bits at most, the series ends at 3e-16
FAR = 2.0  # of low: from here on, scaled tails have more digits than ndtr
PIECE = 2**14  # values at a time, so that intermediate results stay in the cache (time only)
PHI_0 = 1 / np.sqrt(2 * np.pi)  # density of the standard Gaussian at its mean
TO_BITS = -1 / np.log(2)  # from log p to bits


def literal(f_noisy, mu, sigma, q):
    """Return Eq. (11) as printed, in the precision of the inputs."""
    above = ndtr((f_noisy + q / 2 - mu) / sigma)
    below = ndtr((f_noisy - q / 2 - mu) / sigma)
    return -np.log2(above - below)


def forward(
    f_noisy,  # [A, n]  value to code (units of the attribute)
    mu,  # [A, n]  predicted mean
    sigma,  # [A, n]  predicted standard deviation, > 0
    q,  # [A, n]  quantisation step, > 0
):
    """Return the bits [A, n] of every value and what `backward` needs.

    Accurate for |f_noisy - mu| <= 1000 sigma and 1e-12 <= q / sigma <= 1e6; smooth everywhere,
    without a floor under p. Computed in float64, returned in the precision of f_noisy. Raises
    ValueError if f_noisy is not floating-point, or if sigma, q or q / sigma is so small or so large
    that slopes overflow.
    """
    check_ranges(sigma, q, f_noisy.dtype)
    results = np.empty((4, f_noisy.size), f_noisy.dtype)
    inputs = [a.reshape(-1) for a in (f_noisy, mu, sigma, q)]
    for start in range(0, f_noisy.size, PIECE):
        piece = slice(start, start + PIECE)
        results[:, piece] = bits_and_slopes(*(a[piece] for a in inputs))
    bits, *slopes = results.reshape(4, *f_noisy.shape)
    return bits, tuple(slopes)


def backward(saved, bits_bar):
    """Return the gradients of f_noisy, mu, sigma and q."""
    f_slope, sigma_slope, q_slope = saved
    f_noisy_bar = bits_bar * f_slope
    return {
        "f_noisy": f_noisy_bar,
        "mu": -f_noisy_bar,  # only the difference f_noisy - mu matters
        "sigma": bits_bar * sigma_slope,
        "q": bits_bar * q_slope,
    }


def bits_and_slopes(f_noisy, mu, sigma, q):
    """Return the bits of vectors [n] and their slopes by f_noisy, sigma and q, in float64."""
    f_noisy, mu, sigma, q = (a.astype(np.float64, copy=False) for a in (f_noisy, mu, sigma, q))
    offset = f_noisy - mu
    distance = np.abs(offset)
    z, w = distance / sigma, q / sigma
    # Subtract before dividing: the edge next to the mean keeps its digits.
    low, high = (distance - q / 2) / sigma, (distance + q / 2) / sigma

    log_p, ratio = np.empty_like(z), np.empty_like(z)  # ratio = phi(low) / p
    narrow = np.maximum(w, z * w) < NARROW
    around = (low < 0) & ~narrow
    far = (low > FAR) & ~narrow
    for regime, where in (
        (narrow_bin, narrow),
        (around_the_mean, around),
        (beside_the_mean, ~(narrow | around | far)),
        (far_from_the_mean, far),
    ):
        rows = np.flatnonzero(where)  # indexing by rows is faster than by a mask
        if len(rows):
            log_p[rows], ratio[rows] = regime(low[rows], high[rows], z[rows], w[rows])

    return TO_BITS * log_p, *slopes(offset, sigma, low, high, z, w, ratio)


def slopes(offset, sigma, low, high, z, w, ratio):
    """Return the slopes of the bits by f_noisy, sigma and q; ratio is phi(low) / p."""
    # phi(low) - phi(high) = phi(low) * drop, without a difference
    drop = -np.expm1(-z * w)
    slope_z = -np.sign(offset) * ratio * drop  # d log p / dz, with the sign of the offset
    slope_w = ratio * (1 - drop / 2)  # d log p / dw
    sigma_slope = -(offset / sigma * slope_z + w * slope_w)  # sigma divides both z and w
    # It is also (low phi(low) - high phi(high)) / p, which keeps its digits in a wide bin with one
    # edge near the mean, where the sum above subtracts w from w.
    wide = np.flatnonzero(drop > 0.5)
    edges = low[wide] - high[wide] * np.exp(-z[wide] * w[wide])
    sigma_slope[wide] = ratio[wide] * edges
    per_unit = TO_BITS / sigma
    return per_unit * slope_z, per_unit * sigma_slope, per_unit * slope_w


def around_the_mean(low, high, z, w):
    """Return log p and phi(low) / p of a bin around the mean: p is one minus both tails."""
    tails = ndtr(low) + ndtr(-high)
    return np.log1p(-tails), phi(low) / (1 - tails)


def beside_the_mean(low, high, z, w):
    """Return the same for a bin on one side: p is the nearer tail minus the one beyond."""
    p = ndtr(-low) - ndtr(-high)
    return np.log(p), phi(low) / p


def far_from_the_mean(low, high, z, w):
    """Return the same for tails that underflow: p = exp(-low**2 / 2) * g.

    erfcx(v) = exp(v**2) erfc(v) does not underflow.
    """
    g = 0.5 * (erfcx(low / np.sqrt(2)) - np.exp(-z * w) * erfcx(high / np.sqrt(2)))
    return np.log(g) - 0.5 * low**2, PHI_0 / g


def narrow_bin(low, high, z, w):
    """Return the same for tails that nearly agree: integrate the density about the bin's middle.

    The terms are the Hermite polynomials He_2, He_4 and He_6 of z times w**2, w**4 and w**6.
    """
    y, v = (z * w) ** 2, w**2
    series = 1 + (y - v) / 24 + (y * y - 6 * y * v + 3 * v * v) / 1920
    series += (y * y * y - 15 * y * y * v + 45 * y * v * v - 15 * v * v * v) / 322560
    log_ratio = np.log(w * series) + v / 8 - z * w / 2  # log(p / phi(low))
    return np.log(PHI_0) - 0.5 * low**2 + log_ratio, np.exp(-log_ratio)


def phi(v):
    """Return the density of the standard Gaussian."""
    return PHI_0 * np.exp(-0.5 * v**2)


@np.errstate(all="ignore")
def check_ranges(sigma, q, dtype):
    """Raise ValueError unless dtype is floating-point and no slope overflows in it; NaN passes."""
    if not np.issubdtype(dtype, np.floating):
        raise ValueError(f"f_noisy: expected floats, got {dtype}")
    least = np.finfo(dtype).tiny
    ratio = np.divide(q, sigma, dtype=np.float64)
    for name, a in (("sigma", sigma), ("q", q), ("q / sigma", ratio)):
        if a.min(initial=1) < least or a.max(initial=1) > 1 / least:
            index = tuple(np.argwhere((a < least) | (a > 1 / least))[0].tolist())
            place = f"{name}{list(index)} is {a[index]:.3g}"
            raise ValueError(f"{place}: expected {least:.3g} to {1 / least:.3g}")
