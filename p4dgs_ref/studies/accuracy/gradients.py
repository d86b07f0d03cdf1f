"""Study 7, gradients: difference quotients and the complex step against the manual backward, over the step and in time."""

import numpy as np

from ...equations import EQUATIONS
from ...splatting import compositing
from .diagram import Axes, Finding, at, figure, finish, lines, number, table
from .timing import alternate

# The inputs that are differentiated: those at which the widest step stays inside the equation's domain.
SUBJECTS = {
    "opacity": ("f_a", "delta_vc", "d_vc"),
    "compositing": ("mean2d", "conic", "alpha", "color", "background"),
    "likelihood": ("f_noisy", "mu"),
}
COMPLEX_SAFE = ("opacity", "compositing")  # the code of likelihood takes magnitudes and signs
TOLERANCE = 1e-7  # relative, what the suite grants its difference quotients
METHODS = {  # evaluations at x + h shift e_i, and their weights over h
    "forward": ((1, 0), (1, -1)),
    "central": ((1, -1), (0.5, -0.5)),
    "fourth order": ((1, -1, 2, -2), (2 / 3, -2 / 3, -1 / 12, 1 / 12)),
    "complex step": ((1j,), (1,)),
}


class Loss:
    """<cotangents, outputs> of one equation's ordinary case as a function of one flat vector of its inputs."""

    def __init__(self, key, seed=0):
        self.equation = EQUATIONS[key]
        self.inputs = next(case.inputs for case in self.equation.cases() if case.name == "ordinary")
        self.names = SUBJECTS[key]
        self.x = np.concatenate([self.inputs[name].ravel() for name in self.names])
        out, rng = self.equation(**self.inputs), np.random.default_rng(seed)
        self.bars = {f"{name}_bar": rng.normal(size=a.shape) for name, a in out._asdict().items()}
        self.evaluations = 0

    def given(self, x):
        """All inputs with the flat vector's precision; lists of arrays too."""
        parts = np.split(x, np.cumsum([self.inputs[name].size for name in self.names])[:-1])
        moved = {
            name: part.reshape(self.inputs[name].shape) for name, part in zip(self.names, parts)
        }
        return {
            name: moved.get(name, self.cast(value, x.dtype)) for name, value in self.inputs.items()
        }

    @staticmethod
    def cast(value, dtype):
        if isinstance(value, list):
            return [a.astype(dtype) for a in value]
        floats = isinstance(value, np.ndarray) and value.dtype.kind == "f"
        return value.astype(dtype) if floats else value

    def __call__(self, x):
        self.evaluations += 1
        out = self.equation(**self.given(x))._asdict()
        return sum(np.dot(bar.ravel(), out[name[:-4]].ravel()) for name, bar in self.bars.items())

    def backward(self, x):
        """The manual gradient, flat."""
        _, res = self.equation.forward(**self.given(x))
        gradients = self.equation.backward(
            res, **{name: bar.astype(x.dtype) for name, bar in self.bars.items()}
        )
        return np.concatenate([gradients[name].ravel() for name in self.names])


def quotients(loss, x, h, method):
    """The whole gradient by one method (n,); the middle of a forward difference is evaluated once."""
    shifts, weights = METHODS[method]
    if method == "complex step":
        return np.array(
            [loss(bumped(x.astype(complex), i, 1j * h)).imag / h for i in range(len(x))]
        )
    middle = loss(x) if 0 in shifts else None
    gradient = np.zeros(len(x))
    for i in range(len(x)):
        for shift, weight in zip(shifts, weights):
            gradient[i] += (
                weight
                * float(middle if shift == 0 else loss(bumped(x, i, x.dtype.type(shift * h))))
                / h
            )
    return gradient


def bumped(x, i, step):
    moved = x.copy()
    moved[i] += step
    return moved


def sweep(key, quick):
    """Rows of one equation: error of every method at every step, evaluations of a whole gradient."""
    loss, rows = Loss(key), []
    truth = loss.backward(loss.x)
    for method in METHODS:
        if method == "complex step" and key not in COMPLEX_SAFE:
            continue
        for dtype in ("float64",) if method == "complex step" else ("float64", "float32"):
            deepest = {"float32": 7, "float64": 14}[dtype] if method != "complex step" else 20
            for exponent in np.arange(1, deepest + 0.1, 1.0 if quick else 0.5):
                x, h = loss.x.astype(dtype), 10.0**-exponent
                loss.evaluations = 0
                found = quotients(loss, x, h, method)
                rows.append(
                    {
                        "equation": key,
                        "method": method,
                        "dtype": dtype,
                        "step": h,
                        "inputs": len(x),
                        "evaluations": loss.evaluations,
                        "error": float(np.linalg.norm(found - truth) / np.linalg.norm(truth)),
                    }
                )
    return rows


def cost_rows(rows, repeats):
    """Every method at its best step in float64, timed beside forward and backward: error, evaluations, milliseconds."""
    best = {}
    for row in rows:
        key = row["equation"], row["method"]
        if row["dtype"] == "float64" and (key not in best or row["error"] < best[key]["error"]):
            best[key] = row
    losses = {key: Loss(key) for key in SUBJECTS}
    runs = {
        key: lambda row=row: quotients(
            losses[row["equation"]], losses[row["equation"]].x, row["step"], row["method"]
        )
        for key, row in best.items()
    }
    runs.update(
        {
            (key, "manual backward"): lambda loss=loss: loss.backward(loss.x)
            for key, loss in losses.items()
        }
    )
    ms = alternate(runs, repeats)
    found = [{**row, "ms": ms[key]} for key, row in best.items()]
    for (
        key,
        loss,
    ) in losses.items():  # the backward is judged by the method that is furthest from rounding
        judge = min((row for row in found if row["equation"] == key), key=lambda row: row["error"])
        found.append(
            {
                **judge,
                "method": "manual backward",
                "step": 0.0,
                "evaluations": 1,
                "ms": ms[key, "manual backward"],
            }
        )
    return found


def run(folder, quick, progress):
    assert compositing.compositing.key in EQUATIONS  # splatting declares itself when it is imported
    rows = []
    for key in SUBJECTS:
        progress(f"gradients: {key}")
        rows += sweep(key, quick)
    repeats = 3 if quick else 5
    costs = cost_rows(rows, repeats)
    files = [table(folder, "gradients", rows), table(folder, "gradients_cost", costs)]
    draw_curves(folder / "gradients.png", rows)
    draw_cost(folder / "gradients_cost.png", costs)
    figures = [
        (
            "gradients.png",
            "Error of difference quotients over the step: truncation to the right, rounding to the left.",
        ),
        (
            "gradients_cost.png",
            "Every method at its best step: error against the time of a whole gradient.",
        ),
    ]
    return Finding(
        "gradients",
        "Gradients",
        "the manual backward in float64",
        figures,
        files,
        read(rows, costs),
        f"median of {repeats} alternating repeats of a whole gradient",
    )


def draw_curves(path, rows):
    fig, axes = figure(len(SUBJECTS), (8, 5.8), sharey=True)
    for ax, key in zip(axes, SUBJECTS):
        for dtype in ("float64", "float32"):
            own = [row for row in rows if row["equation"] == key and row["dtype"] == dtype]
            before = len(ax.lines)
            lines(
                ax,
                own,
                Axes("step", "error", "step h", "relative L2 error" if ax is axes[0] else ""),
                label=False,
            )
            for line in ax.lines[before:]:
                line.set_markersize(4)
                if dtype == "float32":
                    line.set(linestyle="--", marker="", alpha=0.8)
        ax.axhline(TOLERANCE, color="gray", linestyle=":")
        ax.set_title(key)
    handles, labels = axes[0].get_legend_handles_labels()
    fig.legend(
        handles[: len(METHODS)],
        labels[: len(METHODS)],
        loc="outside lower center",
        ncols=4,
        fontsize=10,
        frameon=False,
    )
    finish(
        fig,
        path,
        f"solid float64, dashed float32, dotted the suite's {TOLERANCE:g}\nreference: the manual backward, float64",
    )


def draw_cost(path, costs):
    fig, axes = figure(len(SUBJECTS), (8, 5.4), sharey=True)
    for ax, key in zip(axes, SUBJECTS):
        own = [
            {**row, "evaluations": f"{row['evaluations']}×"}
            for row in costs
            if row["equation"] == key
        ]
        lines(
            ax,
            own,
            Axes("ms", "error", "time (ms)", "relative L2 error" if ax is axes[0] else ""),
            knob="evaluations",
            order=METHODS,
        )
        ax.set_title(f"{key}, {own[0]['inputs']} inputs")
        ax.margins(x=0.35)
    fig.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        fontsize=10,
        frameon=False,
    )
    finish(
        fig,
        path,
        "a whole gradient at the best step, evaluations of the equation labelled\n"
        "reference: the manual backward, which is itself drawn at its distance to the best method",
    )


def read(rows, costs):
    """What the numbers say."""

    def best(key, method):
        return at(costs, equation=key, method=method)

    key = "compositing"
    by_hand, forward, central, fourth, exact = (
        best(key, name)
        for name in ("manual backward", "forward", "central", "fourth order", "complex step")
    )
    single = min(
        (
            row
            for row in rows
            if (row["equation"], row["method"], row["dtype"]) == (key, "central", "float32")
        ),
        key=lambda row: row["error"],
    )
    worst = max(best(name, "fourth order")["error"] for name in SUBJECTS)
    return (
        f"For {key} with {by_hand['inputs']} inputs the best forward difference is {number(forward['error'])} off (h "
        f"= {forward['step']:.0e}), the central one {number(central['error'])} (h = {central['step']:.0e}), the "
        f"fourth-order one {number(fourth['error'])} (h = {fourth['step']:.0e}) and the complex step "
        f"{number(exact['error'])}; in float32 a central difference cannot do better than {number(single['error'])}. "
        f"The whole gradient costs {fourth['evaluations']} evaluations and {fourth['ms']:.3g} ms by the fourth-order "
        f"formula against {by_hand['ms']:.3g} ms by forward and backward. The suite's tolerance of {TOLERANCE:g} is "
        f"{number(TOLERANCE / worst)} times the worst best error of the fourth-order formula over the {len(SUBJECTS)} "
        "equations."
    )
