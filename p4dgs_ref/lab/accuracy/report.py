"""The page `accuracy.md`: one table of all knobs, one picture, then a figure for each knob."""

import os
import platform
import sys
import time
from pathlib import Path

import numpy as np
import scipy

from ...report.figures import write_csv
from ..clock import disturbance, stretch_of
from .diagram import draw, lines_of
from .harness import (
    ITERATIONS,
    NOT_TOLD,
    ORDER,
    QUICK_ITERATIONS,
    SCENE,
    SEEDS,
    finding,
    loss,
    lost,
    measure_file,
    measure_forms,
    measure_trainings,
    pays_from,
    saved,
    scene_of,
    trained,
)
from .knobs import HARNESSES, chosen, file_name

PAGE = "accuracy.md"
SPENT = {
    "ms": "processor time (ms, median and quartiles)",
    "seconds": "training (processor seconds)",
    "bytes": "file (bytes)",
}
# What the first picture shows: the unit of losses, the loss that is enough, and the smallest one
# that is drawn; smaller ones are drawn there.
OVERVIEW = {
    "formula": ("error, in multiples of enough", 1.0, 1e-6),
    "file": ("PSNR lost (dB)", 0.1, 0.01),
    "training": ("PSNR lost (dB)", 0.1, 0.01),
}


def run(names, folder, quick=False, progress=lambda line: None, jobs=1):
    """Turn knobs and write accuracy.md, its figures and their tables into an existing folder.

    `names` are knobs or harnesses, or None for all. `quick` takes about a minute instead of ten.
    Independent trainings run in `jobs` processes; times are taken in this one, with nothing
    beside it. Returns plain values for JSON. Raises ValueError for an unknown name.
    """
    knobs, folder, start = chosen(names), Path(folder), time.perf_counter()
    rows, spread = measure(knobs, quick, progress, jobs)
    findings, sections = [], {harness: [] for harness in HARNESSES}
    for knob in knobs:
        own, name = rows[knob.name], file_name(knob)
        found = finding(knob, own, quick, spread if knob.harness == "training" else 0.0)
        if found["verdict"] != NOT_TOLD:
            draw_knob(folder / f"{name}.png", knob, own)
            if knob.name == "context":
                found["verdict"] = f"below {pays_from(own):,.0f} anchors"
        write_csv(folder / f"{name}.csv", own)
        findings.append(found)
        sections[knob.harness].append(section(knob, own, found))
    findings.sort(key=lambda found: (rank(found), -found["factor"]))
    write_csv(folder / "knobs.csv", findings)
    draw_all(folder / "knobs.png", knobs, rows, quick)
    timed = [stretch_of(own) for own in rows.values() if "stretch" in own[0]]
    result = {
        "machine": machine(),
        "quick": quick,
        "seconds": time.perf_counter() - start,
        "stretch": max(timed, default=1.0),
        "seeds_db": spread,
        "knobs": findings,
        "rows": rows,
    }
    (folder / PAGE).write_text(page(result, sections), encoding="utf-8")
    return result


def measure(knobs, quick, progress, jobs):
    """The rows of all knobs, {name: rows}, and how far the PSNR of seeds differs."""
    of = {name: [knob for knob in knobs if knob.harness == name] for name in HARNESSES}
    rows, spread = {}, 0.0
    for knob in of["formula"]:
        progress(f"formula: {knob.name}")
        rows[knob.name] = measure_forms(knob.values(quick), 3 if quick else 5)
    if of["training"]:
        found, spread = measure_trainings(of["training"], quick, progress, jobs, ITERATIONS)
        rows |= found
    if of["file"]:
        progress("file: the model that is written")
        model = trained({}, QUICK_ITERATIONS if quick else ITERATIONS)
        rows |= {knob.name: measure_file(knob, model, scene_of()) for knob in of["file"]}
    return rows, spread


def rank(found):
    """The place of a verdict in the table."""
    return ORDER.index(found["verdict"]) if found["verdict"] in ORDER else 0


# --- figures -------------------------------------------------------------------------------------
def draw_knob(path, knob, rows):
    """The figure of a knob: what every value loses, over what it spends."""
    shown = [{**row, "loss": loss(row, rows[0])} for row in rows]
    properties = dict(xscale="log", xlabel=SPENT[knob.spent], ylabel="PSNR lost (dB)")
    if "error" in rows[0]:
        properties |= dict(yscale="log", ylabel=f"error {knob.unit}")
    draw(path, [(knob.changes, shown, knob.spent, "loss", knob.enough, properties)], (8, 4.4))


def draw_all(path, knobs, rows, quick):
    """Every knob as a line: what it loses, over how many times as cheap it is."""
    panels = []
    for harness in ("formula",) if quick else HARNESSES:
        shown, (label, enough, least) = [], OVERVIEW[harness]
        for knob in (knob for knob in knobs if knob.harness == harness):
            unit = knob.enough if harness == "formula" else 1.0  # errors have different units
            dear, *_ = own = next(iter(lines_of(rows[knob.name]).values()))
            for row in own:
                place = {"times": dear[knob.spent] / row[knob.spent]}
                place["loss"] = max(loss(row, dear) / unit, least)
                shown.append({"line": knob.name, **place})
        properties = dict(xscale="log", yscale="log", ylabel=label)
        properties["xlabel"] = "times as cheap, in bytes or time"
        if shown:
            panels.append((HARNESSES[harness], shown, "times", "loss", enough, properties))
    if panels:
        size = 9, 4.4 * len(panels)
        draw(path, panels, size, label=False, loc="center left", bbox_to_anchor=(1.01, 0.5))


# --- text ----------------------------------------------------------------------------------------
def section(knob, rows, found):
    """The part of the page about one knob: two sentences, the figure and its numbers."""
    dear, *_, last = next(iter(lines_of(rows).values()))
    about = "has an error of" if "error" in dear else "changes PSNR by"
    name, figure = file_name(knob), ""
    says = f"`{found['cheap']}` instead of `{found['dear']}` {about} "
    says += f"{found['lost']} ({found['saved']})"
    if found["verdict"] != NOT_TOLD:
        figure = f"![{knob.name}]({name}.png)\n\n"
        if last["value"] != found["cheap"]:
            says += f"; `{last['value']}` {about} {lost(knob, last, dear)} ({saved(last, dear)})"
    return f"""### {knob.name}

{knob.changes} ({knob.set_by}). {says}.

{figure}Numbers: [{name}.csv]({name}.csv).
"""


def table(findings):
    """The table of all knobs as lines of Markdown."""
    head = ("knob", "dear → cheap", "what is lost", "what is saved", "verdict")
    cells = [
        (f["knob"], f"{f['dear']} → {f['cheap']}", f["lost"], f["saved"], f["verdict"])
        for f in findings
    ]
    widths = [max(map(len, column)) for column in zip(head, *cells)]
    rows = [head, ["-" * width for width in widths], *cells]
    return ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in rows]


def reading(result):
    """How the table is to be read, in words."""
    says = (
        "A row is the step of a knob that saves most and loses no more than is enough: a hundredth "
        "of the bits, half a step of an 8-bit picture, a thousandth of a gradient, 0.1 dB. Where "
        "there is none, it is the first step that saves anything. Rows are sorted by their verdict "
        "and then by how many times as cheap they are."
    )
    if result["quick"]:
        return f"{says} With --quick no model is trained far enough to tell what it loses."
    return (
        f"{says} Files and trainings are those of `tiny` on `{SCENE}` with {ITERATIONS:,} "
        f"iterations, each trained once. Between {SEEDS} seeds PSNR differs by "
        f"{result['seeds_db']:.2f} dB, so smaller losses of a training are not told for certain."
    )


def page(result, sections):
    """The page as Markdown: the table, the picture, then the sections of every harness."""
    about = "; ".join(f"{name} {value}" for name, value in result["machine"].items())
    disturbed = disturbance(result["stretch"])
    parts = [
        "# What accuracy costs in time and bytes\n",
        f"{disturbed}\n" if disturbed else "",
        "\n".join(table(result["knobs"])) + "\n",
        reading(result) + "\n",
        "![All knobs](knobs.png)\n",
        f"Measured on: {about}. The run took {result['seconds']:.0f} seconds. Times are processor "
        "times of one process, taken in turn; a bar goes from quartile to quartile. A dotted line "
        "is the loss that is enough.\n",
    ]
    for harness, title in HARNESSES.items():
        if sections[harness]:
            parts += [f"## {title}\n", *sections[harness]]
    return "\n".join(part for part in parts if part)


def describe(result, folder):
    """The text that the command prints: the table, and where the page is."""
    end = f"{Path(folder) / PAGE}: {result['seconds']:.0f} s in all. "
    end += disturbance(result["stretch"])
    return "\n".join([*table(result["knobs"]), "", end.rstrip()])


def machine():
    """The parts of the machine that times depend on, {name: text}."""
    threads = os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS")
    return {
        "CPU": processor(),
        "cores": str(os.cpu_count()),
        "Python": sys.version.split()[0],
        "NumPy": np.__version__,
        "SciPy": scipy.__version__,
        "BLAS threads": threads or "not set",
    }


def processor():
    """The processor's name according to the operating system."""
    try:
        with open(os.path.join(os.sep, "proc", "cpuinfo"), encoding="utf-8") as file:
            names = (line.split(":", 1)[1] for line in file if line.startswith("model name"))
            return next(names).strip()
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
