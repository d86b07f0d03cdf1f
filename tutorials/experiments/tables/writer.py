"""Curves of PSNR over bytes: their fronts, and differences of two of them.

A curve is a list of points (bytes, PSNR in dB). In a comparison only its front counts: the points
with a higher PSNR than all smaller files. Between them, the logarithm of the bytes is interpolated
over PSNR.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator

from p4dgs_ref.lab.writer import grouped, means

MIN_POINTS = 3  # of a curve
MIN_OVERLAP = 0.5  # of the shorter of two ranges of PSNR


def points_of(rows):
    """The means of the points over scenes and seeds, of trainings that are there on every scene."""
    scenes, there = {row["scene"] for row in rows}, {}
    keys = ("label", "iterations", "method", "storage")
    for row in rows:
        key = (row["seed"], *(row[name] for name in keys))
        there.setdefault(key, []).append(row)
    whole = [row for group in there.values() if len(group) == len(scenes) for row in group]
    return means(whole, *keys)


def of_every_seed(rows):
    """The rows of trainings that have every seed of their method.

    Beside means over seeds, the best of several single seeds would win by luck.
    """
    keys, seeds = ("method", "label", "iterations"), lambda group: {row["seed"] for row in group}
    every = {method: seeds(group) for (method,), group in grouped(rows, keys[0]).items()}
    there = grouped(rows, *keys)
    return [
        row for row in rows if seeds(there[tuple(row[key] for key in keys)]) == every[row["method"]]
    ]


def seeds_of(rows):
    """How many seeds there are, and what ± means."""
    return f"seeds: {len({row['seed'] for row in rows})}, ± half their range"


def front(points):
    """The points [n, 2] with a higher PSNR than all smaller files, by size."""
    points = np.array(sorted(map(tuple, points))).reshape(-1, 2)
    best = np.maximum.accumulate(points[:, 1])
    return points[np.diff(best, prepend=-np.inf) > 0]


def best(points):
    """Of points that are rows, those with a higher PSNR on held-back views than smaller files."""
    chosen = []
    for point in sorted(points, key=lambda point: point["bytes"]):
        if not chosen or point["held_back_db"] > chosen[-1]["held_back_db"]:
            chosen.append(point)
    return chosen


def bd_rate(points, others):
    """How many percent more bytes `points` need than `others` at equal PSNR, and None.

    The mean is over the logarithm of the ratio and over the PSNRs that both curves reach
    (Bjøntegaard). Where the curves cannot be compared, returns None and the reason.
    """
    fronts = [front(curve) for curve in (points, others)]
    counts = [len(curve) for curve in fronts]
    if min(counts) < MIN_POINTS:
        lengths = " and ".join(map(str, counts))
        return None, f"curves of {lengths} points; at least {MIN_POINTS} are needed"
    ends = [(curve[0, 1], curve[-1, 1]) for curve in fronts]
    low, high = max(start for start, _ in ends), min(end for _, end in ends)
    if high - low < MIN_OVERLAP * min(end - start for start, end in ends):
        ranges = " and ".join(f"{start:.2f} to {end:.2f} dB" for start, end in ends)
        return None, f"the curves hardly overlap: {ranges}"
    logs = [
        PchipInterpolator(curve[:, 1], np.log(curve[:, 0])).integrate(low, high) / (high - low)
        for curve in fronts
    ]
    return float(100 * np.expm1(logs[0] - logs[1])), None


def factors(points, others):
    """The least and the median factor from the bytes of `points` to those of `others`.

    They are taken at equal PSNR, at every point of the two fronts that lies in the PSNRs from `low`
    to `high`, which both reach. Without any, the result is empty.
    """
    levels = [float(psnr) for curve in (points, others) for _, psnr in front(curve)]
    ratios = {psnr: bytes_at(others, psnr) / bytes_at(points, psnr) for psnr in levels}
    ratios = {psnr: ratio for psnr, ratio in ratios.items() if not np.isnan(ratio)}
    return ratios and {
        "low": min(ratios),
        "high": max(ratios),
        "least": min(ratios.values()),
        "median": float(np.median([*ratios.values()])),
    }


def bytes_at(points, psnr):
    """The bytes at which a curve has a PSNR; NaN where it was not measured."""
    sizes, values = front(points).T
    return float(np.exp(np.interp(psnr, values, np.log(sizes), np.nan, np.nan)))
