"""The stability map of Eq. (11): the error of its formulas over distance and bin width.

Every heat map of these errors has the same axes and the same colours.
"""

import numpy as np

from ...report.figures import pyplot, save_figure, write_csv
from ..accuracy import formulas
from .table import DTYPES

FORMULAS = ("literal", "HAC, floor 1e-6", "stable")
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


def maps():
    """log10 of the error of the bits, {(formula, dtype): array (distances, widths)}.

    Errors are relative above 1e-6 bits, and infinite where a formula gives NaN or infinity.
    """
    z, w = np.meshgrid(*plane(), indexing="ij")
    found = {}
    for dtype in DTYPES:
        for name in FORMULAS:
            error, _ = formulas.errors(formulas.FORMULAS[name], z.ravel(), w.ravel(), dtype)
            found[name, dtype] = log_error(error).reshape(z.shape)
    return found


def draw_map(path):
    """Draw the map to a PNG and write its numbers beside it, with the ending .csv."""
    found, (distances, widths) = maps(), plane()
    figure, axes = pyplot().subplots(
        2, 3, figsize=(8, 6.2), sharex=True, sharey=True, layout="constrained"
    )
    for ax, ((name, dtype), log) in zip(axes.ravel(), found.items()):
        mesh = draw_heatmap(ax, distances, widths, log)
        ax.set_title(f"{name}, {dtype}", fontsize=11)
    label_heatmaps(figure, axes, mesh)
    figure.suptitle(
        f"error of the bits (relative above 1e-6 bits)\nred: {FAILED}; reference: quadrature",
        fontsize=13,
    )
    save_figure(figure, path)
    rows = [
        (name, dtype, f"{z:.6g}", f"{w:.6g}", f"{value:.3f}")
        for (name, dtype), log in found.items()
        for z, line in zip(distances, log)
        for w, value in zip(widths, line)
    ]
    columns = ["formula", "dtype", "distance_over_sigma", "q_over_sigma", "log10_error"]
    write_csv(path.with_suffix(".csv"), [dict(zip(columns, row)) for row in rows])
