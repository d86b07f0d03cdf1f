"""Hard cases: inputs for which a formula that is right on paper fails, and what ours returns.

A table has the result of the literal formula, ours, the true value, errors and a verdict for each
case. The stability map shows the error of formulas for Eq. (11) over the distance, above and below
the mean, and the bin width.

Inputs, cotangents and true values are those of the published vector with the same id.
`hard_cases.json` adds one line per case:

    id          "H-R1.6sigma": the group H-R1, then which of its inputs
    equation    its key in the table of equations
    says        what is hard, and what the column "literal" shows
    shown       (array, index) of the number that the table shows
    literal     the result of the printed formula, or of the usual shortcut, in either precision
    bounds      [largest error of outputs, of gradients or null] in either precision, relative
    each        outputs relative to each number, otherwise to the largest of the array
    exact       [tensor, index, number] if the vectors contain this project's own gradient: the
                number with the largest error, from 50 digits; null is not compared

In a checkout, `python -m tests.workshop.hard_cases.publish` writes the file.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np

from ...oracle import published
from ...oracle.compare import cast
from ...report.figures import figure_style, save_figure, subplots
from ...splatting.table import EQUATIONS
from .. import StudyError
from ..accuracy import formulas
from ..writer import group_rows, text_table

FILE = Path(__file__).with_name("hard_cases.json")
SMALLEST = 1e-44  # differences below are no errors: float32 cannot represent them
DTYPES = ("float64", "float32")
COLUMNS = {
    "case": "{id}",
    "equation": "{equation}",
    "dtype": "{dtype}",
    "literal": "{literal}",
    "ours": "{ours}",
    "true": "{true}",
    "error": "{error}",
    "gradient": "{grad_error}",
    "verdict": "{verdict}",
}
# Of the map:
DISTANCES, WIDTHS = (-2, 3), (-12, 6)  # log10 of the limits of |x - mu| / sigma and q / sigma
TICKS = (-1000, -10, -0.1, 0.1, 10, 1000)  # of the distance
LEVELS = (-16, 0)  # log10 of the errors that the colours distinguish


# --- the table ------------------------------------------------------------------------------------
@cache
def hard_cases():
    """Return {id: case}, in the order of the table."""
    cases = json.loads(FILE.read_text(encoding="utf-8"))
    keys = {case["equation"] for case in cases}
    vectors = {vector.id: vector for key in keys for vector in published.cases(key)}
    return {case["id"]: with_arrays(case, vectors) for case in cases}


def with_arrays(case, vectors):
    """Return a case with its inputs, cotangents and true values, {"x": array, "x_a_bar": array}."""
    vector = vectors[f"{case['equation']}/{case['id']}"]
    tensors = dict(vector.tensors)
    for name, index, value in case.get("exact", []):
        tensors[name] = tensors[name].copy()
        tensors[name][tuple(index)] = np.nan if value is None else value
    true = published.unflatten(tensors, "out.")
    for name, a in published.unflatten(tensors, "in_bar.").items():
        true[name + "_bar"] = a
    return {**case, "inputs": vector.inputs(), "cotangents": vector.cotangents(), "true": true}


def rows(only=None):
    """Run all cases in both precisions, or only the case or the group of cases `only`.

    Return a list of dictionaries for JSON with id, equation, says, dtype and the fields of
    `measure`. Infinities and NaN are text.
    """
    cases = hard_cases().values()
    wanted = [case for case in cases if only is None or f"{case['id']}.".startswith(f"{only}.")]
    if not wanted:
        raise StudyError(f"--only {only}: expected a case, or its beginning up to a dot, like H-R1")
    return [
        {
            **{name: case[name] for name in ("id", "equation", "says")},
            "dtype": dtype,
            **measure(case, dtype),
        }
        for case in wanted
        for dtype in DTYPES
    ]


def measure(case, dtype):
    """Return what an equation returns on a case in one precision, its errors and a verdict.

    Errors are relative; one that is NaN fails, and None means that there is no gradient.
    """
    equation, true, which = EQUATIONS[case["equation"]], case["true"], DTYPES.index(dtype)
    outputs, pullback = equation.vjp(**cast(case["inputs"], dtype))
    gradients = pullback(**cast(case["cotangents"], dtype)) if equation.gradients else {}
    bars = {name + "_bar": a for name, a in gradients.items()}
    (name, index), (bound, grad_bound) = case["shown"], case["bounds"][which]
    error, grad_error = worst(outputs, true, case["each"]), worst(bars, true, False)
    good = error <= bound and (grad_error is None or grad_error <= grad_bound)
    return {
        "literal": case["literal"][which],
        "ours": json_number(pick({**outputs, **bars}[name], index)),
        "true": json_number(pick(true[name], index)),
        "error": json_number(error),
        "grad_error": json_number(grad_error),
        "bound": bound,
        "grad_bound": None if grad_error is None else grad_bound,
        "verdict": "ok" if good else "fails",
    }


def worst(arrays, true, each):
    """Return the largest error of all arrays with true values; None without any."""
    return max(
        (relative(a, true[name], each) for name, a in arrays.items() if name in true), default=None
    )


def pick(values, index):
    """Return one number of an array, or of a list of arrays: the first index says of which."""
    if isinstance(values, list):
        values, index = values[index[0]], index[1:]
    return np.asarray(values)[tuple(index)]


def json_number(value):
    """Return a number that JSON can express: infinities and NaN become text."""
    value = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value


def relative(got, want, each):
    """Return the largest error, relative to each number or to the largest of its array.

    If the true value is 0 the error is absolute; if it is NaN there is nothing to compare.
    """
    if isinstance(got, list):
        return max((relative(g, w, each) for g, w in zip(got, want, strict=True)), default=0.0)
    got, want = np.ravel(got).astype(float), np.ravel(want).astype(float)
    compared = ~np.isnan(want)
    got, want = got[compared], want[compared]
    gap = np.where(got == want, 0, np.abs(got - want))
    gap[gap < SMALLEST] = 0
    scale = np.abs(want) if each else np.abs(want).max(initial=0)
    errors = gap / np.where(scale > 0, scale, 1)
    return float(np.nan_to_num(errors, nan=np.inf, posinf=np.inf).max(initial=0))


def to_text(rows, every=True):
    """Return the verdict as text, the rows that fail, a table of every row, and what it shows.

    Unless `every`, the table has one row per equation: the one with the largest error.
    """
    failed = [f"  {row['id']} {row['dtype']}" for row in rows if row["verdict"] == "fails"]
    head = f"{len(failed)} of {len(rows)} rows are beyond their error bounds"
    if not every:
        rows = [
            max(group, key=lambda row: float(row["error"]))
            for group in group_rows(rows, "equation").values()
        ]
        head += "; below, the worst row of each equation (--all prints every row)"
    shown = [{name: as_text(name, value) for name, value in row.items()} for row in rows]
    end = (
        "literal: the printed formula or the usual shortcut; error, gradient: largest relative "
        "errors of our outputs and gradients"
    )
    return "\n".join([head, *failed, "", *text_table(COLUMNS, shown), "", end])


def as_text(name, value):
    """Return a value of a row as text: numbers of at most 16 characters, errors of two digits."""
    digits = ".1e" if name in ("error", "grad_error") else ".8g"
    text = f"{value:{digits}}" if isinstance(value, float) else "" if value is None else str(value)
    return text[:15] + "~" if name in ("literal", "ours", "true") and len(text) > 16 else text


# --- the map --------------------------------------------------------------------------------------
def plane():
    """Return two axes of numbers of float32: distances, of both signs, and widths."""
    above, widths = (
        np.logspace(*limits, 73).astype(np.float32).astype(float) for limits in (DISTANCES, WIDTHS)
    )
    return np.append(-above[::-1], above), widths


def maps(named):
    """Return log10 of the errors of {name: formula}, {(name, dtype): array (distances, widths)}.

    Errors are relative above 1e-6 bits, and infinite if a formula gives NaN or infinity.
    """
    z, w = np.meshgrid(*plane(), indexing="ij")
    errors = {}
    for dtype in DTYPES:
        for name, formula in named.items():
            error, _ = formulas.errors(formula, z.ravel(), w.ravel(), dtype)
            log = np.log10(np.maximum(error, 10.0 ** LEVELS[0]))
            errors[name, dtype] = np.where(np.isfinite(error), log, np.inf).reshape(z.shape)
    return errors


def draw_maps(figure, axes, errors, location="right"):
    """Draw `maps` into axes; infinite is red. All share one colour bar."""
    from matplotlib import colormaps

    distances, widths = plane()
    colors, (low, high) = colormaps["viridis"].with_extremes(over="red"), LEVELS
    for ax, ((name, dtype), log) in zip(axes.ravel(), errors.items()):
        # An infinite error is above the levels, every finite one at or below them.
        shown = np.where(np.isinf(log), high + 1, np.minimum(log, high))
        mesh = ax.pcolormesh(
            widths, distances, shown, cmap=colors, vmin=low, vmax=high, rasterized=True
        )
        ax.set(xscale="log", xticks=10.0 ** np.arange(-10, 6, 5))
        ax.set_yscale("symlog", linthresh=distances[distances > 0][0], linscale=0.1)
        ax.set(yticks=TICKS, yticklabels=map("{:g}".format, TICKS))
        ax.set(xlim=widths[[0, -1]], ylim=distances[[0, -1]])
        ax.minorticks_off()
        ax.grid(False)
        ax.set_title(f"{name}, {dtype}")
    figure.supxlabel("bin width q/σ")
    figure.supylabel("distance (x − μ)/σ, above and below the mean")
    label = "log10 of the error of the bits"
    figure.colorbar(mesh, ax=axes, location=location, shrink=0.8, extend="both", label=label)


@figure_style({"font.size": 10.5, "axes.titlesize": 10.5, "figure.dpi": 200})
def draw_map(path):
    """Draw the maps of the printed formula and of ours."""
    errors = maps({name: formulas.FORMULAS[name] for name in ("as printed", "ours")})
    figure, axes = subplots(2, 2, figsize=(4.2, 6.6), sharex=True, sharey=True)
    draw_maps(figure, axes, errors, "top")
    figure.suptitle("Bits of Eq. (11): red is infinite or NaN", fontweight="bold", fontsize=10.5)
    save_figure(figure, path)
