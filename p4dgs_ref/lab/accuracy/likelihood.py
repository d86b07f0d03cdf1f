"""Study 2, likelihood: formulas of Eq. (11), their errors and their time."""

import json
import math
import sys
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from ..clock import alternate, compare, stretch_of
from .diagram import (
    STYLES,
    Axes,
    Finding,
    at,
    draw_panels,
    figure,
    finish,
    legend_below,
    number,
    select,
    table,
)
from .formulas import FORMULAS, TABLES, truth
from .formulas import table as table_formula
from .heatmap import FAILED, draw_heatmap, label_heatmaps, log_error, plane
from .timing import special_calls

# Bits and slopes at points of the planes, from 60-digit arithmetic: {"quick": rows, "full": rows}.
# `python -m tests.golden.likelihood_points` writes them in a checkout.
DIGITS = Path(__file__).with_name("sixty_digits.json")
LEAST_BITS = 1e-6  # errors of fewer bits are relative to this
DTYPES = ("float32", "float64")
REACHES = (3, 1000)  # sigmas: the values of a trained model, and the declared domain
REFERENCE = "reference: quadrature"


def inputs(z, w, dtype):
    """Inputs of Eq. (11) with mu = 0 and sigma = 1, as one row."""
    z, w = (np.asarray(a, dtype).reshape(1, -1) for a in (z, w))
    return dict(f_noisy=z, mu=np.zeros_like(z), sigma=np.ones_like(z), q=w)


def errors(formula, z, w, dtype):
    """Errors of the bits, relative above LEAST_BITS, and of the slopes, relative to the larger one.

    z and w are vectors of numbers that float32 can hold, so that both precisions have one truth.
    """
    with np.errstate(all="ignore"):
        bits, (f_slope, _, q_slope) = formula(**inputs(z, w, dtype))
    true_bits, *true_slopes = (-a / math.log(2) for a in truth(z, w))
    bits_error = np.abs(bits[0].astype(float) - true_bits) / np.maximum(true_bits, LEAST_BITS)
    slopes = np.concatenate([f_slope, q_slope]).astype(float)
    gap = np.abs(slopes - true_slopes).max(axis=0)
    return bits_error, relative_to(np.abs(true_slopes).max(axis=0), gap)


def relative_to(largest, gap):
    """gap / largest; where both are 0 there is no error, where only `largest` is 0 it is 1."""
    without_scale = np.where(gap == 0, 0.0, np.where(np.isfinite(gap), 1.0, gap))
    return np.divide(gap, largest, out=without_scale, where=largest > 0)


def check_truth(quick):
    """The largest relative distance of the quadrature from 60-digit values: of bits, of slopes."""
    points = json.loads(DIGITS.read_text(encoding="utf-8"))["quick" if quick else "full"]
    z, w, bits, *slopes = np.array(points).T
    found_bits, *found_slopes = (-a / math.log(2) for a in truth(z, w))
    bits_error = np.abs(found_bits - bits) / np.maximum(bits, LEAST_BITS)
    gap = np.abs(np.array(found_slopes) - slopes).max(axis=0)
    return bits_error.max(), relative_to(np.abs(slopes).max(axis=0), gap).max()


def cuts(z_axis, w_axis):
    """The indices of the distance and the width next to 1."""
    return tuple(int(np.abs(np.log(axis)).argmin()) for axis in (z_axis, w_axis))


def plane_tables(folder, z_axis, w_axis, maps):
    """Write the numbers of the two heat maps and of the curves."""
    row, column = cuts(z_axis, w_axis)
    bits_rows, gradient_rows, curve_rows = [], [], []
    for ((name, dtype), (bits, gradient)), (i, z), (j, w) in product(
        maps.items(), enumerate(z_axis), enumerate(w_axis)
    ):
        point = {"formula": name, "dtype": dtype, "distance": z, "bin_width": w}
        bits_rows.append({**point, "bits_error": bits[i, j]})
        gradient_rows.append({**point, "gradient_error": gradient[i, j]})
        if i == row or j == column:
            curve_rows.append(bits_rows[-1])
    return [
        table(folder, "likelihood_bits", bits_rows),
        table(folder, "likelihood_gradient", gradient_rows),
        table(folder, "likelihood_curves", curve_rows),
    ]


def timed_methods():
    """[(method, knob, formula, dtype)] of the diagram of times."""
    return [
        *(
            (name, dtype, formula, dtype)
            for name, formula in FORMULAS.items()
            if not name.startswith("table")
            for dtype in DTYPES
        ),
        *(("table, float64", f"{n}/σ", table_formula(n), "float64") for n in TABLES),
    ]


def timed_rows(n, repeats):
    """Worst errors, time and special functions per value, for n bins within each reach."""
    rng, rows, methods = np.random.default_rng(0), [], timed_methods()
    w = np.exp(rng.uniform(np.log(0.01), np.log(10), n)).astype(np.float32).astype(float)
    for reach in REACHES:
        z = rng.uniform(0, reach, n).astype(np.float32).astype(float)
        runs = {
            (name, knob): partial(formula, **inputs(z, w, dtype))
            for name, knob, formula, dtype in methods
        }
        with np.errstate(all="ignore"):
            times = alternate(runs, repeats)
            work = {
                key: special_calls(sys.modules[run.func.__module__], run)
                for key, run in runs.items()
            }
        for name, knob, formula, dtype in methods:
            bits, gradient = errors(formula, z, w, dtype)
            rows.append(
                {
                    "method": name,
                    "knob": knob,
                    "reach": reach,
                    **times[name, knob].columns("ns", 1e6 / n),
                    "special_per_value": work[name, knob] / n,
                    "bits_error": worst(bits),
                    "gradient_error": worst(gradient),
                    "failed_share": float(np.mean(~np.isfinite(bits))),
                }
            )
    return rows


def worst(values):
    """The largest value; infinite where any is not finite."""
    return float(values.max()) if np.isfinite(values).all() else math.inf


def run(folder, quick, progress, jobs=1):
    z_axis, w_axis = plane(quick)
    z, w = (a.ravel() for a in np.meshgrid(z_axis, w_axis, indexing="ij"))
    progress("likelihood: the plane")
    maps = {
        (name, dtype): [e.reshape(len(z_axis), -1) for e in errors(formula, z, w, dtype)]
        for name, formula in FORMULAS.items()
        for dtype in DTYPES
    }
    bits_error, slope_error = check_truth(quick)
    progress("likelihood: times")
    n, repeats = (2000, 3) if quick else (20_000, 9)
    rows = timed_rows(n, repeats)
    draw_times(folder / "likelihood.png", rows)
    draw_map(folder / "likelihood_bits.png", z_axis, w_axis, maps, "bits")
    draw_map(folder / "likelihood_gradient.png", z_axis, w_axis, maps, "gradient")
    draw_curves(folder / "likelihood_curves.png", z_axis, w_axis, maps)
    captions = {
        "likelihood": "Largest error of the bits against time, for the values of a trained model "
        "and for the whole domain.",
        "likelihood_bits": f"Error of the bits over distance and bin width; red: {FAILED}.",
        "likelihood_gradient": f"Error of the gradient over distance and bin width; red: {FAILED}.",
        "likelihood_curves": "Error of the bits along two lines of the plane, float32 dashed.",
    }
    return Finding(
        "likelihood",
        "Likelihood, Eq. (11)",
        "Gauss–Legendre quadrature of the scaled density, which is itself within "
        f"{number(bits_error)} (bits) and {number(slope_error)} (slopes) of 60-digit values at "
        "points drawn from the plane",
        [(f"{name}.png", caption) for name, caption in captions.items()],
        [table(folder, "likelihood", rows), *plane_tables(folder, z_axis, w_axis, maps)],
        read(rows, maps),
        f"median and quartiles of {repeats} alternating repeats, forward with its slopes",
        stretch_of(rows),
    )


def draw_times(path, rows):
    axes = Axes(
        "ns", "bits_error", "processor time (ns per value)", "largest relative error of the bits"
    )
    contents = [
        (f"distances up to {reach} σ", select(rows, reach=reach), axes) for reach in REACHES
    ]
    fig, panels = draw_panels(contents, (8, 5.6), margins=(0.25, None))
    legend_below(fig, panels[0], 3)
    title = f"Eq. (11), bins of 0.01 to 10 σ; {REFERENCE}\nred cross: somewhere {FAILED}"
    finish(fig, path, title)


def draw_map(path, z_axis, w_axis, maps, what):
    """log10 of the error over the plane, one panel per formula."""
    fig, panels = figure(3, (8, 6.2), rows=2, sharex=True, sharey=True)
    for ax, name in zip(panels, FORMULAS):
        error = maps[name, "float64"][0 if what == "bits" else 1]
        mesh = draw_heatmap(ax, z_axis, w_axis, log_error(error))
        ax.set_title(name, fontsize=11)
    label_heatmaps(fig, panels, mesh, what)
    scale = "relative above 1e-6 bits" if what == "bits" else "relative to the larger slope"
    finish(fig, path, f"float64, error of the {what} ({scale})\nred: {FAILED}; {REFERENCE}")


def draw_curves(path, z_axis, w_axis, maps):
    """Error of the bits along distance at q = sigma, and along width at a distance of 1 sigma."""
    fig, panels = figure(2, (8, 5.8), sharey=True)
    row, column = cuts(z_axis, w_axis)
    for (name, dtype), (bits, _) in maps.items():
        color = STYLES[name]["color"]
        style, label = ("-", name) if dtype == "float64" else ("--", None)
        for ax, axis, values in zip(panels, (z_axis, w_axis), (bits[:, column], bits[row])):
            finite = np.isfinite(values)
            shown = np.where(finite, np.maximum(values, 1e-17), np.nan)
            ax.plot(axis, shown, style, color=color, label=label)
            ax.plot(axis[~finite], np.full((~finite).sum(), 30.0), "x", color="red", markersize=4)
    for ax in panels:
        ax.set(xscale="log", yscale="log")
        ax.grid(True, color="#dddddd", linewidth=0.7)
    panels[0].set(xlabel="distance |x − μ|/σ, q = σ", ylabel="relative error of the bits")
    panels[1].set(xlabel="bin width q/σ, distance 1 σ")
    legend_below(fig, panels[0], 3)
    finish(fig, path, f"solid float64, dashed float32\nred crosses: {FAILED}; {REFERENCE}")


def read(rows, maps):
    """What the numbers say."""
    near, far = REACHES
    stable = at(rows, method="stable", knob="float64", reach=near)
    literal = at(rows, method="literal", knob="float64", reach=near)
    single = at(rows, method="stable", knob="float32", reach=far)

    def shares(name):
        """Per cent of the plane that is not finite, and that is more than 1 % wrong."""
        bits, _ = maps[name, "float64"]
        failed, wrong = np.mean(~np.isfinite(bits)), np.mean(~(bits <= 0.01))
        return (
            f"in {100 * failed:.0f} % of the points and more than 1 % wrong in {100 * wrong:.0f} %"
        )

    bits, gradient = maps["stable", "float64"]
    times = compare("`stable`", stable, "the literal formula", literal, "ns")
    return (
        f"{times} These are times of one value within {near} σ; for it `stable` computes "
        f"{stable['special_per_value']:.3g} special functions and the literal formula "
        f"{literal['special_per_value']:.3g}. Over the whole plane the literal formula is not "
        f"finite {shares('literal')}; HAC's floor is not finite "
        f"{shares('HAC, floor 1e-6')}; the tail-symmetric formula {shares('tail-symmetric')}; the "
        f"log domain {shares('log domain')}. The largest error of `stable` over the plane is "
        f"{number(bits.max())} in the bits and {number(gradient.max())} in the gradient; with "
        f"float32 inputs and outputs it is {number(single['bits_error'])} within {far} σ."
    )
