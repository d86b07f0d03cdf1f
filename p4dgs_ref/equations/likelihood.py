"""Eq. (11): the bits that a value costs under its predicted Gaussian.

    p    = Phi((f_noisy + q/2 - mu) / sigma) - Phi((f_noisy - q/2 - mu) / sigma)
    bits = -log2(p)

P-4DGS, section 3.3 (context entropy coding). `literal` is this formula. It is infinite from 9
sigma on (6 in float32), and a difference of two nearly equal numbers wherever the bin is narrow or
far from the mean. `forward` gives the same bits to 1e-12: it measures from the mean outwards,
where both tails are small numbers with all their digits, and computes log p in one of three ways:

    where is the bin            log p                                         function
    around or beside the mean   from the tails on either side                 `near_the_mean`
    far out, low > 2            the same with exp(-low**2 / 2) taken out      `far_from_the_mean`
    narrow, max(w, z w) < 1/16  log of the density's Taylor series            `narrow_bin`

Notation: z = |f_noisy - mu| / sigma, w = q / sigma; the bin reaches from low = z - w/2 to
high = z + w/2, in sigmas from the mean.
"""

import math

import numpy as np
from scipy.special import erfcx, ndtr

NARROW = 1 / 16  # of w max(1, z): above, a difference loses 4 bits; below, the series ends at 3e-16
FAR = 2.0  # of low: from here on scaled tails have more digits than those of ndtr
PIECE = 4096  # values at a time, so that intermediate results stay in the cache (time only)
PHI_0 = 1 / math.sqrt(2 * math.pi)  # density of the standard Gaussian at its mean


def forward(
    f_noisy,  # [A, n]  value to code (units of the attribute)
    mu,  # [A, n]  predicted mean
    sigma,  # [A, n]  predicted standard deviation, > 0
    q,  # [A, n]  quantisation step, > 0
):
    """Return the bits [A, n] of every value and what `backward` needs.

    Accurate for |f_noisy - mu| <= 1000 sigma and 1e-12 <= q / sigma <= 1e6; smooth everywhere,
    without a floor under p. Computed in float64, returned in the precision of f_noisy. Raises
    ValueError where sigma or q is not positive.
    """
    check_positive("sigma", sigma)
    check_positive("q", q)
    results = np.empty((4, f_noisy.size), f_noisy.dtype)
    inputs = [a.reshape(-1) for a in (f_noisy, mu, sigma, q)]
    for start in range(0, f_noisy.size, PIECE):
        piece = slice(start, start + PIECE)
        results[:, piece] = rate(*(a[piece] for a in inputs))
    bits, *slopes = results.reshape(4, *f_noisy.shape)
    return bits, tuple(slopes)


def backward(saved, bits_bar):
    """Gradients of f_noisy, mu, sigma and q."""
    f_slope, sigma_slope, q_slope = saved
    f_noisy_bar = bits_bar * f_slope
    return {
        "f_noisy": f_noisy_bar,
        "mu": -f_noisy_bar,  # only the difference f_noisy - mu matters
        "sigma": bits_bar * sigma_slope,
        "q": bits_bar * q_slope,
    }


def literal(f_noisy, mu, sigma, q):
    """Eq. (11) as printed, in the precision of the inputs."""
    above = ndtr((f_noisy + q / 2 - mu) / sigma)
    below = ndtr((f_noisy - q / 2 - mu) / sigma)
    return -np.log2(above - below)


def rate(f_noisy, mu, sigma, q):
    """Bits of vectors [n] and their slopes by f_noisy, sigma and q."""
    per_unit = -1 / (math.log(2) * sigma)  # from slopes of log p by z and w to bits per unit
    offset, half, sigma = (
        np.subtract(f_noisy, mu, dtype=float),
        0.5 * q.astype(float),
        sigma.astype(float),
    )
    # Subtract before dividing: the edge next to the mean keeps its digits.
    distance = np.abs(offset)
    low, high = (distance - half) / sigma, (distance + half) / sigma
    z, w = distance / sigma, q / sigma
    log_p, ratio = near_the_mean(low, high)  # ratio = phi(low) / p
    narrow = np.maximum(w, z * w) < NARROW
    far = (low > FAR) & ~narrow
    for regime, here in ((narrow_bin, narrow), (far_from_the_mean, far)):
        if here.any():
            log_p[here], ratio[here] = regime(low[here], high[here], z[here], w[here])
    # phi(low) - phi(high) = phi(low) * drop, without a difference
    drop = -np.expm1(-z * w)
    slope_z = np.copysign(ratio * drop, -offset)
    slope_w = ratio * (1 - 0.5 * drop)
    sigma_slope = -(offset / sigma * slope_z + w * slope_w)  # sigma divides both z and w
    bits = log_p * (-1 / math.log(2)) + 0.0  # adding 0 turns -0 into 0
    return bits, per_unit * slope_z, per_unit * sigma_slope, per_unit * slope_w


def near_the_mean(low, high):
    """p is one minus the tails on either side, or the nearer tail minus the one beyond."""
    inside = low < 0
    near, beyond = ndtr(-np.abs(low)), ndtr(-high)
    tails = near + beyond
    p = np.where(inside, 1 - tails, near - beyond)
    with np.errstate(divide="ignore", invalid="ignore"):  # bins that another regime computes
        log_p = np.where(inside, np.log1p(-tails), np.log(p))
        return log_p, PHI_0 * np.exp(-0.5 * low * low) / p


def far_from_the_mean(low, high, z, w):
    """The tails underflow; erfcx(v) = exp(v**2) erfc(v) does not: the common factor comes out."""
    root = math.sqrt(0.5)
    g = 0.5 * (erfcx(low * root) - np.exp(-z * w) * erfcx(high * root))
    return np.log(g) - 0.5 * low * low, PHI_0 / g


def narrow_bin(low, high, z, w):
    """The tails nearly agree: integrate the density's Taylor series about the bin's middle.

    The terms are the Hermite polynomials He_2, He_4 and He_6 of z times w**2, w**4 and w**6.
    """
    zw = z * w
    y, v = zw * zw, w * w
    series = 1 + (y - v) / 24 + (y * y - 6 * y * v + 3 * v * v) / 1920
    series += (y**3 - 15 * y * y * v + 45 * y * v * v - 15 * v**3) / 322560
    log_ratio = np.log(w * series) + (v / 8 - zw / 2)  # log(p / phi(low))
    return math.log(PHI_0) - 0.5 * low * low + log_ratio, np.exp(-log_ratio)


def check_positive(name, a):
    """Raise ValueError for the first entry that is not positive; NaN passes and gives NaN."""
    if a.min(initial=1) <= 0:
        index = np.argwhere(a <= 0)[0].tolist()
        raise ValueError(f"{name}{index} is {a[tuple(index)]}: expected a positive number")
