"""Diagrams of error against time on logarithmic axes: one line per method, points along its knob.

Every diagram has a CSV with its numbers.
"""

from typing import NamedTuple

import numpy as np

from ..report import BLUE, LIGHT_BLUE, RED, pyplot, save_figure, write_csv

# Okabe and Ito's palette, for colour-blind readers. The markers differ as well, for grey prints.
COLORS = (BLUE, RED, "#009E73", "#CC79A7", "#E69F00", LIGHT_BLUE, "#000000", "#8C6D31")
MARKERS = "osD^vPXph"
SIZE, DPI = (8, 5), 120


class Finding(NamedTuple):
    """The result of one study. `report` writes it, the command line prints it."""

    name: str
    title: str
    reference: str  # what errors are measured against
    figures: list  # [(file, caption)]
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


def lines(ax, rows, axes, label=True, order=(), **changes):
    """Draw one line per method through its rows (dictionaries), with the knob beside each point.

    A value that the axis cannot show stays out of the line: NaN and infinity are a red cross above
    the panel's values, an error of zero is an empty marker below them. `order` fixes the colours,
    `changes` replace properties of the lines.
    """
    values = [row[axes.y] for row in rows if can_be_drawn(row[axes.y], axes.y_scale)]
    low, high = (min(values), max(values)) if values else (1e-16, 1.0)
    methods = list(dict.fromkeys([*order, *(row["method"] for row in rows)]))
    for i, method in enumerate(methods):
        own = select(rows, method=method)
        if not own:
            continue
        shown = [row for row in own if can_be_drawn(row[axes.y], axes.y_scale)]
        style = dict(color=COLORS[i % len(COLORS)], marker=MARKERS[i % len(MARKERS)])
        (line,) = ax.plot(
            [row[axes.x] for row in shown],
            [row[axes.y] for row in shown],
            # Without a knob nothing lies between the points.
            "-" if any(row.get("knob") != "" for row in own) else "",
            label=method,
            markersize=6 if len(shown) > 1 else 10,
            linewidth=1.6,
            **style,
        )
        line.set(**changes)
        for row in own:
            if not np.isfinite(row[axes.y]):
                mark(ax, row[axes.x], 3 * high, color="red", marker="x")
            elif row not in shown:
                mark(ax, row[axes.x], low / 3, **style)
            elif label and row["knob"] != "":
                ax.annotate(
                    f"{row['knob']}",
                    (row[axes.x], row[axes.y]),
                    xytext=(5, 4),
                    textcoords="offset points",
                    color=style["color"],
                    fontsize=9,
                )
    ax.set(xscale=axes.x_scale, yscale=axes.y_scale, xlabel=axes.x_label, ylabel=axes.y_label)
    ax.grid(True, which="major", color="#dddddd", linewidth=0.7)
    ax.set_axisbelow(True)


def can_be_drawn(value, scale):
    """Whether an axis of this scale can show a value."""
    return np.isfinite(value) and (value > 0 or scale != "log")


def mark(ax, x, y, **style):
    """One empty marker, not cut off at the edge of the panel."""
    ax.plot(x, y, "", markersize=9, fillstyle="none", clip_on=False, **style)


def figure(columns=1, size=SIZE, rows=1, **options):
    """A figure of equal panels: (figure, list of axes, row by row)."""
    fig, axes = pyplot().subplots(
        rows, columns, figsize=size, squeeze=False, layout="constrained", **options
    )
    return fig, list(axes.ravel())


def draw_panels(
    contents, size, rows=1, margins=(None, None), sharex=False, sharey=False, **options
):
    """A figure with one panel of lines for each (heading, rows, axes); returns what `figure` does.

    Panels that share an axis are labelled on the outer ones alone. `options` are those of `lines`.
    """
    fig, panels = figure(len(contents) // rows, size, rows, sharex=sharex, sharey=sharey)
    for ax, (heading, shown, axes) in zip(panels, contents):
        place = ax.get_subplotspec()
        x_label = axes.x_label if place.is_last_row() or not sharex else ""
        y_label = axes.y_label if place.is_first_col() or not sharey else ""
        lines(ax, shown, axes._replace(x_label=x_label, y_label=y_label), **options)
        ax.set_title(heading)
        ax.margins(*margins)
    return fig, panels


def legend(ax):
    """A legend inside a panel."""
    ax.legend(fontsize=10, framealpha=0.85, edgecolor="none")


def legend_below(fig, ax, columns, count=None, **options):
    """A legend below the panels, of the first `count` lines of one of them."""
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(
        handles[:count],
        labels[:count],
        ncols=columns,
        loc="outside lower center",
        fontsize=10,
        frameon=False,
        **options,
    )


def readable_ticks(axis):
    """Ticks of a logarithmic axis: plain numbers where it has less than three decades."""
    from matplotlib import ticker

    low, high = axis.get_view_interval()
    axis.set_minor_formatter(ticker.NullFormatter())
    if high < 1000 * low:
        subs = (1, 2, 5) if high < 30 * low else (1,)
        axis.set_major_locator(ticker.LogLocator(subs=subs))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))


def finish(fig, path, title):
    """Set the title, which names the reference, and write the PNG."""
    for ax in fig.axes:
        for axis in (ax.xaxis, ax.yaxis):
            if axis.get_scale() == "log":
                readable_ticks(axis)
    fig.suptitle(title, fontsize=13)
    fig.set_dpi(DPI)
    save_figure(fig, path)


def work_precision(path, rows, axes=TIME, title="", **options):
    """A diagram of one panel."""
    fig, (ax,) = figure()
    lines(ax, rows, axes, **options)
    legend(ax)
    finish(fig, path, title)


def table(folder, name, rows):
    """Write rows as name.csv and return the name of the file."""
    tidy = [{key: six_digits(value) for key, value in row.items()} for row in rows]
    write_csv(folder / f"{name}.csv", tidy)
    return f"{name}.csv"


def six_digits(value):
    """A value for a CSV: six digits are more than any measurement here has."""
    return f"{value:.6g}" if isinstance(value, (float, np.floating)) else value


def select(rows, **wanted):
    """The rows with these values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def at(rows, **wanted):
    """The one row with these values."""
    found = select(rows, **wanted)
    if len(found) != 1:
        raise LookupError(f"{len(found)} rows with {wanted}")
    return found[0]


def number(value):
    """A number for a sentence: two or three digits, powers of ten where it is far from one."""
    if np.isnan(value):
        return "not a number"
    if np.isinf(value):
        return "infinite"
    return f"{value:.1e}" if value and not 1e-2 <= abs(value) < 1e4 else f"{value:.3g}"
