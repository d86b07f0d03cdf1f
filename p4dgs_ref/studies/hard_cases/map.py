"""The stability map of Eq. (11): where its formulas are right, over distance and bin width, as a picture and as CSV."""

import csv
import io

import numpy as np

from ...equations import likelihood
from ...scenes.output import write_atomically
from .. import quadrature
from ..accuracy import formulas
from .entry import DTYPES

DISTANCES = 10.0 ** np.linspace(-1, 3, 65)  # |x - mu| / sigma
WIDTHS = 10.0 ** np.linspace(-12, 6, 73)  # q / sigma
LEAST_BITS = 1e-6  # below, bits are not judged
WORST, BEST = 0.0, -17.0  # limits of log10 of the relative error that are drawn
FORMULAS = {"literal": formulas.literal, "floor 1e-6": formulas.hac, "ours": likelihood.forward}


def errors(formula, dtype):
    """log10 of the relative error of the bits (widths, distances); inf where they are no numbers, NaN where not judged."""
    z, w = (np.ascontiguousarray(a).astype(dtype) for a in np.meshgrid(DISTANCES, WIDTHS))
    inputs = dict(f_noisy=z, mu=0 * z, sigma=0 * z + 1, q=w)
    with np.errstate(all="ignore"):
        got = formula(**inputs)[0].astype(np.longdouble)
        true = quadrature.likelihood(inputs, {"bits_bar": 0 * z})[0]["bits"]
        error = np.abs(got - true) / true
        log = np.log10(np.maximum(error, np.longdouble(10) ** (BEST - 1))).astype(float)
    log[~np.isfinite(got)] = np.inf
    return np.where(true >= LEAST_BITS, log, np.nan)


def maps():
    """{(formula, dtype): errors}"""
    return {
        (name, dtype): errors(formula, DTYPES[dtype])
        for dtype in DTYPES
        for name, formula in FORMULAS.items()
    }


def draw_map(path):
    """Draw the map to a PNG at `path` and write its numbers beside it, as path with the ending .csv."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = maps()
    figure = Figure(figsize=(10.5, 6.6), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(DTYPES), len(FORMULAS), sharex=True, sharey=True)
    colors = colormaps["viridis"].with_extremes(bad="white", over="red")
    for axis, ((name, dtype), log) in zip(axes.ravel(), found.items()):
        shown = np.ma.masked_invalid(np.where(np.isinf(log), 99, np.minimum(log, WORST)))
        drawn = axis.pcolormesh(
            DISTANCES, WIDTHS, shown, cmap=colors, vmin=BEST, vmax=WORST, rasterized=True
        )
        axis.set(xscale="log", yscale="log", title=f"{name}, {dtype}")
    for axis in axes[-1]:
        axis.set_xlabel("distance |x - μ| / σ")
    for axis in axes[:, 0]:
        axis.set_ylabel("bin width q / σ")
    figure.colorbar(drawn, ax=axes, label="log10 of the relative error of the bits", extend="max")
    figure.suptitle(
        "Eq. (11): error of the bits against quadrature.  Red: infinite or not a number.  White: below 1e-6 bits",
        fontsize=11,
    )
    write_atomically(
        path, lambda file: figure.savefig(file, format="png", metadata={"Software": None})
    )
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        ["formula", "dtype", "q_over_sigma", "distance_over_sigma", "log10_relative_error"]
    )
    for (name, dtype), log in found.items():
        table.writerows(
            [name, dtype, f"{w:.6g}", f"{z:.6g}", f"{v:.3f}"]
            for w, line in zip(WIDTHS, log)
            for z, v in zip(DISTANCES, line)
        )
    write_atomically(path.with_suffix(".csv"), lambda file: file.write(text.getvalue().encode()))
