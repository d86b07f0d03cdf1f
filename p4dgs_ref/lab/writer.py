"""What studies make of rows: means over seeds, tables as text, curves."""

import numpy as np

from ..report.figures import pyplot, save_figure


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
    cells = [[*columns], *([filled(form, row) for form in columns.values()] for row in rows)]
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
