"""The page `accuracy.md`: a picture, one table of all knobs with verdicts, a figure for each."""

import time
from pathlib import Path

from ...arithmetic import arithmetic
from ...report.figures import write_csv
from ..clock import disturbance
from .answers import draw_answers
from .diagram import write_figure
from .harness import SCENE, SEEDS, measure_forms, measure_kernels, measure_trainings
from .knobs import HARNESSES, PSNR, file_name, select
from .verdicts import by_knob, findings, points, stretch

PAGE, RECORD, PICTURE = "accuracy.md", "accuracy.csv", "accuracy.png"
LABELS = {
    "ms": "processor time (ms, median and quartiles)",
    "seconds": "training (processor seconds)",
    "bytes": "file (bytes)",
}
READING = (
    "A row is the step of a knob that saves most and loses no more than is enough: a hundredth of "
    "the bits, half a grey level of an 8-bit picture, a thousandth of a gradient or a slope, "
    "0.1 dB. Where there is none, it is the first step that saves anything. Two times cannot be "
    "told apart where their ranges from quartile to quartile overlap, or where they differ by less "
    "than the wider one; two files or trainings, where they differ by less than twice the standard "
    "error of the differences between the same seeds, which is what ± says. Rows are sorted by "
    "their verdict and then by how many times as cheap they are. Times are processor times of one "
    "process, taken in turn; a bar goes from quartile to quartile. A dotted line is the loss that "
    "is enough."
)


def run(
    names,
    folder,
    kept,
    quick=False,
    progress=lambda line: None,
    jobs=1,
    iterations=None,
    seeds=SEEDS,
):
    """Turn knobs and write accuracy.md, its figures and accuracy.csv into an existing folder.

    `names` are knobs or harnesses, or None for all. `quick` trains nothing and leaves out the knobs
    that need it: it takes less than a minute. Trainings have the iterations of their preset, or
    that many, and `jobs` processes; their results are kept in the folder `kept`, so that what was
    stopped goes on. Times are taken in this process, with nothing beside it. Returns plain values
    for JSON. Raises StudyError for an unknown name.
    """
    wanted, folder, start = select(names), Path(folder), time.perf_counter()
    knobs = [knob for knob in wanted if knob.harness in ("formula", "kernels") or not quick]
    measured = measure(knobs, quick, kept, iterations, seeds, progress, jobs)
    rows = [
        {"knob": knob.name, "seed": 0, **row, "arithmetic": row.get("arithmetic", arithmetic())}
        | {"command": f"p4dgs-ref accuracy --only {file_name(knob)}{' --quick' * quick}"}
        for knob in knobs
        for row in measured[knob.name]
    ]
    write_csv(folder / RECORD, rows)
    has_picture = draw_answers(folder / PICTURE, rows)
    for knob in knobs:
        draw_knob(folder / f"{file_name(knob)}.png", knob, by_knob(rows)[knob.name])
    result = {
        "arithmetic": arithmetic(),
        "seconds": time.perf_counter() - start,
        "stretch": stretch(rows),
        "left_out": [knob.name for knob in wanted if knob not in knobs],
        "knobs": findings(knobs, rows),
        "has_picture": has_picture,
        "rows": by_knob(rows),
    }
    page = [*head(result), *(section(knob, result["knobs"]) for knob in knobs)]
    (folder / PAGE).write_text("\n".join(page), encoding="utf-8")
    return result


def measure(knobs, quick, kept, iterations, seeds, progress, jobs):
    """The rows of all knobs, {name: rows}."""
    of = {name: [knob for knob in knobs if knob.harness == name] for name in HARNESSES}
    rows = {}
    for knob in (*of["formula"], *of["kernels"]):
        progress(f"{knob.harness}: {knob.name}")
        rows[knob.name] = (
            measure_kernels(5 if quick else knob.values)
            if knob.harness == "kernels"
            else measure_forms(knob.values(quick), 3 if quick else 5)
        )
    if of["training"] or of["file"]:
        places = Path(kept) / "trainings", iterations, seeds
        rows |= measure_trainings(of["training"], of["file"], *places, progress, jobs)
    return rows


# --- the page ------------------------------------------------------------------------------------
def draw_knob(path, knob, rows):
    """The figure of a knob: what every value loses, over what it spends."""
    loss, shown = knob.losses[0], points(rows)
    is_error, start = loss is not PSNR, shown[0][loss.column]
    write_figure(
        path,
        [
            {**row, "loss": loss.scale * row[loss.column] if is_error else start - row[loss.column]}
            for row in shown
        ],
        knob.spent,
        "loss",
        loss.enough,
        title=knob.changes,
        xscale="log",
        yscale="log" if is_error else "linear",
        xlabel=LABELS[knob.spent],
        ylabel=loss.unit if is_error else "PSNR lost (dB)",
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
    trained = [row for rows in result["rows"].values() for row in rows if "iterations" in row]
    seeds = len({row["seed"] for row in trained})
    lengths = {row["iterations"] for row in trained}
    how = (
        f"Files and trainings are those of `tiny` on `{SCENE}`, with {seeds} seed"
        f"{'s' * (seeds > 1)} and up to {max(lengths, default=0):,.0f} iterations."
    )
    left_out = f"--quick trains nothing, so it leaves out: {', '.join(result['left_out'])}."
    return [left_out] * bool(result["left_out"]) + [how] * bool(trained)


def head(result):
    """The page up to its sections: the picture, the table, and how it is to be read."""
    parts = (
        "# What accuracy costs in time and bytes",
        disturbance(result["stretch"]),
        f"![What accuracy costs in time, in six answers]({PICTURE})" * result["has_picture"],
        "\n".join(markdown_table(result["knobs"])),
        *notes(result),
        f"{READING} Measured with {result['arithmetic']}, in {result['seconds']:.0f} seconds. All "
        f"numbers: [{RECORD}]({RECORD}).",
    )
    return [f"{part}\n" for part in parts if part]


def section(knob, table):
    """The part of the page about one knob: a sentence, what its rows of the table say, a figure."""
    name = file_name(knob)
    says = " ".join(
        f"`{row['cheaper']}` instead of `{row['reference']}`: {row['lost']}, {row['saved']}."
        for row in table
        if row["knob"] == knob.name
    )
    return (
        f"## {knob.name}\n\n{knob.changes} ({knob.set_by}). {says}\n\n![{knob.name}]({name}.png)\n"
    )


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
