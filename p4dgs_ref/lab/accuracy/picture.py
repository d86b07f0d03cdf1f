"""The picture of accuracy: loss against time, a panel for each question, with its answer above."""

from textwrap import fill

import numpy as np

from ...report.figures import BLUE, RED, figure_style, save_figure, subplots
from . import QUESTIONS, STEP, by_question, comparison, disturbance_note, duration, loss_of

NOTE = "Lower is more accurate, left is faster; bars: quartiles. Star: what this project uses."
STYLE = {"font.size": 10.5, "axes.titlesize": 11, "axes.titleweight": "bold", "figure.dpi": 200}
LEFT = ("exact", "fast", "as printed")  # labels to the left, because another choice is near


def draw_panel(ax, rows):
    """Draw the points of a question, with its answer above."""
    from matplotlib.ticker import NullFormatter

    question = QUESTIONS[rows[0]["question"]]
    answer = next(row for row in rows if row["choice"] == question.answer)
    title = f"{answer['question']}: {answer['choice']} is {comparison(answer, rows)}"
    ax.set_title(fill(f"{title}, {loss_of(answer)}", 37), loc="left")
    losses = [row["loss"] for row in rows if row["choice"] != STEP]
    times = [row["ms"] for row in rows]
    most, least = max(losses), 0.2 * min(loss for loss in losses if loss > 0)
    decades = np.log10(most / least)
    # The part below `least` is linear, so that 0 has a place of its own.
    ax.set_yscale("symlog", linthresh=least, linscale=decades / 3)
    low, high = np.log10([5 * least, most]).round()
    ticks = 10 ** np.arange(low, high + 1, max(1, (high - low) // 2))
    ax.set_yticks([0, *ticks] if 0 in losses else ticks)
    ax.set_ylim(-0.3 * least if 0 in losses else 2 * least, most * 10**decades)
    ax.set(xscale="log", ylabel=question.label)
    # A decade on either side: there is room for labels, and powers of ten are ticks enough.
    ax.set_xlim(0.1 * min(times), 10 * max(times))
    for row in rows:
        if row["choice"] == STEP:
            ax.axvline(row["ms"], color=BLUE, ls=":")
            ax.text(row["ms"], 1.5 * least, f"{STEP} ", color=BLUE, ha="right")
            continue
        is_ours, is_left, y = row["choice"] == question.ours, row["choice"] in LEFT, row["loss"]
        color = RED if is_ours else BLUE
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
    ax.xaxis.set_major_formatter(lambda ms, _: duration(ms))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, color="#dddddd")


@figure_style(STYLE)
def draw(path, rows):
    """Draw the rows of a run, or of a record."""
    figure, axes = subplots(4, figsize=(4.2, 7.6))
    for ax, group in zip(axes, by_question(rows).values()):
        draw_panel(ax, group)
    figure.supxlabel(
        fill(NOTE + (" Disturbed by other programs." if disturbance_note(rows) else ""), 55),
        fontsize=9,
        x=0.02,
        ha="left",
    )
    save_figure(figure, path)
