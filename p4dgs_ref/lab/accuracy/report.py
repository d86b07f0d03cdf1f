"""The page `accuracy.md`: one table of all knobs with their verdicts, then a figure for each."""

import time
from pathlib import Path

from ...arithmetic import arithmetic
from ...report.figures import write_csv
from ..clock import can_tell, disturbance, stretch_of
from .diagram import lines_of, write_figure
from .harness import (
    ITERATIONS,
    SCENE,
    SEEDS,
    measure_file,
    measure_forms,
    measure_kernels,
    measure_trainings,
    scene_of,
    trained,
)
from .knobs import HARNESSES, file_name, select

PAGE = "accuracy.md"
LABELS = {
    "ms": "processor time (ms, median and quartiles)",
    "seconds": "training (processor seconds)",
    "bytes": "file (bytes)",
}
MIN_FACTOR = 1.01  # a knob that saves a smaller factor saves nothing
# What a knob is for that loses up to ten times more than is enough, by what it saves.
USES = {"ms": "for rough work", "seconds": "to try things out", "bytes": "at low rates"}
HIDDEN = "seeds differ by more"
# The order of verdicts in the table.
ORDER = ("always", *USES.values(), HIDDEN, "cannot tell", "saves nothing", "no")
READING = (
    "A row is the step of a knob that saves most and loses no more than is enough: a hundredth of "
    "the bits, half a step of an 8-bit picture, a thousandth of a gradient, 0.1 dB. Where there is "
    "none, it is the first step that saves anything. Two times cannot be told apart where they "
    "differ by less than the wider of their ranges from quartile to quartile. Rows are sorted by "
    "their verdict and then by how many times as cheap they are. Times are processor times of one "
    "process, taken in turn; a bar goes from quartile to quartile. A dotted line is the loss that "
    "is enough."
)


def run(names, folder, quick=False, progress=lambda line: None, jobs=1):
    """Turn knobs and write accuracy.md, its figures and their tables into an existing folder.

    `names` are knobs or harnesses, or None for all. `quick` trains nothing and leaves out the knobs
    that need it: it takes less than a minute instead of ten. Independent trainings run in `jobs`
    processes; times are taken in this one, with nothing beside it. Returns plain values for JSON.
    Raises StudyError for an unknown name.
    """
    wanted, folder, start = select(names), Path(folder), time.perf_counter()
    knobs = [knob for knob in wanted if knob.harness == "formula" or not quick]
    rows, spread = measure(knobs, quick, progress, jobs)
    findings = {knob.name: finding(knob, rows[knob.name], spread) for knob in knobs}
    table = sorted(findings.values(), key=lambda row: (ORDER.index(row["verdict"]), -row["factor"]))
    if "context" in findings:
        findings["context"]["verdict"] = f"below {pays_from(rows['context']):,.0f} anchors"
    for knob in knobs:
        draw_knob(folder / f"{file_name(knob)}.png", knob, rows[knob.name])
        write_csv(folder / f"{file_name(knob)}.csv", rows[knob.name])
    result = {
        "arithmetic": arithmetic(),
        "seconds": time.perf_counter() - start,
        "stretch": max((stretch_of(a) for a in rows.values() if "stretch" in a[0]), default=1.0),
        "seeds_db": spread,
        "left_out": [knob.name for knob in wanted if knob not in knobs],
        "knobs": table,
        "rows": rows,
    }
    write_csv(folder / "knobs.csv", result["knobs"])
    page = [*head(result), *(section(knob, findings[knob.name]) for knob in knobs)]
    (folder / PAGE).write_text("\n".join(page), encoding="utf-8")
    return result


def measure(knobs, quick, progress, jobs):
    """The rows of all knobs, {name: rows}, and how far the PSNR of seeds differs."""
    of = {name: [knob for knob in knobs if knob.harness == name] for name in HARNESSES}
    rows, spread = (
        measure_trainings(of["training"], ITERATIONS, progress, jobs)
        if of["training"]
        else ({}, 0.0)
    )
    for knob in (*of["formula"], *of["kernels"]):
        progress(f"{knob.harness}: {knob.name}")
        rows[knob.name] = (
            measure_kernels(knob)
            if knob.harness == "kernels"
            else measure_forms(knob.values(quick), 3 if quick else 5)
        )
    if of["file"]:
        progress("file: the model that is written")
        model = trained({}, ITERATIONS)
        rows |= {knob.name: measure_file(knob, model, scene_of()) for knob in of["file"]}
    return rows, spread


# --- verdicts ------------------------------------------------------------------------------------
def loss(row, reference):
    """The error of a row, or the dB that it loses against the reference."""
    return row["error"] if "error" in row else reference["psnr_db"] - row["psnr_db"]


def is_told(knob, row, reference):
    """Whether what two rows spend can be told apart: bytes always, times by their quartiles."""
    return knob.spent == "bytes" or can_tell(row, reference, knob.spent)


def factor(knob, row, reference):
    """How many times as much the reference spends; 1 where two times cannot be told apart."""
    told = is_told(knob, row, reference)
    return reference[knob.spent] / row[knob.spent] if told else 1.0


def finding(knob, rows, spread=0.0):
    """The row of the page's table about the first line of a knob.

    It reports the cheapest value that loses no more than is enough. Where there is none, it is the
    first value that saves anything. `spread` is the difference in dB that seeds alone make.
    """
    reference, *cheaper = next(iter(lines_of(rows).values()))
    factors = {row["value"]: factor(knob, row, reference) for row in cheaper}
    saving = [row for row in cheaper if factors[row["value"]] >= MIN_FACTOR]
    good = [row for row in saving if loss(row, reference) <= knob.enough]
    row = max(good, key=lambda row: factors[row["value"]], default=[*saving, *cheaper][0])
    times, lost = factors[row["value"]], loss(row, reference)
    verdicts = {
        "cannot tell": not is_told(knob, row, reference),
        "saves nothing": times < MIN_FACTOR,
        "always": lost <= knob.enough,
        HIDDEN: knob.harness == "training" and lost <= spread,
        USES[knob.spent]: lost <= 10 * knob.enough,
        "no": True,
    }
    return {
        "knob": knob.name,
        "reference": reference["value"],
        "cheaper": row["value"],
        "lost": amount_lost(knob, row, reference),
        "saved": amount_saved(row, reference),
        "factor": times,
        "verdict": next(verdict for verdict, holds in verdicts.items() if holds),
    }


def amount_lost(knob, row, reference):
    """The loss of a row in words."""
    if "error" in row:
        return f"{100 * row['error']:.2g} % {knob.unit}"
    return f"{row['psnr_db'] - reference['psnr_db']:+.2f} dB".replace("-", "−")


def amount_saved(row, reference):
    """What the reference spends, and what a row spends instead, in words."""
    units = {"ms": "ms", "seconds": "s", "bytes": "bytes"}
    columns = [name for name in units if name in row and not (name == "bytes" and "ms" in row)]
    return ", ".join(f"{short(reference[c])} → {short(row[c])} {units[c]}" for c in columns)


def short(value):
    """A time or a size in three digits or more."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def pays_from(rows):
    """From how many anchors on the context pays, extrapolated from the two rows of its knob."""
    prior, alone = rows
    per_anchor = (alone["attribute_bytes"] - prior["attribute_bytes"]) / prior["anchors"]
    cost = (prior["bytes"] - prior["attribute_bytes"]) - (alone["bytes"] - alone["attribute_bytes"])
    return float(f"{cost / max(per_anchor, 1e-9):.2g}")


# --- the page ------------------------------------------------------------------------------------
def draw_knob(path, knob, rows):
    """The figure of a knob: what every value loses, over what it spends."""
    points = [{**row, "loss": loss(row, rows[0])} for row in rows]
    is_error = "error" in rows[0]
    write_figure(
        path,
        points,
        knob.spent,
        "loss",
        knob.enough,
        title=knob.changes,
        xscale="log",
        yscale="log" if is_error else "linear",
        xlabel=LABELS[knob.spent],
        ylabel=f"error {knob.unit}" if is_error else "PSNR lost (dB)",
    )


def markdown_table(findings):
    """The table of all knobs as lines of Markdown."""
    names = ("knob", "reference → cheaper", "what is lost", "what is saved", "verdict")
    cells = [
        (f["knob"], f"{f['reference']} → {f['cheaper']}", f["lost"], f["saved"], f["verdict"])
        for f in findings
    ]
    widths = [max(map(len, column)) for column in zip(names, *cells)]
    rows = [names, ["-" * width for width in widths], *cells]
    return ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in rows]


def notes(result):
    """What a reader of the table must know of this run, a sentence or two each."""
    trained_once = (
        f"Files and trainings are those of `tiny` on `{SCENE}` with {ITERATIONS:,} iterations, "
        f"each trained once. Between {SEEDS} seeds PSNR differs by {result['seeds_db']:.2f} "
        "dB, so a smaller loss of a training is uncertain."
    )
    left_out = f"--quick trains nothing, so it leaves out: {', '.join(result['left_out'])}."
    return [left_out] * bool(result["left_out"]) + [trained_once] * bool(result["seeds_db"])


def head(result):
    """The page up to its sections: the table, and how it is to be read."""
    parts = (
        "# What accuracy costs in time and bytes",
        disturbance(result["stretch"]),
        "\n".join(markdown_table(result["knobs"])),
        *notes(result),
        f"{READING} Measured with {result['arithmetic']}, in {result['seconds']:.0f} seconds.",
    )
    return [f"{part}\n" for part in parts if part]


def section(knob, row):
    """The part of the page about one knob: two sentences, the figure and where its numbers are."""
    about, name = "has an error of" if knob.spent == "ms" else "changes PSNR by", file_name(knob)
    return f"""## {knob.name}

{knob.changes} ({knob.set_by}). `{row["cheaper"]}` instead of `{row["reference"]}` {about} \
{row["lost"]} ({row["saved"]}).

![{knob.name}]({name}.png)

Numbers: [{name}.csv]({name}.csv).
"""


def to_text(result, folder):
    """The text that the command prints: the table, and where the page is."""
    end = f"{Path(folder) / PAGE}: {result['seconds']:.0f} s in all."
    lines = (
        *markdown_table(result["knobs"]),
        "",
        *notes(result),
        end,
        disturbance(result["stretch"]),
    )
    return "\n".join(lines).rstrip()
