"""Work-precision diagrams: error against time on logarithmic axes, a line a method, points along its knob; CSV beside."""

from typing import NamedTuple

import numpy as np

from ..report import BLUE, LIGHT_BLUE, RED, pyplot, save_figure, write_csv

# Okabe and Ito's palette, for colour-blind readers; markers differ too, so that grey prints can be read.
COLORS = (BLUE, RED, "#009E73", "#CC79A7", "#E69F00", LIGHT_BLUE, "#000000", "#8C6D31")
MARKERS = "osD^vPXph"
SIZE, DPI = (8, 5), 120


class Finding(NamedTuple):
    """What one study found; `report` writes it, the command line prints it."""

    name: str
    title: str
    reference: str  # what errors are measured against
    figures: list  # [(file, what it shows)]
    tables: list  # files
    reading: str  # sentences made of the measured numbers
    repeats: str  # how times were taken


class Axes(NamedTuple):
    """What a panel shows: columns of the rows, labels with units, scales."""

    x: str
    y: str
    x_label: str
    y_label: str
    x_scale: str = "log"
    y_scale: str = "log"


TIME = Axes("ms", "error", "time (ms, median of alternating repeats)", "error")


def lines(ax, rows, axes, by="method", knob="knob", label=True, order=()):
    """Draw the rows (dictionaries) of every method as one line with its points labelled by the knob.

    A value that a logarithmic axis cannot show stays out of the line: not finite as a red cross at the upper edge,
    zero at the lower edge, so that failures and exact results are seen too.  `order` fixes the methods' colours.
    """
    methods = list(dict.fromkeys([*order, *(row[by] for row in rows)]))
    finite = [
        row[axes.y]
        for row in rows
        if np.isfinite(row[axes.y]) and (row[axes.y] > 0 or axes.y_scale != "log")
    ]
    low, high = (min(finite), max(finite)) if finite else (1e-16, 1.0)
    for i, method in enumerate(methods):
        own = [row for row in rows if row[by] == method]
        if not own:
            continue
        shown = [
            row
            for row in own
            if np.isfinite(row[axes.y]) and (row[axes.y] > 0 or axes.y_scale != "log")
        ]
        color, marker = COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]
        style = (
            "-" if any(row.get(knob) != "" for row in own) else ""
        )  # without a knob there is nothing between points
        ax.plot(
            [row[axes.x] for row in shown],
            [row[axes.y] for row in shown],
            style,
            marker=marker,
            color=color,
            label=method,
            markersize=6 if len(shown) > 1 else 10,
            linewidth=1.6,
        )
        for row in own:
            failed = not np.isfinite(row[axes.y])
            if failed or row not in shown:
                ax.plot(
                    row[axes.x],
                    (3 * high if failed else low / 3),
                    "x" if failed else marker,
                    color="red" if failed else color,
                    markersize=9,
                    fillstyle="none",
                    clip_on=False,
                )
            elif label and row[knob] != "":
                ax.annotate(
                    f"{row[knob]}",
                    (row[axes.x], row[axes.y]),
                    textcoords="offset points",
                    xytext=(5, 4),
                    fontsize=9,
                    color=color,
                )
    ax.set(xscale=axes.x_scale, yscale=axes.y_scale, xlabel=axes.x_label, ylabel=axes.y_label)
    ax.grid(True, which="major", color="#dddddd", linewidth=0.7)
    ax.set_axisbelow(True)


def figure(panels=1, size=SIZE, **options):
    """A figure of some panels beside each other: (figure, [axes])."""
    fig, axes = pyplot().subplots(
        1, panels, figsize=size, squeeze=False, layout="constrained", **options
    )
    return fig, list(axes[0])


def legend(ax, **options):
    ax.legend(**{"fontsize": 10, "framealpha": 0.85, "edgecolor": "none", **options})


def readable_ticks(axis):
    """On a logarithmic axis of less than three decades, ticks at 1, 2, 5 in plain numbers; none without a number."""
    from matplotlib import ticker

    low, high = axis.get_view_interval()
    axis.set_minor_formatter(ticker.NullFormatter())
    if high < 1000 * low:
        narrow = high < 30 * low
        axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if narrow else (1,)))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))


def finish(fig, path, title):
    """Put the title, which names the reference, and write the PNG."""
    for ax in fig.axes:
        for axis, scale in ((ax.xaxis, ax.get_xscale()), (ax.yaxis, ax.get_yscale())):
            if scale == "log":
                readable_ticks(axis)
    fig.suptitle(title, fontsize=13)
    fig.set_dpi(DPI)
    save_figure(fig, path)


def work_precision(path, rows, axes=TIME, title="", **options):
    """The diagram of one panel: rows with method, knob and the two columns of `axes`."""
    fig, (ax,) = figure()
    lines(ax, rows, axes, **options)
    legend(ax)
    finish(fig, path, title)


def table(folder, name, rows):
    """Write rows as name.csv; every row has the columns of the first."""
    write_csv(
        folder / f"{name}.csv", [{key: tidy(value) for key, value in row.items()} for row in rows]
    )
    return f"{name}.csv"


def tidy(value):
    """A number as a CSV holds it: six digits are more than any measurement here has."""
    return f"{value:.6g}" if isinstance(value, (float, np.floating)) else value


def at(rows, **wanted):
    """The one row with these values."""
    found = [row for row in rows if all(row[key] == value for key, value in wanted.items())]
    if len(found) != 1:
        raise LookupError(f"{len(found)} rows with {wanted}")
    return found[0]


def number(value):
    """A number for a sentence: two or three digits, powers of ten where it is far from one."""
    if not np.isfinite(value):
        return "infinite" if np.isinf(value) else "not a number"
    return f"{value:.1e}" if value and not 1e-2 <= abs(value) < 1e4 else f"{value:.3g}"
