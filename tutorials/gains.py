"""What an idea buys: a bar for each of our files beside the paper's numbers.

    gains.show("08_step", {"one step": "fixed step"}, {"all of it": (0.85, "38.24 dB")})

draws out/08_step_gain.png; {} says that the paper has no number, so only ours are drawn.
"""

import numpy as np

from p4dgs_ref.lab.writer import read_csv
from tutorials.tools import figures
from tutorials.tools import show as drawing
from tutorials.tools.shared import FOLDER


def rows_of(label, record="ablate"):
    """The longest trainings of `bouncing` in a record of the experiments, one a seed."""
    rows = read_csv(FOLDER / "experiments" / "records" / f"{record}.csv")
    asked = {"scene": "bouncing", "label": label}
    found = [row for row in rows if asked.items() <= row.items()]
    longest = max(row["iterations"] for row in found)
    return [row for row in found if row["iterations"] == longest]


def mean(label, column="bytes", record="ablate"):
    """The mean of a column over the seeds of a label."""
    return np.mean([row[column] for row in rows_of(label, record)])


def show(name, here, paper, record="ablate"):
    """Draw our files, {text: label of a record's rows}, and the paper's, {text: (MB, quality)}."""
    figure, (ours, theirs) = figures.pyplot().subplots(
        1, 2, figsize=(13, 1.4 + 0.6 * max(len(here), len(paper))), layout="constrained"
    )
    for text, label in here.items():
        rows = rows_of(label, record)
        db = [row["psnr_db"] for row in rows]
        size = mean(label, "bytes", record)
        ours.barh(text, size, color=drawing.PALE)
        if "gaussians_bytes" in rows[0]:  # a record may not know the parts of a file
            ours.barh(text, mean(label, "gaussians_bytes", record), color=drawing.SPACE)
            ours.set_xlabel("dark: Gaussians or anchors, pale: networks and the rest")
        ours.text(
            size, text, f" {size:,.0f} bytes\n {min(db):.1f} to {max(db):.1f} dB", va="center"
        )
    for text, (size, quality) in paper.items():
        theirs.barh(text, size, color=drawing.GREY)
        theirs.text(size, text, f" {size} MB\n {quality}", va="center")
    ours.set_title("here: bouncing, three seeds")
    theirs.set_title("in the paper: T-Rex")
    if not paper:
        theirs.remove()
    for ax in (ours, theirs):
        ax.invert_yaxis()
        ax.margins(x=0.5)
        ax.set_xticks(())
        ax.grid(False)
    figures.show(figure, f"{name}_gain")
