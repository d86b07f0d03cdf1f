"""The page `accuracy.md`: one table of all knobs, one picture, then a figure for each knob."""

import time
from pathlib import Path

from ...arithmetic import arithmetic
from ...report.figures import write_csv
from ..clock import disturbance, stretch_of
from .diagram import draw, lines_of
from .harness import (
    ITERATIONS,
    ORDER,
    SCENE,
    SEEDS,
    finding,
    loss,
    measure_file,
    measure_forms,
    measure_kernels,
    measure_trainings,
    pays_from,
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
    "kernels": ("numbers that differ, in multiples of enough", 1.0, 1e-6),
    "file": ("PSNR lost (dB)", 0.1, 0.01),
    "training": ("PSNR lost (dB)", 0.1, 0.01),
}
READING = (
    "A row is the step of a knob that saves most and loses no more than is enough: a hundredth of "
    "the bits, half a step of an 8-bit picture, a thousandth of a gradient, 0.1 dB. Where there is "
    "none, it is the first step that saves anything. Rows are sorted by their verdict and then by "
    "how many times as cheap they are. Times are processor times of one process, taken in turn; a "
    "bar goes from quartile to quartile. A dotted line is the loss that is enough."
)


def run(names, folder, quick=False, progress=lambda line: None, jobs=1):
    """Turn knobs and write accuracy.md, its figures and their tables into an existing folder.

    `names` are knobs or harnesses, or None for all. `quick` trains nothing and leaves out the knobs
    that need it: it takes less than a minute instead of ten. Independent trainings run in `jobs`
    processes; times are taken in this one, with nothing beside it. Returns plain values for JSON.
    Raises StudyError for an unknown name.
    """
    wanted, folder, start = chosen(names), Path(folder), time.perf_counter()
    knobs = [knob for knob in wanted if knob.harness == "formula" or not quick]
    rows, spread = measure(knobs, quick, progress, jobs)
    findings = {}
    for knob in knobs:
        own, name = rows[knob.name], file_name(knob)
        found = finding(knob, own, spread if knob.harness == "training" else 0.0)
        if knob.name == "context":
            found["verdict"] = f"below {pays_from(own):,.0f} anchors"
        findings[knob.name] = found
        draw_knob(folder / f"{name}.png", knob, own)
        write_csv(folder / f"{name}.csv", own)
    draw_all(folder / "knobs.png", knobs, rows)
    result = {
        "arithmetic": arithmetic(),
        "seconds": time.perf_counter() - start,
        "stretch": max((stretch_of(a) for a in rows.values() if "stretch" in a[0]), default=1.0),
        "seeds_db": spread,
        "untold": [knob.name for knob in wanted if knob not in knobs],
        "knobs": sorted(findings.values(), key=lambda found: (rank(found), -found["factor"])),
        "rows": rows,
    }
    write_csv(folder / "knobs.csv", result["knobs"])
    sections = [section(knob, findings[knob.name]) for knob in knobs]
    (folder / PAGE).write_text("\n".join([*head(result), *sections]), encoding="utf-8")
    return result


def measure(knobs, quick, progress, jobs):
    """The rows of all knobs, {name: rows}, and how far the PSNR of seeds differs."""
    of = {name: [knob for knob in knobs if knob.harness == name] for name in HARNESSES}
    rows, spread = {}, 0.0
    for knob in of["formula"]:
        progress(f"formula: {knob.name}")
        rows[knob.name] = measure_forms(knob.values(quick), 3 if quick else 5)
    for knob in of["kernels"]:
        progress(f"kernels: {knob.name}")
        rows[knob.name] = measure_kernels(knob)
    if of["training"]:
        found, spread = measure_trainings(of["training"], ITERATIONS, progress, jobs)
        rows |= found
    if of["file"]:
        progress("file: the model that is written")
        model = trained({}, ITERATIONS)
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


def draw_all(path, knobs, rows):
    """Every knob as a line: what it loses, over how many times as cheap it is."""
    panels = []
    for harness in dict.fromkeys(knob.harness for knob in knobs):
        shown, (label, enough, least) = [], OVERVIEW[harness]
        for knob in (knob for knob in knobs if knob.harness == harness):
            dear, *_ = own = next(iter(lines_of(rows[knob.name]).values()))
            unit = knob.enough if "error" in dear else 1.0  # errors have different units
            for row in own:
                times, lost = dear[knob.spent] / row[knob.spent], max(loss(row, dear) / unit, least)
                shown.append({"line": knob.name, "times": times, "loss": lost})
        labels = {"xlabel": "times as cheap, in bytes or time", "ylabel": label}
        properties = {"xscale": "log", "yscale": "log", **labels}
        panels.append((HARNESSES[harness], shown, "times", "loss", enough, properties))
    if panels:
        size = 9, 4.4 * len(panels)
        draw(path, panels, size, label=False, loc="center left", bbox_to_anchor=(1.01, 0.5))


# --- text ----------------------------------------------------------------------------------------
def table(findings):
    """The table of all knobs as lines of Markdown."""
    names = ("knob", "dear → cheap", "what is lost", "what is saved", "verdict")
    cells = [
        (f["knob"], f"{f['dear']} → {f['cheap']}", f["lost"], f["saved"], f["verdict"])
        for f in findings
    ]
    widths = [max(map(len, column)) for column in zip(names, *cells)]
    rows = [names, ["-" * width for width in widths], *cells]
    return ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in rows]


def notes(result):
    """What a reader of the table must know of this run."""
    said = []
    if result["untold"]:
        said.append(f"--quick trains nothing, so it cannot tell: {', '.join(result['untold'])}.")
    if result["seeds_db"]:
        said.append(
            f"Files and trainings are those of `tiny` on `{SCENE}` with {ITERATIONS:,} iterations, "
            f"each trained once. Between {SEEDS} seeds PSNR differs by {result['seeds_db']:.2f} "
            "dB, so smaller losses of a training are not told for certain."
        )
    return said


def head(result):
    """The page up to its sections: the table, how it is to be read, and the picture."""
    measured = f"Measured with {result['arithmetic']}, in {result['seconds']:.0f} seconds."
    parts = (
        "# What accuracy costs in time and bytes",
        disturbance(result["stretch"]),
        "\n".join(table(result["knobs"])),
        *notes(result),
        f"{READING} {measured}",
        "![All knobs](knobs.png)",
    )
    return [f"{part}\n" for part in parts if part]


def section(knob, found):
    """The part of the page about one knob: two sentences, the figure and where its numbers are."""
    about, name = "has an error of" if knob.spent == "ms" else "changes PSNR by", file_name(knob)
    return f"""## {knob.name}

{knob.changes} ({knob.set_by}). `{found["cheap"]}` instead of `{found["dear"]}` {about} \
{found["lost"]} ({found["saved"]}).

![{knob.name}]({name}.png)

Numbers: [{name}.csv]({name}.csv).
"""


def describe(result, folder):
    """The text that the command prints: the table, and where the page is."""
    end = f"{Path(folder) / PAGE}: {result['seconds']:.0f} s in all."
    lines = *table(result["knobs"]), "", *notes(result), end, disturbance(result["stretch"])
    return "\n".join(lines).rstrip()
