"""What the tutorials share: figures that are saved and shown, and exercises that are checked against the golden vectors."""

import inspect
import os
import sys
from pathlib import Path

import numpy as np

from ..oracle import published, vectors
from ..oracle.compare import compare, precision
from ..oracle.subjects import flatten

COLORS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
)  # Okabe and Ito: colour-blind-safe
STYLE = {
    "figure.figsize": (8, 4.5),
    "figure.dpi": 120,
    "font.size": 12,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.linewidth": 2,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
RESULTS = {}  # exercise -> solved; what a test reads after running a tutorial or its solutions


def pyplot():
    """matplotlib.pyplot in the tutorials' style; without a window unless the session is interactive."""
    import matplotlib

    if not interactive():
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(STYLE)
    plt.rcParams["axes.prop_cycle"] = plt.cycler(color=COLORS)
    return plt


def interactive():
    """Whether somebody looks: a notebook or an interactive prompt."""
    return hasattr(sys, "ps1") or "ipykernel" in sys.modules


def out():
    """The folder for pictures, `out` beside the tutorial that runs; P4DGS_TUTORIALS_OUT names another."""
    caller = next(
        (
            Path(f.filename)
            for f in inspect.stack()
            if Path(f.filename).parent.name in ("tutorials", "solutions")
        ),
        None,
    )
    folder = (
        os.environ.get("P4DGS_TUTORIALS_OUT") or (caller.parent if caller else Path.cwd()) / "out"
    )
    Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


def show(figure, name):
    """Save a figure as out/NAME.png and show it where somebody looks."""
    place = out() / f"{name}.png"
    figure.savefig(place, bbox_inches="tight")
    print(f"figure: {place.parent.name}/{place.name}")
    if interactive():
        figure.show()
    else:
        pyplot().close(figure)


# --- exercises ----------------------------------------------------------------------------------------------------
def golden(id):
    """The tensors of one case of the golden vectors: golden("offsets/ordinary")["out.x"]."""
    key, case = id.split("/")
    subject = next(s for s in vectors.read_manifest()["subjects"] if s["key"] == key)
    return next(c for c in published.read(subject) if c.name == case).tensors


def number(exercise, mine, want, digits=6):
    """An exercise whose answer is a number or an array; `mine` is None or Ellipsis until it is solved."""
    if mine is None or mine is Ellipsis:
        return _settle(exercise, "no answer yet")
    try:
        mine, want = np.asarray(mine, float), np.asarray(want, float)
    except (TypeError, ValueError):
        return _settle(exercise, "expected a number")
    if mine.shape != want.shape:
        return _settle(exercise, f"shape {mine.shape}, expected {want.shape}")
    off = np.abs(mine - want).max(initial=0)
    good = off <= 10.0**-digits * max(np.abs(want).max(initial=0), 1e-300)
    return _settle(exercise, "" if good else f"off by {off:.3g}, {digits} digits are expected")


def forward(exercise, mine, key):
    """An exercise that asks for a forward: `mine(**inputs)` gives the outputs as a dictionary, a tuple or one array."""

    def outputs(case):
        made = mine(**case.inputs())
        if hasattr(made, "_asdict"):
            made = made._asdict()
        names = list(dict.fromkeys(n.split(".")[1] for n in case.tensors if n.startswith("out.")))
        if not isinstance(made, dict):
            made = dict(zip(names, made if isinstance(made, tuple) else (made,)))
        return flatten(
            {n: made[n] if isinstance(made[n], list) else np.asarray(made[n]) for n in names},
            "out.",
        )

    return _against(exercise, key, outputs)


def backward(exercise, mine, key, *wanted):
    """An exercise that asks for a backward: `mine(inputs, cotangents)` gives {input: gradient}; `wanted` of them count."""

    def gradients(case):
        made = mine(case.inputs(), case.cotangents())
        names = wanted or dict.fromkeys(
            n.split(".")[1] for n in case.tensors if n.startswith("in_bar.")
        )
        return flatten(
            {n: made[n] if isinstance(made[n], list) else np.asarray(made[n]) for n in names},
            "in_bar.",
        )

    return _against(exercise, key, gradients)


def _against(exercise, key, answer):
    subject = next(s for s in vectors.read_manifest()["subjects"] if s["key"] == key)
    for case in published.read(subject):
        if case.record["result"] != "valid":
            continue
        try:
            with np.errstate(all="ignore"):
                got = answer(case)
        except NotImplementedError:
            return _settle(exercise, "no answer yet")
        except Exception as error:  # whatever the reader wrote
            return _settle(exercise, f"case {case.id}: {type(error).__name__}: {error}")
        asked = {n: a for n, a in case.tensors.items() if n in got or n.startswith("scale.")}
        found = compare(asked, got, case.tolerance(precision(got)) or case.tolerance("float64"))
        if found:
            return _settle(exercise, f"case {case.id}: {found[0].tensor}: {found[0].message}")
    return _settle(exercise, "")


def _settle(exercise, problem):
    """Remember and say how an exercise stands."""
    RESULTS[exercise] = not problem
    print(f"exercise {exercise}: " + (f"not solved: {problem}" if problem else "solved"))
    return not problem
