"""All studies in order, the page with their figures and readings, and the short summary."""

import shutil
import time
from pathlib import Path

from ...report.evaluate import timed
from ...splatting.settings import SETTINGS
from ..clock import disturbance, stretch_of
from . import (
    coder,
    gradients,
    hash_grid,
    likelihood,
    quantisation,
    rendering,
    size,
    training,
)
from .diagram import number
from .timing import machine

# In the order of the page: arithmetic first, then training, then how costs grow.
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


def run(names, folder, quick=False, progress=lambda line: None, jobs=1):
    """Run studies and write a PNG and a CSV per diagram, and one page, into an existing folder.

    `names` are keys of STUDIES, or None for all. `quick` takes about a minute instead of ten.
    Independent trainings run in `jobs` processes; times are taken in this one, with nothing
    beside it. Returns {"machine", "quick", "seconds", "studies": [...]}, plain values for JSON.
    Raises ValueError for an unknown name.
    """
    names = STUDIES if names is None else list(names)
    folder, start, findings = Path(folder), time.perf_counter(), []
    for name in names:
        if name not in STUDIES:
            raise ValueError(f"study {name!r}: expected one of {', '.join(STUDIES)}")
    for name in sorted(set(names), key=list(STUDIES).index):
        found, seconds = timed(STUDIES[name], folder, quick, progress, jobs)
        complete_tables(found, folder)
        findings.append({**found._asdict(), "seconds": seconds})
    result = {
        "machine": machine(),
        "quick": quick,
        "seconds": time.perf_counter() - start,
        "studies": findings,
    }
    (folder / PAGE).write_text(page(result), encoding="utf-8")
    return result


def complete_tables(found, folder):
    """Figures without a table of their own show the study's main table: copy it for them."""
    for file, _ in found.figures:
        own = f"{Path(file).stem}.csv"
        if own not in found.tables:
            shutil.copyfile(folder / f"{found.name}.csv", folder / own)
            found.tables.append(own)


def page(result):
    """The page as Markdown: the machine, then one section per study."""
    about = "; ".join(f"{name} {value}" for name, value in result["machine"].items())
    quick = "The quick sizes were used: few points, hardly trained models, rough times."
    sizes = quick if result["quick"] else "The full sizes were used."
    parts = [
        "# What accuracy costs in time",
        "",
        f"Measured on: {about}.",
        "",
        f"{sizes} The run took {result['seconds']:.0f} seconds. Times are processor times of one "
        "process, taken in turns; the numbers in brackets are their quartiles. The CSV beside each "
        "figure holds its numbers and the counted work. Times depend on the machine; counted work "
        "and errors hardly do.",
        "",
    ]
    for study in result["studies"]:
        parts += [f"## {study['title']}", "", study["reading"], ""]
        parts += [f"![{caption}]({file})\n\n*{caption}*\n" for file, caption in study["figures"]]
        tables = ", ".join(f"[{file}]({file})" for file in study["tables"])
        about = f"Reference: {study['reference']}. Time: {study['repeats']}. Numbers: {tables}."
        parts += [f"{about} {disturbance(study['stretch'])}".rstrip(), ""]
    return "\n".join(parts)


def summary(repeats=7):
    """The settings `exact`, `paper` and `fast`: rows of plain values, and the same as text."""
    rows = rendering.summary_rows(repeats)
    width = max(map(len, SETTINGS))
    n, side = rendering.SUMMARY_SIZE
    gradients_of = ", ".join(rendering.GRADIENTS.values())
    lines = [
        f"{n} splats, {side}×{side} pixels, forward and backward, processor time: median and "
        f"quartiles of at least {repeats} alternating repeats; errors against the exact twin in "
        "float64",
        f"{'':{width}}  {'ms':>7}  {'quartiles':>15}  {'pairs':>10}  {'image, max':>10}  "
        f"{'image, rms':>10}  gradients, relative L2: {gradients_of}",
    ]
    for row in rows:
        errors = "  ".join(f"{number(row[f'{name}_error']):>8}" for name in rendering.GRADIENTS)
        lines.append(
            f"{row['settings']:{width}}  {row['ms']:7.2f}  {row['ms_low']:6.2f} … "
            f"{row['ms_high']:6.2f}  {row['pairs']:10,}  "
            f"{number(row['error']):>10}  {number(row['rms_error']):>10}  {errors}"
        )
    return rows, "\n".join([*lines, disturbance(stretch_of(rows))]).rstrip()


def describe(result, folder):
    """The text that the command prints: the reading of every study, and where the page is."""
    readings = [
        f"{study['title']} ({study['seconds']:.0f} s)\n  {study['reading']} "
        f"{disturbance(study['stretch'])}".rstrip()
        for study in result["studies"]
    ]
    return "\n\n".join([*readings, f"{Path(folder) / PAGE}: {result['seconds']:.0f} s in all"])
