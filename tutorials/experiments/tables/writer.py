"""Means over seeds, and curves of PSNR over bytes with the factors between them.

A curve is a list of points (bytes, PSNR of test views in dB), chosen on held-back views. In a
comparison all its points count, in the order of their PSNR; between them, the logarithm of the
bytes is interpolated over PSNR.
"""

import numpy as np

from p4dgs_ref.lab.writer import group_rows


def means(rows, *keys):
    """The means over scenes and seeds of the rows that agree in the keys; one row for each.

    All seeds count alike. Fields that are not numbers, or that some row lacks, are left out.
    """
    result = []
    for values, group in group_rows(rows, *keys).items():
        seeds = sorted({row["seed"] for row in group})
        result.append({**dict(zip(keys, values)), "seeds": len(seeds)})
        for name in group[0]:
            is_numeric = all(isinstance(row.get(name), (int, float)) for row in group)
            if is_numeric and name not in (*keys, "seed"):
                each = [np.mean([row[name] for row in group if row["seed"] == s]) for s in seeds]
                result[-1][name] = np.mean(each)
    return result


def best(points):
    """Of points that are rows, those with a higher PSNR on held-back views than smaller files."""
    chosen = []
    for point in sorted(points, key=lambda point: point["bytes"]):
        if not chosen or point["held_back_db"] > chosen[-1]["held_back_db"]:
            chosen.append(point)
    return chosen


def factors(points, others):
    """The median factor from the bytes of `points` to those of `others`.

    They are taken at equal PSNR, at every point of the two curves that lies in the PSNRs from `low`
    to `high`, which both reach. Without any, the result is empty.
    """
    levels = [psnr for curve in (points, others) for _, psnr in curve]
    ratios = {psnr: bytes_at(others, psnr) / bytes_at(points, psnr) for psnr in levels}
    ratios = {psnr: ratio for psnr, ratio in ratios.items() if not np.isnan(ratio)}
    return ratios and {
        "low": min(ratios),
        "high": max(ratios),
        "points": len(ratios),
        "median": np.median([*ratios.values()]),
    }


def bytes_at(points, psnr):
    """The bytes at which a curve has a PSNR; NaN where it was not measured."""
    sizes, values = np.array(sorted(points, key=lambda point: point[1])).T
    return np.exp(np.interp(psnr, values, np.log(sizes), np.nan, np.nan))


def with_error(differences):
    """The mean of some differences with twice its standard error, as text."""
    mean, count = np.mean(differences), len(differences)
    if count == 1:
        return f"{mean:+.2f} ?"
    error = 2 * np.std(differences, ddof=1) / np.sqrt(count)
    text = f"{mean:+.2f} ±{error:.2f}"
    return text if abs(mean) > error else f"none ({text})"
