"""Heat maps of the errors of Eq. (11): every picture has the same axes and the same colours."""

import numpy as np

from ...report.figures import pyplot

DISTANCES, WIDTHS = (-2, 3), (-12, 6)  # log10 of the limits of |x - mu| / sigma and q / sigma
LEVELS = (-16, 0)  # log10 of the errors that the colours distinguish
COLORS = "viridis"
FAILED = "infinite or NaN"


def plane():
    """Distances and widths of the plane: two axes of numbers that float32 can hold."""
    return tuple(
        np.logspace(*limits, 73).astype(np.float32).astype(float) for limits in (DISTANCES, WIDTHS)
    )


def log_error(error):
    """log10 of an error, not below the lowest level; infinite where the error is not finite."""
    log = np.log10(np.maximum(error, 10.0 ** LEVELS[0]))
    return np.where(np.isfinite(error), log, np.inf)


def draw_heatmap(ax, distances, widths, log):
    """Draw log10 of an error (distances, widths); infinite is red."""
    low, high = LEVELS
    colors = pyplot().get_cmap(COLORS).with_extremes(over="red")
    # An infinite error is above the levels, every finite one at or below them.
    shown = np.where(np.isinf(log), high + 1, np.minimum(log, high))
    mesh = ax.pcolormesh(
        widths, distances, shown, cmap=colors, vmin=low, vmax=high, rasterized=True
    )
    ax.set(xscale="log", yscale="log", xticks=10.0 ** np.arange(-10, 6, 5))
    ax.set(xlim=widths[[0, -1]], ylim=distances[[0, -1]])
    ax.grid(False)
    return mesh


def label_heatmaps(figure, axes, mesh, what="bits"):
    """Write the names of the two axes and the bar of colours, which all panels share."""
    figure.supxlabel("bin width q/σ")
    figure.supylabel("distance |x − μ|/σ")
    label = f"log10 of the error of the {what}"
    figure.colorbar(mesh, ax=axes, location="right", shrink=0.8, extend="both", label=label)
