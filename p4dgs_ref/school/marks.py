"""The grader's report as text, as JSON and as CSV."""

import csv
import io
import json
from pathlib import Path

from ..oracle.report import name_of
from ..scenes.output import filled
from ..table import EQUATIONS
from .syllabus import tutorial_of

COLUMNS = (
    "number",
    "key",
    "points",
    "of",
    "tutorial",
    "first",
    "explanation",
    "hint",
    "flags",
    "note",
)


def text(report):
    """Return the points of every equation, with the first wrong answer and its explanation."""
    names = [name_of(grade.key) for grade in report.grades]
    width = max(map(len, names))
    lines = []
    for heading, grade in zip(names, report.grades):
        points = f"{grade.points:5.2f} of {grade.of:2.0f}"
        lines.append(f"{heading:<{width}}  {points}  {missed(grade)}".rstrip())
        lines += [f"    points withheld ({grade.earned:.2f}): {flag}" for flag in grade.flags]
        said = {"first": grade.first, "explained by": grade.explanation, "hint": grade.hint}
        lines += [f"    {name}: {what}" for name, what in said.items() if what]
    percent = 100 * report.points / report.of if report.of else 0
    total = f"{report.points:5.2f} of {report.of:.0f}  ({percent:.1f} %, seed {report.seed})"
    return "\n".join([*lines, f"{'sum':<{width}}  {total}"])


def missed(grade):
    """Return the note of a grade, or the parts that miss points: `gradient of l_a 0 of 3`."""
    return grade.note or ", ".join(
        f"{part.name} {part.right} of {part.asked}"
        for part in grade.parts
        if part.right < part.asked
    )


def rows(report):
    """Return one dictionary for each equation, with the fields of COLUMNS and its parts."""
    return [
        {
            "number": EQUATIONS[grade.key].number,
            "key": grade.key,
            "points": round(grade.points, 4),
            "of": round(grade.of, 4),
            "tutorial": tutorial_of(grade.key).name,
            "first": grade.first,
            "explanation": grade.explanation,
            "hint": grade.hint,
            "flags": list(grade.flags),
            "note": grade.note,
            "parts": [
                {
                    "name": part.name,
                    "points": round(part.points, 4),
                    "of": round(part.of, 4),
                    "right": part.right,
                    "asked": part.asked,
                }
                for part in grade.parts
            ],
        }
        for grade in report.grades
    ]


def as_json(report):
    """Return the report as a dictionary; scripts may rely on its fields."""
    return {
        "seed": report.seed,
        "points": round(report.points, 4),
        "of": round(report.of, 4),
        "equations": rows(report),
    }


def as_csv(report):
    """Return the report as a table for a spreadsheet, with one line for each equation."""
    out = io.StringIO()
    table = csv.DictWriter(out, COLUMNS, lineterminator="\n", extrasaction="ignore")
    table.writeheader()
    for row in rows(report):
        table.writerow({**row, "flags": "; ".join(row["flags"])})
    return out.getvalue()


def write(report, folder):
    """Write grades.txt, grades.json and grades.csv to a folder. Raises OutputError."""
    files = {
        "grades.txt": text(report) + "\n",
        "grades.json": json.dumps(as_json(report), indent=1) + "\n",
        "grades.csv": as_csv(report),
    }
    with filled(Path(folder)) as beside:
        for name, content in files.items():
            (beside / name).write_text(content, encoding="utf-8")
