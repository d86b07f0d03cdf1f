"""The grades of a class as text, as JSON and as CSV."""

import csv
import io
import json
from pathlib import Path

from ...oracle.report import name_of
from ...scenes.output import filled
from ...table import EQUATIONS
from .syllabus import tutorial_of


def text(reports):
    """Return the table of all students, and then the details of each."""
    blocks = [table(reports)] if len(reports) > 1 else []
    return "\n\n".join([*blocks, *map(details, reports)])


def grid(reports):
    """Return the table of a class as rows of text: a line for each student, the heading first."""
    keys = [grade.key for grade in reports[0].grades]
    rows = [["student", *keys, "points", "of", "copied", "seed"]]
    for report in reports:
        points = [f"{grade.points:.2f}" for grade in report.grades]
        total = f"{report.points:.2f}", f"{report.of:.0f}"
        copied = sum(bool(grade.flags) for grade in report.grades)
        rows.append([report.student, *points, *total, str(copied), str(report.seed)])
    return rows


def table(reports):
    """Return the table of a class in columns; its longer side goes down the page."""
    rows = grid(reports)
    rows = list(zip(*rows)) if len(rows[0]) > len(rows) else rows
    first, *others = (max(map(len, column)) for column in zip(*rows))
    return "\n".join(
        "  ".join([row[0].ljust(first), *map(str.rjust, row[1:], others)]) for row in rows
    )


def details(report):
    """Return the points of a student, with the first wrong answers and their explanations."""
    names = [name_of(grade.key) for grade in report.grades]
    width = max(map(len, names))
    lines = [report.student]
    for heading, grade in zip(names, report.grades):
        points = f"{grade.points:5.2f} of {grade.of:2.0f}"
        lines.append(f"{heading:<{width}}  {points}  {missed(grade)}".rstrip())
        said = {
            f"{grade.earned:.2f} points withheld, copied": ", ".join(grade.flags),
            "first": grade.first,
            "explained by": grade.explanation,
            "hint": grade.hint,
        }
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
    """Return one dictionary for each equation, with its parts."""
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


def as_json(reports):
    """Return the reports as a dictionary; scripts may rely on its fields."""
    students = [
        {
            "student": report.student,
            "points": round(report.points, 4),
            "of": round(report.of, 4),
            "equations": rows(report),
        }
        for report in reports
    ]
    return {"seed": reports[0].seed, "students": students}


def as_csv(reports):
    """Return the table of a class for a spreadsheet."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(grid(reports))
    return out.getvalue()


def write(reports, folder):
    """Write grades.txt, grades.json and grades.csv to a folder. Raises OutputError."""
    files = {
        "grades.txt": text(reports) + "\n",
        "grades.json": json.dumps(as_json(reports), indent=1) + "\n",
        "grades.csv": as_csv(reports),
    }
    with filled(Path(folder)) as beside:
        for name, content in files.items():
            (beside / name).write_text(content, encoding="utf-8")
