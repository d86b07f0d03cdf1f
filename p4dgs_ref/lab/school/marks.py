"""The grades of a class as text, as JSON and as CSV."""

import csv
import io
import json
from pathlib import Path

from ...oracle.report import name_of
from ...scenes.output import filled


def text(grades):
    """Return the table of all students, and then the details of each."""
    blocks = [table(grades)] if len(grades["students"]) > 1 else []
    return "\n\n".join([*blocks, *(details(s, grades["seed"]) for s in grades["students"])])


def grid(grades):
    """Return the table of a class as rows of text: a line for each student, the heading first."""
    keys = [row["key"] for row in grades["students"][0]["equations"]]
    lines = [["student", *keys, "points", "of", "copied", "seed"]]
    for student in grades["students"]:
        points = [f"{row['points']:.2f}" for row in (*student["equations"], student)]
        copied = sum(bool(row["flags"]) for row in student["equations"])
        rest = f"{student['of']:.0f}", str(copied), str(grades["seed"])
        lines.append([student["student"], *points, *rest])
    return lines


def table(grades):
    """Return the table of a class in columns; its longer side goes down the page."""
    rows = grid(grades)
    rows = list(zip(*rows)) if len(rows[0]) > len(rows) else rows
    first, *others = (max(map(len, column)) for column in zip(*rows))
    return "\n".join(
        "  ".join([row[0].ljust(first), *map(str.rjust, row[1:], others)]) for row in rows
    )


def details(student, seed):
    """Return the points of a student, with the first wrong answers and their explanations."""
    names = [name_of(row["key"]) for row in student["equations"]]
    width = max(map(len, names))
    lines = [student["student"]]
    for heading, row in zip(names, student["equations"]):
        points = f"{row['points']:5.2f} of {row['of']:2.0f}"
        lines.append(f"{heading:<{width}}  {points}  {missed(row)}".rstrip())
        earned = sum(part["points"] for part in row["parts"])
        said = {
            f"{earned:.2f} points withheld, copied": ", ".join(row["flags"]),
            "first": row["first"],
            "explained by": row["explanation"],
            "hint": row["hint"],
        }
        lines += [f"    {name}: {what}" for name, what in said.items() if what]
    points, of = student["points"], student["of"]
    total = f"{points:5.2f} of {of:.0f}  ({100 * points / max(of, 1):.1f} %, seed {seed})"
    return "\n".join([*lines, f"{'sum':<{width}}  {total}"])


def missed(row):
    """Return the note of a row, or the parts that miss points: `gradient of l_a 0 of 3`."""
    return row["note"] or ", ".join(
        f"{part['name']} {part['right']} of {part['asked']}"
        for part in row["parts"]
        if part["right"] < part["asked"]
    )


def as_json(grades):
    """Return the grades with points of four digits; scripts may rely on the fields."""
    return json.loads(json.dumps(grades), parse_float=lambda digits: round(float(digits), 4))


def as_csv(grades):
    """Return the table of a class for a spreadsheet."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(grid(grades))
    return out.getvalue()


def write(grades, folder):
    """Write grades.txt, grades.json and grades.csv to a folder. Raises OutputError."""
    files = {
        "grades.txt": text(grades) + "\n",
        "grades.json": json.dumps(as_json(grades), indent=1) + "\n",
        "grades.csv": as_csv(grades),
    }
    with filled(Path(folder)) as beside:
        for name, content in files.items():
            (beside / name).write_text(content, encoding="utf-8")
