"""The stability map of Eq. (11): the error of its formulas over distance and bin width."""

import numpy as np

from ...report.figures import pyplot, save_figure, write_csv
from ..accuracy import formulas
from .heatmap import FAILED, draw_heatmap, label_heatmaps, log_error, plane
from .table import DTYPES

FORMULAS = ("literal", "HAC, floor 1e-6", "stable")


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
    write_csv(path.with_suffix(".csv"), rows, columns)
