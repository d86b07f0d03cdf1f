"""The picture of accuracy: loss against time, a panel for each question, with its answer above."""

from textwrap import fill

from ...report.figures import BLUE, RED, figure_style, save_figure, subplots
from . import QUESTIONS, by_question, comparison, disturbance_note, duration

NOTE = (
    "Down is more accurate, left is faster. A star is what this project uses; a bar goes from "
    "quartile to quartile. Where an axis is logarithmic, no error at all is drawn at its foot."
)
STYLE = {"font.size": 10, "axes.titlesize": 11, "axes.titleweight": "bold", "figure.dpi": 100}
SMALLEST = 1e-9  # a smaller error is none
LEFT = ("exact", "mirrored")  # choices with a label to the left, because another one is near


def draw_panel(ax, rows, width):
    """Draw the points of a question, with its answer in lines of `width` letters."""
    from matplotlib.ticker import NullFormatter

    question, losses = QUESTIONS[rows[0]["question"]], [row["loss"] for row in rows]
    is_log = question.scale == "log"
    foot = 0.1 * min(loss for loss in losses if loss > SMALLEST) if is_log else 0
    ax.set(xscale="log", yscale=question.scale, xlabel="processor time", ylabel=question.axis)
    # A decade on either side: there is room for labels, and powers of ten are ticks enough.
    ax.set_xlim(0.1 * min(row["ms"] for row in rows), 10 * max(row["ms"] for row in rows))
    most = max(losses)
    ax.set_ylim(*((0.1 * foot, 10 * most) if is_log else (-0.2 * most, 1.4 * most)))
    for row in rows:
        is_ours, is_left = row["choice"] == question.ours, row["choice"] in LEFT
        color, y = RED if is_ours else BLUE, max(row["loss"], foot)
        ax.plot([row["ms_low"], row["ms_high"]], [y, y], color=color)
        ax.plot(row["ms"], y, "*" if is_ours else "o", color=color, markersize=15 if is_ours else 7)
        ax.annotate(
            row["choice"],
            (row["ms"], y),
            (-8 if is_left else 8, 4),
            textcoords="offset points",
            ha="right" if is_left else "left",
            color=color,
        )
    words = comparison(next(row for row in rows if row["choice"] == question.answer), rows[0])
    says = "{question}: {choice} is {faster} as {reference}, {lost}".format(**words)
    ax.set_title(fill(says, width), loc="left")
    ax.xaxis.set_major_formatter(lambda ms, _: duration(ms))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, color="#dddddd")


@figure_style(STYLE)
def draw(path, rows):
    """Draw the rows of a run, or of a record."""
    figure, axes = subplots(2, 2, figsize=(9, 6.6))
    for ax, group in zip(axes.flat, by_question(rows).values()):
        draw_panel(ax, group, 46)
    figure.supxlabel(fill(f"{NOTE} {disturbance_note(rows)}", 110), fontsize=10, x=0.02, ha="left")
    save_figure(figure, path)


@figure_style({**STYLE, "font.size": 10.5, "figure.dpi": 200})
def draw_front(path, rows):
    """Draw four panels below each other, for a picture that is shown small."""
    figure, axes = subplots(4, figsize=(4.2, 6.6))
    for ax, (name, group) in zip(axes, by_question(rows).items()):
        draw_panel(ax, group, 37)
        ax.set_xlabel("")
        ax.set_ylabel(QUESTIONS[name].unit)
    save_figure(figure, path)
