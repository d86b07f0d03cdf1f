"""What studies make of rows: means over seeds, tables as text, differences of curves.

A curve is a list of points (bytes, PSNR in dB). In a comparison only its front counts: the points
with a higher PSNR than all smaller files. Between them, the logarithm of the bytes is interpolated
over PSNR.
"""

import csv

import numpy as np
from scipy.interpolate import PchipInterpolator

MIN_POINTS = 3  # of a curve
MIN_OVERLAP = 0.5  # of the shorter of two ranges of PSNR


def read_csv(path, texts=("sha256",)):
    """The rows of a CSV without empty fields; what is a number becomes one, except in `texts`."""
    with open(path, newline="", encoding="utf-8") as file:
        return [
            {name: text if name in texts else as_number(text) for name, text in row.items() if text}
            for row in csv.DictReader(file)
        ]


def as_number(text):
    """The number that a text stands for, otherwise the text itself."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def grouped(rows, *keys):
    """The rows that agree in some fields, {entries of these fields: rows}, in their order."""
    groups = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key) for key in keys), []).append(row)
    return groups


def means(rows, *keys):
    """The means over scenes and seeds of the rows that agree in the keys; one row for each.

    `name_spread` is half the range of the means of each seed. Fields that are no numbers, or that
    some row lacks, are left out.
    """
    result = []
    for values, group in grouped(rows, *keys).items():
        seeds = sorted({row["seed"] for row in group})
        result.append({**dict(zip(keys, values)), "seeds": len(seeds)})
        for name in group[0]:
            is_numeric = all(isinstance(row.get(name), (int, float)) for row in group)
            if is_numeric and name not in (*keys, "seed"):
                each = [np.mean([row[name] for row in group if row["seed"] == s]) for s in seeds]
                result[-1][name] = float(np.mean(each))
                result[-1][f"{name}_spread"] = float(np.ptp(each) / 2)
    return result


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


def text_table(columns, rows):
    """Lines of text, the first column to the left, the others to the right.

    `columns` is {heading: form}; a form is filled with the fields of a row. Fields that are None or
    missing give a dash.
    """
    return aligned([columns, *([filled(form, row) for form in columns.values()] for row in rows)])


def aligned(cells):
    """Rows of text as lines, the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*cells)]
    forms = [f"{'<' if i == 0 else '>'}{width}" for i, width in enumerate(widths)]
    return ["  ".join(map(format, line, forms)).rstrip() for line in cells]


def filled(form, row):
    """A form filled with a row, or a dash."""
    try:
        return form.format(**row)
    except (KeyError, TypeError):
        return "-"


def seeds_of(rows):
    """How many seeds there are, and what ± means."""
    return f"seeds: {len({row['seed'] for row in rows})}, ± half their range"


def twice_standard_error(differences):
    """Twice the standard error of the mean of some differences; infinite for fewer than two."""
    count = len(differences)
    return 2 * np.std(differences, ddof=1) / np.sqrt(count) if count > 1 else np.inf


# --- curves ---------------------------------------------------------------------------------------
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
