"""Diagrams of error against time on logarithmic axes: one line per method, points along its knob.

Every diagram has a CSV with its numbers.
"""

from typing import NamedTuple

import numpy as np

from ...report.figures import BLUE, LIGHT_BLUE, RED, pyplot, save_figure, write_csv

# Okabe and Ito's palette, for colour-blind readers. The markers differ as well, for grey prints.
COLORS = (BLUE, RED, "#009E73", "#CC79A7", "#E69F00", LIGHT_BLUE, "#000000", "#8C6D31", "#808080")
MARKERS = "osD^vPXph"
# Every method that a diagram shows, in families that are drawn together. The place in its family
# gives a method its colour and marker, so that it has the same in all diagrams.
FAMILIES = (
    (
        "ellipse, cut labelled, float32",
        "ellipse, cut labelled, float64",
        "3σ box, float32",
        "3σ box, float64",
        "all pairs, float32",
        "all pairs, float64",
        "exact twin, float32",
        "setting `paper`",
        "setting `fast`",
    ),
    ("no stop", "stop at T < 1e-4", "stop at T < 1e-2"),
    (
        "literal",
        "HAC, floor 1e-6",
        "tail-symmetric",
        "log domain",
        "table, 256 per sigma",
        "stable",
    ),
    (
        "frequencies, 12σ window",
        "frequencies, fitted window",
        "the codec",
        "the codec, lanes labelled",
    ),
    ("mean", "log2 deviation"),
    (
        "adaptive, trained with it",
        "adaptive, rounded to it later",
        "trained adaptive, made fixed",
        "fixed, trained with it",
        "fixed, rounded to it later",
    ),
    ("seeds", "iterations", "anchors", "deformation width", "anchors rated", "precision"),
    ("estimated by the loss", "in the file"),
    ("weights, plain", "weights, entropy coded", "positions, plain"),
    ("1 level", "2 levels", "4 levels", "8 levels"),
    ("saved by the context", "hash grid and context networks"),
    ("forward", "central", "fourth order", "complex step", "manual backward"),
    (
        "prediction",
        "deformation",
        "projection",
        "compositing",
        "loss",
        "rate",
        "whole step",
        "optimiser",
    ),
)
STYLES = {
    method: dict(color=color, marker=marker)
    for family in FAMILIES
    for method, color, marker in zip(family, COLORS, MARKERS)
}
STYLES["table, float64"] = STYLES["table, 256 per sigma"]  # the same formula at several sizes
# Where a label may stand beside its point, in points, and which of its sides is towards it.
PLACES = (
    (6, 4, "left"),
    (6, -12, "left"),
    (-6, 4, "right"),
    (-6, -12, "right"),
    (0, 9, "center"),
    (0, -17, "center"),
    (12, 12, "left"),
    (-12, 12, "right"),
    (12, -20, "left"),
    (-12, -20, "right"),
)
SIZE, DPI = (8, 5.6), 120


class Finding(NamedTuple):
    """The result of one study. `report` writes it, the command line prints it."""

    name: str
    title: str
    reference: str  # what errors are measured against
    figures: list  # [(file, caption)]
    tables: list  # files
    reading: str  # sentences made of the measured numbers
    repeats: str  # how times were taken
    stretch: float = 1.0  # the worst ratio of the wall clock to the processor's


class Axes(NamedTuple):
    """What a panel shows: columns of the rows, labels with units, scales."""

    x: str
    y: str
    x_label: str
    y_label: str
    x_scale: str = "log"
    y_scale: str = "log"


TIME = Axes("ms", "error", "processor time (ms, median and quartiles)", "error")


def lines(ax, rows, axes, label=True, **changes):
    """Draw one line per method through its rows (dictionaries), with the knob beside each point.

    A row with the columns x_low and x_high, or y_low and y_high, gets a bar from quartile to
    quartile. A value that the axis cannot show stays out of the line: NaN and infinity are a red
    cross above the panel's values, an error of zero is an empty marker below them. `changes`
    replace properties of the lines.
    """
    values = [row[axes.y] for row in rows if can_be_drawn(row[axes.y], axes.y_scale)]
    low, high = (min(values), max(values)) if values else (1e-16, 1.0)
    for method in dict.fromkeys(row["method"] for row in rows):
        own, style = select(rows, method=method), STYLES[method]
        shown = [row for row in own if can_be_drawn(row[axes.y], axes.y_scale)]
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
            else:
                draw_quartiles(ax, row, axes, style["color"])
                if label and row["knob"] != "":
                    ax.annotate(
                        f"{row['knob']}",
                        (row[axes.x], row[axes.y]),
                        xytext=PLACES[0][:2],
                        textcoords="offset points",
                        color=style["color"],
                        fontsize=9,
                        in_layout=False,  # the panels keep their sizes where labels move
                    )
    ax.set(xscale=axes.x_scale, yscale=axes.y_scale, xlabel=axes.x_label, ylabel=axes.y_label)
    ax.grid(True, which="major", color="#dddddd", linewidth=0.7)
    ax.set_axisbelow(True)


def draw_quartiles(ax, row, axes, color):
    """The bars from the first to the third quartile of what a row measured."""
    x, y = row[axes.x], row[axes.y]
    for draw, name, other in ((ax.hlines, axes.x, y), (ax.vlines, axes.y, x)):
        if f"{name}_low" in row:
            draw(other, row[f"{name}_low"], row[f"{name}_high"], color=color, linewidth=1)


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
        # A narrow axis has too few of these ticks, or too many between them.
        narrow = high < 5 * low
        axis.set_major_locator(ticker.MaxNLocator(4) if narrow else ticker.LogLocator(subs=subs))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))


def place_labels(fig):
    """Move the labels of points to where they cover neither points nor each other.

    A label for which there is no such place is left out; the CSV has its number.
    """
    fig.draw_without_rendering()
    for ax in fig.axes:
        labels = [text for text in ax.texts if hasattr(text, "xyann")]
        taken = [point for line in ax.lines if labels for point in marker_boxes(ax, line)]
        for text in labels:
            for x, y, side in PLACES:
                text.set(horizontalalignment=side)
                text.xyann = x, y
                box = text.get_window_extent()
                inside = ax.bbox.count_contains(box.corners()) == 4
                if inside and not box.count_overlaps(taken):
                    taken.append(box)
                    break
            else:
                text.set_visible(False)


def marker_boxes(ax, line, half=4):
    """A box of `half` pixels to each side around every marker of a line."""
    from matplotlib.transforms import Bbox

    points = ax.transData.transform(np.column_stack(line.get_data()))
    return [Bbox([point - half, point + half]) for point in points[np.isfinite(points).all(axis=1)]]


def finish(fig, path, title):
    """Set the title, which names the reference, and write the PNG."""
    for ax in fig.axes:
        for axis in (ax.xaxis, ax.yaxis):
            if axis.get_scale() == "log":
                readable_ticks(axis)
            else:
                axis.get_major_formatter().set_useOffset(False)
    fig.suptitle(title, fontsize=13)
    fig.set_dpi(DPI)
    place_labels(fig)
    save_figure(fig, path)


def work_precision(path, rows, axes=TIME, title="", columns=2, **options):
    """A diagram of one panel."""
    fig, (ax,) = figure()
    lines(ax, rows, axes, **options)
    legend_below(fig, ax, columns)
    finish(fig, path, title)


def table(folder, name, rows):
    """Write rows as name.csv and return the name of the file."""
    tidy = [{key: six_digits(value) for key, value in row.items()} for row in rows]
    write_csv(folder / f"{name}.csv", tidy)
    return f"{name}.csv"


def six_digits(value):
    """A value for a CSV: six digits are more than any measurement here has."""
    return f"{value:.6g}" if isinstance(value, (float, np.floating)) else value


def unfold(rows, columns):
    """Every row once for each {method: column}, with what the column holds as its `value`."""
    kinds = columns.items()
    return [{**row, "method": name, "value": row[key]} for name, key in kinds for row in rows]


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
