"""The figures of the tutorials: one style, one folder, and the anchor that all of them follow."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

from p4dgs_ref.lessons import folder_of_tutorial
from p4dgs_ref.output import write_atomically
from p4dgs_ref.report.figures import COLORS

STYLE = {
    "figure.figsize": (8, 4.5),
    "figure.dpi": 120,
    "font.size": 12,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.linewidth": 2,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": f"cycler(color={list(COLORS)})",
}
# The anchor of tutorials/demo.p4dgs that leads through the tutorials. It sits on the highlight of
# the red ball; child 0 is masked, and `child` changes its colour most when the camera walks around.
THREAD = SimpleNamespace(name="anchor 29", index=29, child=2, color="#8000D0")


def pyplot():
    """Return matplotlib.pyplot in the style of the tutorials, whatever the user's settings are."""
    plt = bare_pyplot()
    plt.style.use(["default", STYLE])
    return plt


def bare_pyplot():
    """Return matplotlib.pyplot, with windows only in a notebook or at an interactive prompt."""
    if not interactive():
        os.environ["MPLBACKEND"] = "Agg"  # before the import: a notebook's may not be installed
        import matplotlib

        matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def interactive():
    """Whether this is a notebook or an interactive prompt."""
    return hasattr(sys, "ps1") or "ipykernel" in sys.modules


def out():
    """Return the folder for figures, which is `out` beside the tutorial that runs.

    The environment variable P4DGS_TUTORIALS_OUT names another one.
    """
    folder = Path(os.environ.get("P4DGS_TUTORIALS_OUT") or folder_of_tutorial() / "out")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def finish(ax, legend=None, grid=True, title_size="large", **settings):
    """Set the title, labels and limits of axes; `legend` holds the settings of one, if any."""
    ax.set(**settings)
    ax.title.set_size(title_size)
    if legend is not None:
        ax.legend(**legend)
    if not grid:
        ax.grid(False)


def label(ax, *places, **settings):
    """Write the labels of lines beside them and in their colours, in place of a legend.

    The places are those of the texts, in the units of the axes and in the order of the lines.
    """
    lines = [line for line in ax.get_lines() if not line.get_label().startswith("_")]
    for line, place in zip(lines, places, strict=True):
        ax.text(*place, line.get_label(), color=line.get_color(), **settings)


def show(figure, name, title="", size=16):
    """Save a figure as out/NAME.png, and show it in a notebook or at an interactive prompt."""
    if title:
        figure.suptitle(title, fontsize=size)
    place = out() / f"{name}.png"
    write_atomically(place, lambda file: figure.savefig(file, bbox_inches="tight"))
    if interactive():
        bare_pyplot().show(block=False)
    else:
        print(f"figure: {place.parent.name}/{place.name}")
        bare_pyplot().close(figure)
