"""All studies in their order, the page that holds their figures and readings, and the three named points in short."""

import shutil
import time
from pathlib import Path

from ...splatting.settings import SETTINGS
from . import coder, gradients, hash_grid, likelihood, quantisation, rendering, size, training
from .diagram import number
from .timing import machine

# In the order of the page: arithmetic first, then what is trained, then how costs grow.
STUDIES = {
    "rendering": rendering.run,
    "likelihood": likelihood.run,
    "coder": coder.run,
    "quantisation": quantisation.run,
    "training": training.run,
    "hash_grid": hash_grid.run,
    "gradients": gradients.run,
    "size": size.run,
}
PAGE = "accuracy.md"


def run(names, folder, quick=False, progress=lambda line: None):
    """Measure, draw and write: a CSV and PNG a diagram and one page, into an existing folder.

    Takes      names of STUDIES, or None for all; `quick` for a minute instead of ten; `progress(line)` is told what begins
    Returns    {"machine", "quick", "seconds", "studies": [...]}, plain values for JSON
    Raises     ValueError naming a study that there is none of
    """
    folder, names, start = (
        Path(folder),
        list(STUDIES) if names is None else list(names),
        time.perf_counter(),
    )
    for name in names:
        if name not in STUDIES:
            raise ValueError(f"study {name!r}: expected one of {', '.join(STUDIES)}")
    findings = []
    for name in (name for name in STUDIES if name in names):
        begun = time.perf_counter()
        found = STUDIES[name](folder, quick, progress)
        for figure in (
            Path(file).stem for file, _ in found.figures
        ):  # one that shows a study's main table again
            if f"{figure}.csv" not in found.tables:
                shutil.copyfile(folder / f"{name}.csv", folder / f"{figure}.csv")
                found.tables.append(f"{figure}.csv")
        findings.append({**found._asdict(), "seconds": time.perf_counter() - begun})
    result = {
        "machine": machine(),
        "quick": quick,
        "seconds": time.perf_counter() - start,
        "studies": findings,
    }
    (folder / PAGE).write_text(page(result), encoding="utf-8")
    return result


def page(result):
    """The page as Markdown: what was measured on, then a section a study."""
    about = "; ".join(f"{name} {value}" for name, value in result["machine"].items())
    sizes = (
        "The quick sizes were used: points are few, models hardly trained, times rough."
        if result["quick"]
        else "The full sizes were used."
    )
    parts = [
        "# What accuracy costs in time",
        "",
        f"Measured on: {about}.",
        "",
        f"{sizes} {result['seconds']:.0f} seconds in all. Times are of one process; every figure's numbers, counted work "
        "among them, are in the CSV beside it. Times depend on the machine, counted work and errors hardly do.",
        "",
    ]
    for study in result["studies"]:
        parts += [f"## {study['title']}", "", study["reading"], ""]
        parts += [f"![{caption}]({file})\n\n*{caption}*\n" for file, caption in study["figures"]]
        tables = ", ".join(f"[{file}]({file})" for file in study["tables"])
        parts += [
            f"Reference: {study['reference']}. Time: {study['repeats']}. Numbers: {tables}.",
            "",
        ]
    return "\n".join(parts)


def summary(repeats=7):
    """The settings `exact`, `paper` and `fast`: (rows of plain values, the same as lines of text)."""
    rows = rendering.summary_rows(repeats)
    widths = max(map(len, SETTINGS))
    lines = [
        f"{rendering.SUMMARY_SIZE[0]} splats, {rendering.SUMMARY_SIZE[1]}×{rendering.SUMMARY_SIZE[1]} pixels, forward and "
        f"backward, median of {repeats} alternating repeats at least; errors against the exact twin in float64",
        f"{'':{widths}}  {'ms':>7}  {'pairs':>10}  {'image, max':>10}  {'image, rms':>10}  gradients, relative L2: "
        + ", ".join(rendering.GRADIENTS.values()),
    ]
    for row in rows:
        errors = "  ".join(f"{number(row[f'{name}_error']):>8}" for name in rendering.GRADIENTS)
        lines.append(
            f"{row['settings']:{widths}}  {row['ms']:7.2f}  {row['pairs']:10,}  {number(row['error']):>10}  "
            f"{number(row['rms_error']):>10}  {errors}"
        )
    return rows, "\n".join(lines)


def describe(result, folder):
    """What the command prints after a run: every study's reading and where the page is."""
    readings = "\n\n".join(
        f"{study['title']} ({study['seconds']:.0f} s)\n  {study['reading']}"
        for study in result["studies"]
    )
    return f"{readings}\n\n{Path(folder) / PAGE}: {result['seconds']:.0f} s in all"
