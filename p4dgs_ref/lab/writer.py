"""What studies make of rows: means over seeds, tables as text, curves and their differences.

A curve is a list of points (bytes, PSNR in dB). In a comparison only its front counts: the points
with a higher PSNR than all smaller files. Between them, the logarithm of the bytes is interpolated
over PSNR.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator

from ..report.figures import pyplot, save_figure

FEWEST = 3  # points of a curve
LEAST_OVERLAP = 0.5  # of the shorter of two ranges of PSNR


def means(rows, *keys):
    """The means over scenes and seeds of the rows that agree in the keys; one row for each.

    `name_spread` is half the range of the means of each seed. Fields that are no numbers, or that
    some row lacks, are left out.
    """
    groups = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key) for key in keys), []).append(row)
    return [{**dict(zip(keys, values)), **mean(own, keys)} for values, own in groups.items()]


def mean(rows, left_out=()):
    """The means of some rows, their spreads, and the number of seeds."""
    seeds = sorted({row["seed"] for row in rows})
    found = {}
    for name in rows[0]:
        numbers = all(isinstance(row.get(name), (int, float)) for row in rows)
        if numbers and name not in (*left_out, "seed"):
            by_seed = [np.mean([row[name] for row in rows if row["seed"] == s]) for s in seeds]
            found[name] = float(np.mean(by_seed))
            found[f"{name}_spread"] = float(np.ptp(by_seed) / 2)
    return {"seeds": len(seeds), **found}


def table(columns, rows):
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
    count = len({row["seed"] for row in rows})
    return f"{count} seed{'s' * (count > 1)}, ± half their range"


def points_of(rows):
    """Bytes and PSNR of some rows."""
    return [(row["bytes"], row["psnr_db"]) for row in rows]


# --- curves ---------------------------------------------------------------------------------------
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


def draw_curves(path, title, curves, notes=()):
    """PSNR over bytes. A curve is (label, points, style); a note is (text, point)."""
    figure, ax = pyplot().subplots(figsize=(8.5, 5.5), layout="constrained")
    for label, points, style in curves:
        ax.plot(*zip(*points), label=label, **style)
    for text, point in notes:
        ax.annotate(f" {text}", point, fontsize=9, va="top")
    ax.set(xscale="log", xlabel="bytes", ylabel="PSNR of the test views (dB)", title=title)
    ax.legend(frameon=False)
    save_figure(figure, path)
