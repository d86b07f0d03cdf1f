"""The stability map of Eq. (11): the error of its formulas over distance and bin width."""

import numpy as np

from ..accuracy import formulas
from ..accuracy.heatmap import draw_heatmap
from ..accuracy.likelihood import LEAST_BITS, errors
from ..report import pyplot, save_figure, write_csv
from .table import DTYPES

DISTANCES = np.logspace(-1, 3, 65)  # |f_noisy - mu| / sigma
WIDTHS = np.logspace(-12, 6, 73)  # q / sigma
BEST = -17.0  # log10 of the smallest relative error that is drawn
FORMULAS = {
    "literal": formulas.literal,
    "floor 1e-6": formulas.hac,
    "ours": formulas.FORMULAS["stable"],
}


def maps():
    """log10 of the relative error of the bits, {(formula, dtype): array (widths, distances)}.

    It is infinite where a formula gives NaN or infinity, and NaN where the true value is less than
    LEAST_BITS, so that a relative error means nothing.
    """
    found = {}
    for dtype in DTYPES:
        # The true values are those of the inputs as this precision holds them.
        axes = (axis.astype(dtype).astype(float) for axis in (DISTANCES, WIDTHS))
        z, w = (a.ravel() for a in np.meshgrid(*axes))
        log_p, _, _ = formulas.truth(z, w)
        judged = -log_p / np.log(2) >= LEAST_BITS
        for name, formula in FORMULAS.items():
            error, _ = errors(formula, z, w, dtype)
            log = np.log10(np.maximum(error, 10.0 ** (BEST - 1)))
            log = np.where(np.isfinite(error), log, np.inf)
            found[name, dtype] = np.where(judged, log, np.nan).reshape(len(WIDTHS), -1)
    return found


def draw_map(path):
    """Draw the map to a PNG and write its numbers beside it, with the ending .csv."""
    found = maps()
    figure, axes = pyplot().subplots(
        2, 3, figsize=(11, 7), sharex=True, sharey=True, layout="constrained"
    )
    for ax, ((name, dtype), log) in zip(axes.ravel(), found.items()):
        drawn = draw_heatmap(ax, DISTANCES, WIDTHS, log, (BEST, 0.0))
        ax.set_title(f"{name}, {dtype}")
    figure.supxlabel("distance |x − μ| / σ")
    figure.supylabel("bin width q / σ")
    figure.colorbar(drawn, ax=axes, label="log10 of the relative error of the bits", extend="both")
    figure.suptitle(
        "Eq. (11): error of the bits against quadrature\n"
        "red: infinite or not a number; white: below 1e-6 bits, not judged"
    )
    save_figure(figure, path)
    rows = [
        (name, dtype, f"{w:.6g}", f"{z:.6g}", f"{value:.3f}")
        for (name, dtype), log in found.items()
        for w, line in zip(WIDTHS, log)
        for z, value in zip(DISTANCES, line)
    ]
    columns = ["formula", "dtype", "q_over_sigma", "distance_over_sigma", "log10_relative_error"]
    write_csv(path.with_suffix(".csv"), rows, columns)
