"""Curves of PSNR over bytes: their difference at equal quality (BD-rate), or why there is none.

A curve is a list of points (bytes, PSNR in dB). Only its front counts: the points with a higher
PSNR than all smaller files. Between them, the logarithm of the bytes is interpolated over PSNR.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator

FEWEST = 3  # points of a curve
LEAST_OVERLAP = 0.5  # of the shorter of two ranges of PSNR


def front(points):
    """The points with a higher PSNR than all smaller files, by size."""
    best, kept = -np.inf, []
    for size, psnr in sorted(points):
        if psnr > best:
            kept.append((size, psnr))
            best = psnr
    return kept


def bd_rate(points, others):
    """How many percent more bytes `points` need than `others` at equal PSNR, and None.

    The mean is over the logarithm of the ratio and over the PSNRs that both curves reach
    (Bjøntegaard). Where the curves cannot be compared, returns None and the reason.
    """
    fronts = [np.array(front(curve)) for curve in (points, others)]
    counts = [len(curve) for curve in fronts]
    if min(counts) < FEWEST:
        return None, f"curves of {counts[0]} and {counts[1]} points; at least {FEWEST} are needed"
    ends = [(curve[0, 1], curve[-1, 1]) for curve in fronts]
    low, high = max(start for start, _ in ends), min(end for _, end in ends)
    shorter = min(end - start for start, end in ends)
    if high - low < LEAST_OVERLAP * shorter:
        ranges = " and ".join(f"{start:.2f} to {end:.2f} dB" for start, end in ends)
        return None, f"the curves hardly overlap: {ranges}"
    logs = [
        PchipInterpolator(curve[:, 1], np.log(curve[:, 0])).integrate(low, high) / (high - low)
        for curve in fronts
    ]
    return float(100 * np.expm1(logs[0] - logs[1])), None


def bytes_at(points, psnr):
    """The bytes at which a curve has a PSNR, and None; or None and the reason."""
    kept = front(points)
    lowest, highest = kept[0][1], kept[-1][1]
    if not lowest <= psnr <= highest:
        return None, f"measured from {lowest:.2f} to {highest:.2f} dB"
    sizes, values = zip(*kept)
    return float(np.exp(np.interp(psnr, values, np.log(sizes)))), None
