"""Study 2, likelihood: formulas of Eq. (11), their errors in bits and in gradient over distance and bin width."""

import json
import math
import sys
from functools import cache
from pathlib import Path

import numpy as np

from ..report import pyplot
from .diagram import COLORS, Axes, Finding, at, figure, finish, lines, number, table
from .formulas import FORMULAS, TABLES, truth
from .formulas import table as table_formula
from .timing import alternate, special_calls

DIGITS = Path(__file__).with_name("sixty_digits.json")
LEAST_BITS = 1e-6  # relative errors of fewer bits are not told apart from absolute ones
DTYPES = ("float32", "float64")
REACHES = (3, 1000)  # sigmas: what a trained model asks for, and the declared domain
LEVELS = (-16, 0)  # of the heat maps' colours, log10


def inputs(z, w, dtype):
    """Eq. (11)'s inputs for mu = 0 and sigma = 1, as one row."""
    z, w = (np.asarray(a, dtype).reshape(1, -1) for a in (z, w))
    return dict(f_noisy=z, mu=np.zeros_like(z), sigma=np.ones_like(z), q=w)


def errors(formula, z, w, dtype):
    """Errors of bits, relative above LEAST_BITS, and of slopes, relative to the larger one: two arrays (n,).

    The truth is taken at the inputs rounded to float32, which both precisions are given.
    """
    with np.errstate(all="ignore"):
        bits, (f_slope, _, q_slope) = formula(**inputs(z, w, dtype))
    found = [a[0].astype(float) for a in (bits, f_slope, q_slope)]
    log_p, *slopes = truth(z, w)
    bits, f_slope, q_slope = -log_p / math.log(2), *(-slope / math.log(2) for slope in slopes)
    largest = np.maximum(np.abs(f_slope), np.abs(q_slope))
    gap = np.maximum(np.abs(found[1] - f_slope), np.abs(found[2] - q_slope))
    gradient = np.divide(
        gap,
        largest,
        out=np.where(gap == 0, 0.0, np.where(np.isfinite(gap), 1.0, gap)),
        where=largest > 0,
    )
    return np.abs(found[0] - bits) / np.maximum(bits, LEAST_BITS), gradient


@cache
def sixty_digits():
    """Points of the planes with their bits and slopes from 60-digit arithmetic: {plane: rows}.

    `python -m tests.golden.likelihood_points` writes them.
    """
    return json.loads(DIGITS.read_text(encoding="utf-8"))


def check_truth(quick):
    """Largest relative distance of the quadrature from 60-digit values: of the bits, of the slopes."""
    z, w, bits, *exact = np.array(sixty_digits()["quick" if quick else "full"]).T
    found, *slopes = (-a / math.log(2) for a in truth(z, w))
    gap = np.abs(np.array(slopes) - exact).max(axis=0)
    largest = np.abs(exact).max(axis=0)
    relative = np.divide(gap, largest, out=gap, where=largest > 0)
    return (np.abs(found - bits) / np.maximum(bits, LEAST_BITS)).max(), relative.max()


def plane(quick):
    """Distances and widths of the whole plane, numbers that float32 can hold: two axes."""
    n = 25 if quick else 73
    return (
        np.logspace(-2, 3, n).astype(np.float32).astype(float),
        np.logspace(-12, 6, n).astype(np.float32).astype(float),
    )


def plane_rows(z_axis, w_axis, maps):
    return [
        {
            "formula": name,
            "dtype": dtype,
            "distance": z,
            "bin_width": w,
            "bits_error": bits[i, j],
            "gradient_error": gradient[i, j],
        }
        for (name, dtype), (bits, gradient) in maps.items()
        for i, z in enumerate(z_axis)
        for j, w in enumerate(w_axis)
    ]


def plane_tables(folder, rows, z_axis, w_axis):
    """The numbers of the two maps and of the curves, each under its figure's name."""

    def without(column):
        return [{name: value for name, value in row.items() if name != column} for row in rows]

    z, w = (
        axis[np.abs(np.log(axis)).argmin()] for axis in (z_axis, w_axis)
    )  # the cuts of draw_curves
    cuts = [
        row for row in without("gradient_error") if row["distance"] == z or row["bin_width"] == w
    ]
    return [
        table(folder, "likelihood_bits", without("gradient_error")),
        table(folder, "likelihood_gradient", without("bits_error")),
        table(folder, "likelihood_curves", cuts),
    ]


def timed_rows(n, repeats):
    """Worst errors, nanoseconds and special functions a value, for bins of 0.01 to 10 sigma within each reach."""
    methods = {
        (name, dtype): (name, dtype, formula, dtype)
        for name, formula in FORMULAS.items()
        if not name.startswith("table")
        for dtype in DTYPES
    }
    methods.update(
        {
            ("table", entries): (
                "table, float64",
                f"{entries}/σ",
                table_formula(entries),
                "float64",
            )
            for entries in TABLES
        }
    )
    rng, rows = np.random.default_rng(0), []
    w = np.exp(rng.uniform(np.log(0.01), np.log(10), n)).astype(np.float32).astype(float)
    for reach in REACHES:
        z = rng.uniform(0, reach, n).astype(np.float32).astype(float)
        given = {key: inputs(z, w, method[3]) for key, method in methods.items()}
        with np.errstate(all="ignore"):
            ms = alternate(
                {key: lambda key=key: methods[key][2](**given[key]) for key in methods},
                repeats,
            )
        for key, (name, knob, formula, dtype) in methods.items():
            bits, gradient = errors(formula, z, w, dtype)
            with np.errstate(all="ignore"):
                work = special_calls(sys.modules[formula.__module__], lambda: formula(**given[key]))
            rows.append(
                {
                    "method": name,
                    "knob": knob,
                    "reach": reach,
                    "ns": 1e6 * ms[key] / n,
                    "special_per_value": work / n,
                    "bits_error": worst(bits),
                    "gradient_error": worst(gradient),
                    "failed_share": float(np.mean(~np.isfinite(bits))),
                }
            )
    return rows


def worst(values):
    """The largest; infinite where any is not finite."""
    return float(values.max()) if np.isfinite(values).all() else math.inf


def run(folder, quick, progress):
    z_axis, w_axis = plane(quick)
    z, w = (a.ravel() for a in np.meshgrid(z_axis, w_axis, indexing="ij"))
    progress("likelihood: the plane")
    maps = {
        (name, dtype): [e.reshape(len(z_axis), -1) for e in errors(formula, z, w, dtype)]
        for name, formula in FORMULAS.items()
        for dtype in DTYPES
    }
    checked = check_truth(quick)
    progress("likelihood: times")
    repeats = 3 if quick else 9
    rows = timed_rows(2000 if quick else 20_000, repeats)
    files = [
        table(folder, "likelihood", rows),
        *plane_tables(folder, plane_rows(z_axis, w_axis, maps), z_axis, w_axis),
    ]
    draw_times(folder / "likelihood.png", rows)
    for i, what in enumerate(("bits", "gradient")):
        draw_map(
            folder / f"likelihood_{what}.png",
            z_axis,
            w_axis,
            {name: maps[name, "float64"][i] for name in FORMULAS},
            what,
        )
    draw_curves(folder / "likelihood_curves.png", z_axis, w_axis, maps)
    figures = [
        (
            "likelihood.png",
            "Worst error of the bits against time, for what a trained model asks and for the tail.",
        ),
        (
            "likelihood_bits.png",
            "Error of the bits over the plane of distance and bin width, failures in red.",
        ),
        ("likelihood_gradient.png", "The same for the gradient."),
        ("likelihood_curves.png", "Two cuts through the plane, float32 dashed."),
    ]
    reference = (
        f"Gauss–Legendre quadrature of the scaled density, itself within {number(checked[0])} (bits) and "
        f"{number(checked[1])} (slopes) of 60-digit values at points drawn from the plane"
    )
    return Finding(
        "likelihood",
        "Likelihood, Eq. (11)",
        reference,
        figures,
        files,
        read(rows, maps),
        f"median of {repeats} alternating repeats, forward with its slopes",
    )


def draw_times(path, rows):
    fig, panels = figure(2, (8, 5.6))
    for ax, reach in zip(panels, REACHES):
        lines(
            ax,
            [row for row in rows if row["reach"] == reach],
            Axes("ns", "bits_error", "time (ns a value)", "largest error of the bits, relative"),
        )
        ax.set_title(f"distances to {reach} σ")
        ax.margins(x=0.25)
    fig.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        fontsize=10,
        frameon=False,
    )
    finish(
        fig,
        path,
        "Eq. (11), bins of 0.01 to 10 σ; reference: quadrature\na red cross: infinite or not a number somewhere",
    )


def draw_map(path, z_axis, w_axis, errors_of, what):
    """log10 of the error over the plane, one panel a formula; not finite is red."""
    plt = pyplot()
    fig, axes = plt.subplots(2, 3, figsize=(8, 6.2), sharex=True, sharey=True, layout="constrained")
    colors = plt.get_cmap("cividis").with_extremes(bad="red")
    for ax, (name, values) in zip(axes.ravel(), errors_of.items()):
        logs = np.log10(
            np.maximum(values, 10.0 ** LEVELS[0]),
            where=np.isfinite(values),
            out=np.full_like(values, np.nan),
        )
        shown = ax.pcolormesh(
            w_axis,
            z_axis,
            np.ma.masked_invalid(logs),
            cmap=colors,
            vmin=LEVELS[0],
            vmax=LEVELS[1],
            rasterized=True,
        )
        ax.set(xscale="log", yscale="log")
        ax.set_title(name, fontsize=11)
        ax.set_xticks([1e-12, 1e-6, 1, 1e6])
    fig.supxlabel("bin width q/σ")
    fig.supylabel("distance |x − μ|/σ")
    fig.colorbar(
        shown, ax=axes, location="right", shrink=0.8, label="log10 of the error", extend="both"
    )
    relative = "relative above 1e-6 bits" if what == "bits" else "relative to the larger slope"
    finish(
        fig,
        path,
        f"float64, error of the {what} ({relative}); red: infinite or not a number\nreference: quadrature",
    )


def draw_curves(path, z_axis, w_axis, maps):
    """Error of the bits along distance at q = sigma and along width at a distance of one sigma."""
    fig, panels = figure(2, (8, 5.8), sharey=True)
    row, column = (
        int(np.abs(np.log(axis)).argmin()) for axis in (z_axis, w_axis)
    )  # of 1 on either axis
    for (name, dtype), (bits, _) in maps.items():
        color, style = COLORS[list(FORMULAS).index(name)], "--" if dtype == "float32" else "-"
        for ax, axis, values in zip(panels, (z_axis, w_axis), (bits[:, column], bits[row])):
            ax.plot(
                axis,
                np.where(np.isfinite(values), np.maximum(values, 1e-17), np.nan),
                style,
                color=color,
                label=name if dtype == "float64" else None,
            )
            ax.plot(
                axis[~np.isfinite(values)],
                np.full((~np.isfinite(values)).sum(), 30.0),
                "x",
                color="red",
                markersize=4,
            )
            ax.set(xscale="log", yscale="log")
            ax.grid(True, color="#dddddd", linewidth=0.7)
    panels[0].set(xlabel="distance |x − μ|/σ, q = σ", ylabel="error of the bits, relative")
    panels[1].set(xlabel="bin width q/σ, distance 1 σ")
    fig.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        fontsize=10,
        frameon=False,
    )
    finish(
        fig,
        path,
        "solid float64, dashed float32; red crosses: infinite or not a number\nreference: quadrature",
    )


def read(rows, maps):
    """What the numbers say."""
    near, far = REACHES
    stable, literal = (
        at(rows, method=name, knob="float64", reach=near) for name in ("stable", "literal")
    )
    stable32 = at(rows, method="stable", knob="float32", reach=far)
    failed = {
        name: 100 * float(np.mean(~np.isfinite(bits)))
        for (name, dtype), (bits, _) in maps.items()
        if dtype == "float64"
    }
    wrong = {
        name: 100 * float(np.mean(~(bits <= 0.01)))
        for (name, dtype), (bits, _) in maps.items()
        if dtype == "float64"
    }
    bits, gradient = maps["stable", "float64"]
    return (
        f"`stable` takes {stable['ns']:.3g} ns a value within {near} σ, {stable['ns'] / literal['ns']:.2g} times the "
        f"literal formula's {literal['ns']:.3g} ns, and computes {stable['special_per_value']:.3g} instead of "
        f"{literal['special_per_value']:.3g} special functions a value. Over the whole plane the literal formula is "
        f"not finite in {failed['literal']:.0f} % of the points and more than 1 % wrong in {wrong['literal']:.0f} %; "
        f"HAC's floor leaves {failed['HAC, floor 1e-6']:.0f} % not finite and {wrong['HAC, floor 1e-6']:.0f} % wrong, "
        f"the tail-symmetric formula {failed['tail-symmetric']:.0f} and {wrong['tail-symmetric']:.0f} %, the log "
        f"domain {failed['log domain']:.0f} and {wrong['log domain']:.0f} %. The largest error of `stable` there is "
        f"{number(bits.max())} in the bits and {number(gradient.max())} in the gradient; with float32 inputs and "
        f"outputs {number(stable32['bits_error'])} within {far} σ."
    )
