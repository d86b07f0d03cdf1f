"""Diagrams of a loss against what is spent: one line per method, points along its knob."""

from itertools import product

import numpy as np

from ...report.figures import COLORS, save_figure, styled, subplots
from ..writer import grouped

# The markers differ as well, for grey prints.
LINE_COLORS = (*COLORS, "#8C6D31", "#808080")
MARKERS = "osD^vPXph<>*d"
# Where a label may stand beside its point, in points, and which of its sides is towards it.
PLACES = (
    (6, 4, "left"),
    (6, -12, "left"),
    (-6, 4, "right"),
    (-6, -12, "right"),
    (0, 9, "center"),
    (0, -17, "center"),
    (0, -28, "center"),
    (12, 12, "left"),
    (-12, 12, "right"),
    (12, -20, "left"),
    (-12, -20, "right"),
    (14, -3, "left"),
    (-14, -3, "right"),
    (9, 6, "left"),
    (-9, 6, "right"),
)
SMALLEST_ERROR = 1e-17  # a logarithmic axis cannot show zero


def lines(ax, rows, x, y, joined=True):
    """Draw one line per `line` through the columns x and y of rows, with the value at each point.

    A row that is `ours` has a star and a bold label. The entries of `each` are dots at its x.
    A row with the columns x_low and x_high gets a bar from quartile to quartile. NaN and infinity
    are a red cross at the top of the panel. Scales and labels of the axes are the caller's.
    """
    for i, ((name,), points) in enumerate(grouped(rows, "line").items()):
        color, marker = LINE_COLORS[i % len(LINE_COLORS)], MARKERS[i % len(MARKERS)]
        style = dict(color=color, marker=marker, markersize=6, linewidth=1.6 * joined)
        smallest = SMALLEST_ERROR if ax.get_yscale() == "log" else -np.inf
        losses = [max(row[y], smallest) if np.isfinite(row[y]) else np.nan for row in points]
        ax.plot([row[x] for row in points], losses, label=name, **style)
        for row, loss in zip(points, losses):
            at, above = (row[x], loss), ax.transData
            if np.isnan(loss):
                at, above = (row[x], 0.92), ax.get_xaxis_transform()
                ax.plot(*at, "x", color="red", markersize=9, transform=above)
            if row.get("ours"):
                ax.plot(*at, "*", color=color, markersize=17, transform=above)
            for one in row.get("each", ()):
                ax.plot(row[x], one, "_", color=color, markersize=9)
            if f"{x}_low" in row:
                ax.plot(
                    [row[f"{x}_low"], row[f"{x}_high"]],
                    [at[1]] * 2,
                    "",
                    color=color,
                    linewidth=1,
                    transform=above,
                )
            ax.annotate(
                row["value"],
                at,
                xycoords=above,
                xytext=PLACES[0][:2],
                textcoords="offset points",
                color=color,
                fontsize=9,
                fontweight="bold" if row.get("ours") else "normal",
                in_layout=False,  # the panels keep their sizes where labels move
            )
    ax.grid(True, which="major", color="#dddddd", linewidth=0.7)
    ax.set_axisbelow(True)


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
    """Move the labels of points to where they cover neither points, a legend nor each other.

    Where there is room they do not cross lines either. A label for which there is no place is left
    out; the CSV has its number.
    """
    fig.draw_without_rendering()
    for ax in fig.axes:
        labels = [text for text in ax.texts if hasattr(text, "xyann")]
        labels.sort(key=lambda text: text.get_fontweight() != "bold")  # ours first
        drawn = [line for line in ax.lines if labels]
        half = 0.04 * fig.dpi
        taken = [
            *(box for line in drawn for box in boxes(points_of(line), half)),
            *(legend.get_window_extent() for legend in [ax.get_legend()] if legend),
        ]
        crossed = [box for line in drawn for box in boxes(between(points_of(line)), half)]
        for text in labels:
            for avoided, (x, y, side) in product((taken + crossed, taken), PLACES):
                text.set(horizontalalignment=side)
                text.xyann = x, y
                box = text.get_window_extent()
                inside = ax.bbox.count_contains(box.corners()) == 4
                if inside and not box.count_overlaps(avoided):
                    taken.append(box.padded(2))
                    break
            else:
                text.set_visible(False)


def points_of(line):
    """The points [n, 2] of a line in pixels, without those that are not finite."""
    points = line.get_transform().transform(np.column_stack(line.get_data()))
    return points[np.isfinite(points).all(axis=1)]


def between(points, steps=20):
    """Points on the way from each point to the next."""
    shares = np.linspace(0, 1, steps)[:, None]
    return [p for a, b in zip(points, points[1:]) for p in a + shares * (b - a)]


def boxes(points, half):
    """A box of `half` pixels to each side around every point."""
    from matplotlib.transforms import Bbox

    return [Bbox([point - half, point + half]) for point in points]


@styled()
def write_figure(path, rows, x, y, enough, **properties):
    """A diagram of the columns x and y of rows, with properties of its axes.

    A dotted line is at the loss that is enough. Several lines have a legend.
    """
    fig, ax = subplots(figsize=(8, 4.4))
    ax.set(**properties)
    ax.margins(0.12, 0.15)
    lines(ax, rows, x, y)
    ax.axhline(enough, color="gray", linestyle=":")
    if len(grouped(rows, "line")) > 1:
        ax.legend(fontsize=10, frameon=False)
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            readable_ticks(axis)
    fig.set_dpi(120)
    place_labels(fig)
    save_figure(fig, path)
