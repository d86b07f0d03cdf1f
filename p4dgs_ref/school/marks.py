"""A grader's report as text, as JSON and as CSV."""

import csv
import io
import json
from pathlib import Path

from ..equations import EQUATIONS
from ..oracle.report import name_of
from ..scenes.output import filled
from ..syllabus import tutorial_of

COLUMNS = ("number", "key", "points", "of", "tutorial", "first", "explanation", "flags", "note")


def text(report):
    """Points by equation; below each what failed first, and what explains it."""
    width = max(len(name_of(grade.key)) for grade in report.grades)
    lines = []
    for grade in report.grades:
        lines.append(
            f"{name_of(grade.key):<{width}}  {grade.points:5.2f} of {grade.of:2.0f}  {_parts(grade)}".rstrip()
        )
        lines += [f"    points withheld ({grade.earned:.2f}): {flag}" for flag in grade.flags]
        lines += [
            f"    {said}: {what}"
            for said, what in (("first", grade.first), ("explained by", grade.explanation))
            if what
        ]
    whole = report.of
    return "\n".join(
        [
            *lines,
            f"{'sum':<{width}}  {report.points:5.2f} of {whole:.0f}  "
            f"({100 * report.points / whole if whole else 0:.1f} %, seed {report.seed})",
        ]
    )


def _parts(grade):
    """The parts that miss points: `gradient of l_a 0 of 3`; nothing where all is right."""
    return grade.note or ", ".join(
        f"{part.name} {part.right} of {part.asked}"
        for part in grade.parts
        if part.right < part.asked
    )


def rows(report):
    """One dictionary an equation, with the fields of COLUMNS and its parts."""
    return [
        {
            "number": EQUATIONS[grade.key].number,
            "key": grade.key,
            "points": round(grade.points, 4),
            "of": round(grade.of, 4),
            "tutorial": tutorial_of(grade.key).name,
            "first": grade.first,
            "explanation": grade.explanation,
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
    """The contract for scripts."""
    return {
        "seed": report.seed,
        "points": round(report.points, 4),
        "of": round(report.of, 4),
        "equations": rows(report),
    }


def as_csv(report):
    """One line an equation under a head, for a spreadsheet."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(COLUMNS)
    for row in rows(report):
        table.writerow("; ".join(row[name]) if name == "flags" else row[name] for name in COLUMNS)
    return out.getvalue()


def write(report, folder):
    """Write grades.txt, grades.json and grades.csv into a folder.

    Raises     OutputError
    """
    with filled(Path(folder)) as beside:
        (beside / "grades.txt").write_text(text(report) + "\n", encoding="utf-8")
        (beside / "grades.json").write_text(
            json.dumps(as_json(report), indent=1) + "\n", encoding="utf-8"
        )
        (beside / "grades.csv").write_text(as_csv(report), encoding="utf-8")
