"""Study 7, gradients: difference quotients and the complex step against the manual backward."""

from functools import partial

import numpy as np

from ...oracle.precision import cast
from ...table import EQUATIONS
from ..bench import relative_error
from ..clock import alternate, compare, stretch_of
from ..random_inputs import random_anchor_network, random_splats
from .diagram import (
    Axes,
    Finding,
    at,
    draw_panels,
    finish,
    legend_below,
    lines,
    number,
    select,
    table,
)

# The inputs that are differentiated: those whose widest step stays inside the equation's domain.
SUBJECTS = {
    "opacity": ("f_a", "delta_vc", "d_vc"),
    "compositing": ("mean2d", "conic", "alpha", "color", "background"),
    "likelihood": ("f_noisy", "mu"),
}
COMPLEX_SAFE = ("opacity", "compositing")  # the code of likelihood takes magnitudes and signs
TOLERANCE = 1e-7  # relative: what the tests allow difference quotients
METHODS = {  # evaluations at x + h shift e_i, and their weights over h
    "forward": ((1, 0), (1, -1)),
    "central": ((1, -1), (0.5, -0.5)),
    "fourth order": ((1, -1, 2, -2), (2 / 3, -2 / 3, -1 / 12, 1 / 12)),
    "complex step": ((1j,), (1,)),
}
DEEPEST = {"float32": 7, "float64": 14, "complex step": 20}  # the smallest step is 10 to minus this
REFERENCE = "the manual backward in float64"


def inputs_of(key):
    """The inputs at which an equation is differentiated."""
    if key == "opacity":
        return random_anchor_network(np.random.default_rng(3))
    if key == "compositing":
        return dict(
            **random_splats(np.random.default_rng(33), 7, 5, 6),
            background=np.array([0.9, 0.5, 0.2]),
            height=5,
            width=6,
            occlusion=True,
        )
    rng, shape = np.random.default_rng(16), (5, 4)
    sigma = rng.lognormal(size=shape)
    mu, q = rng.normal(size=shape), sigma * rng.uniform(0.2, 3, size=shape)
    return dict(f_noisy=mu + sigma * rng.normal(size=shape), mu=mu, sigma=sigma, q=q)


class Loss:
    """<cotangents, outputs> of one equation as a function of one flat vector of its inputs."""

    def __init__(self, key, seed=0):
        self.equation, self.names, self.inputs = EQUATIONS[key], SUBJECTS[key], inputs_of(key)
        self.x = np.concatenate([self.inputs[name].ravel() for name in self.names])
        rng, outputs = np.random.default_rng(seed), self.equation(**self.inputs)
        self.bars = {f"{name}_bar": rng.normal(size=a.shape) for name, a in outputs.items()}
        self.evaluations = 0

    def given(self, x):
        """All inputs of the equation, in the precision of the flat vector."""
        arrays = [self.inputs[name] for name in self.names]
        parts = np.split(x, np.cumsum([a.size for a in arrays])[:-1])
        moved = {name: part.reshape(a.shape) for name, part, a in zip(self.names, parts, arrays)}
        return {**cast(self.inputs, x.dtype), **moved}

    def __call__(self, x):
        self.evaluations += 1
        outputs = self.equation(**self.given(x))
        return sum(np.vdot(bar, outputs[name[:-4]]) for name, bar in self.bars.items())

    def backward(self, x):
        """The manual gradient, flat."""
        _, pullback = self.equation.vjp(**self.given(x))
        gradients = pullback(**cast(self.bars, x.dtype))
        return np.concatenate([gradients[name].ravel() for name in self.names])


def quotients(loss, x, h, method):
    """The whole gradient by one method; a forward difference shares the value in the middle."""
    if method == "complex step":
        x = x.astype(complex)
        return np.array([loss(bumped(x, i, 1j * h)).imag / h for i in range(len(x))])
    shifts, weights = METHODS[method]
    middle = loss(x) if 0 in shifts else None
    gradient = np.zeros(len(x))
    for i in range(len(x)):
        for shift, weight in zip(shifts, weights):
            value = loss(bumped(x, i, x.dtype.type(shift * h))) if shift else middle
            gradient[i] += weight * float(value) / h
    return gradient


def bumped(x, i, step):
    """A copy of x with one element moved."""
    moved = x.copy()
    moved[i] += step
    return moved


def sweep(key, quick):
    """Rows of one equation: the error of every method at every step."""
    loss, rows = Loss(key), []
    truth = loss.backward(loss.x)
    runs = [
        (method, dtype, DEEPEST[dtype])
        for method in METHODS
        for dtype in ("float64", "float32")
        if method != "complex step"
    ]
    if key in COMPLEX_SAFE:
        runs.append(("complex step", "float64", DEEPEST["complex step"]))
    for method, dtype, deepest in runs:
        for exponent in np.arange(1, deepest + 0.1, 1.0 if quick else 0.5):
            x, h = loss.x.astype(dtype), 10.0**-exponent
            loss.evaluations = 0
            error = relative_error(quotients(loss, x, h, method), truth)
            rows.append(
                {
                    "equation": key,
                    "method": method,
                    "dtype": dtype,
                    "step": h,
                    "inputs": len(x),
                    "evaluations": loss.evaluations,
                    "error": error,
                }
            )
    return rows


def best(rows, **wanted):
    """The row with the smallest error among those with these values."""
    return min(select(rows, **wanted), key=lambda row: row["error"])


def cost_rows(rows, repeats):
    """Every method at its best step in float64, timed beside the manual backward.

    The error of the manual backward is its distance to the method with the smallest error.
    """
    pairs = dict.fromkeys((row["equation"], row["method"]) for row in rows)
    found = [best(rows, equation=key, method=name, dtype="float64") for key, name in pairs]
    losses, runs = {key: Loss(key) for key in SUBJECTS}, {}
    for row in found:
        loss = losses[row["equation"]]
        runs[row["equation"], row["method"]] = partial(
            quotients, loss, loss.x, row["step"], row["method"]
        )
    manual = {"method": "manual backward", "step": 0.0, "evaluations": 1}
    found += [{**best(found, equation=key), **manual} for key in SUBJECTS]
    runs |= {
        (key, manual["method"]): partial(loss.backward, loss.x) for key, loss in losses.items()
    }
    times = alternate(runs, repeats)
    return [{**row, **times[row["equation"], row["method"]].columns()} for row in found]


def run(folder, quick, progress, jobs=1):
    rows = []
    for key in SUBJECTS:
        progress(f"gradients: {key}")
        rows += sweep(key, quick)
    repeats = 3 if quick else 5
    costs = cost_rows(rows, repeats)
    draw_curves(folder / "gradients.png", rows)
    draw_cost(folder / "gradients_cost.png", costs)
    return Finding(
        "gradients",
        "Gradients",
        REFERENCE,
        [
            (
                "gradients.png",
                "Error of difference quotients over the step: truncation grows to the right, "
                "rounding to the left.",
            ),
            (
                "gradients_cost.png",
                "Every method at its best step: error against the time of a whole gradient.",
            ),
        ],
        [table(folder, "gradients", rows), table(folder, "gradients_cost", costs)],
        read(rows, costs),
        f"median and quartiles of {repeats} alternating repeats of a whole gradient",
        stretch_of(costs),
    )


def draw_curves(path, rows):
    axes = Axes("step", "error", "step h", "relative L2 error")
    double = select(rows, dtype="float64")
    contents = [(key, select(double, equation=key), axes) for key in SUBJECTS]
    fig, panels = draw_panels(contents, (8, 5.8), sharey=True, label=False, markersize=4)
    dashed = dict(linestyle="--", marker="", alpha=0.8)
    for ax, key in zip(panels, SUBJECTS):
        own = select(rows, equation=key, dtype="float32")
        lines(ax, own, axes._replace(y_label=ax.get_ylabel()), label=False, **dashed)
        ax.axhline(TOLERANCE, color="gray", linestyle=":")
    legend_below(fig, panels[0], 4, count=len(METHODS))
    title = f"solid float64, dashed float32, dotted the tests' tolerance {TOLERANCE:g}"
    finish(fig, path, f"{title}\nreference: {REFERENCE}")


def draw_cost(path, costs):
    axes = Axes("ms", "error", "processor time (ms)", "relative L2 error")
    shown = [{**row, "knob": f"{row['evaluations']}×"} for row in costs]
    contents = []
    for key in SUBJECTS:
        own = select(shown, equation=key)
        contents.append((f"{key}, {own[0]['inputs']} inputs", own, axes))
    fig, panels = draw_panels(contents, (8, 5.4), margins=(0.35, None), sharey=True)
    legend_below(fig, panels[0], 3)
    finish(
        fig,
        path,
        "a whole gradient at the best step, evaluations of the equation labelled\n"
        "reference: the manual backward, drawn at its distance to the best method",
    )


def read(rows, costs):
    """What the numbers say."""
    key = "compositing"
    by_hand, forward, central, fourth, exact = (
        at(costs, equation=key, method=method)
        for method in ("manual backward", "forward", "central", "fourth order", "complex step")
    )
    single = best(rows, equation=key, method="central", dtype="float32")
    times = compare("the fourth-order formula", fourth, "the manual backward", by_hand)
    worst = max(row["error"] for row in select(costs, method="fourth order"))
    return (
        f"For {key} with {by_hand['inputs']} inputs, the error of the best forward difference is "
        f"{number(forward['error'])} (h = {forward['step']:.0e}), of the central one "
        f"{number(central['error'])} (h = {central['step']:.0e}), of the fourth-order one "
        f"{number(fourth['error'])} (h = {fourth['step']:.0e}) and of the complex step "
        f"{number(exact['error'])}; in float32 the best central difference has "
        f"{number(single['error'])}. A whole gradient by the fourth-order formula needs "
        f"{fourth['evaluations']} evaluations. {times} The tests' tolerance of "
        f"{TOLERANCE:g} is {number(TOLERANCE / worst)} times the worst of the "
        f"fourth-order formula's best errors over the {len(SUBJECTS)} equations."
    )
