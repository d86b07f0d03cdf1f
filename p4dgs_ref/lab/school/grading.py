"""Grades a classroom: each equation in a process of its own, with points for every right part.

The grades of a class have the form of grades.json: a dictionary with the seed and the students,
who have a row for every equation, which has its parts.
"""

import csv
import io
import json
import secrets
import time
from pathlib import Path

import numpy as np

from ...oracle import published
from ...oracle.checker import check_subject
from ...oracle.compare import compare, expected
from ...oracle.ports import PortError
from ...oracle.report import name_of
from ...scenes.output import filled
from ...table import EQUATIONS
from ..writer import aligned
from .guard import copies
from .held_back import cases, is_ordinary
from .room import FORWARD, GRADIENTS, HARD, ClassroomError, keys_of, parts_of, unwritten
from .student import Student
from .syllabus import tutorial_of

SECONDS = 30  # for all cases of an equation; the cases after that are not asked


def grade(
    *folders, classroom=None, seed=None, timeout=5.0, reveal=False, progress=lambda text: None
):
    """Grade what students handed in, all by the same inputs.

    A folder is a classroom, of which DIR/student counts, or contains a student's files itself.
    `classroom` is the one whose equations are asked for; the default is the first folder. `seed`
    determines the inputs; without it one is drawn. `timeout` is the time for one case, in seconds.
    With `reveal`, messages contain expected values. Nothing is written. Raises ClassroomError.
    """
    keys = keys_of(folders[0] if classroom is None else classroom)
    seed = secrets.randbelow(2**32) if seed is None else seed
    places = [files_of(folder) for folder in folders]
    students = []
    for folder, files in zip(folders, places):
        rows = []
        for key in sorted(keys, key=published.equations().index):
            progress(f"grading {folder}: {key}")
            rows.append(grade_of(key, files / f"{key}.py", seed, timeout, reveal))
        total = {name: sum(row[name] for row in rows) for name in ("points", "of")}
        students.append({"student": str(folder), **total, "equations": rows})
    return {"seed": seed, "students": students}


def files_of(folder):
    """Return the folder with a student's files."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ClassroomError(f"{folder}: expected a folder with the files of a student")
    return folder / "student" if (folder / "student").is_dir() else folder


# --- one equation ---------------------------------------------------------------------------------
def grade_of(key, path, seed, timeout, reveal):
    """Return the row of one file."""
    try:
        source = path.read_text(encoding="utf-8")
        flags = copies(source, key)
    except (OSError, UnicodeDecodeError):
        return row_of(key, note=f"{path.name}: expected a file of Python text")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        said = f"{path.name}: {type(error).__name__}: {error}"
        return row_of(key, first=said, note="cannot be read")
    if all(unwritten(source, name) for name in parts_of(key)):
        return row_of(key, note="not begun")
    deadline = time.monotonic() + SECONDS
    known = []
    with Student(path, timeout) as port:
        answers = [(case, judged(case, port, deadline, reveal)) for case in cases(key, seed)]
        if any(wrong for _, wrong in answers):
            # The wrong answers to held-back cases are not known, those to the published ones are.
            known = [r for r in check_subject(published.cases(key), port) if r.findings]
    said = {
        "first": [
            f"{case.id}: {wrong_in(part, case, wrong)}"
            for case, wrong in answers
            for part in points_of(key)
            if wrong_in(part, case, wrong)
        ],
        "explanation": [r.explanation for r in known if r.explanation],
        "hint": [r.hint for r in known if r.hint],
    }
    firsts = {name: lines[0] for name, lines in said.items() if lines}
    return row_of(key, answers, flags=flags, **firsts)


def row_of(key, answers=(), first="", explanation="", hint="", flags=(), note=""):
    """Return the row of an equation; `answers` are pairs of a case and what is wrong there.

    `first` is the first wrong answer with its worst element, `explanation` a known mistake that
    explains the wrong answers, `hint` one that agrees with most of them. `flags` are copies of the
    package; with any of them there are no points.
    """
    parts = [part_of(part, answers) for part in points_of(key)]
    return {
        "number": EQUATIONS[key].number,
        "key": key,
        "points": 0.0 if flags else round(sum(part["points"] for part in parts), 6),
        "of": round(sum(part["of"] for part in parts), 6),
        "tutorial": tutorial_of(key).name,
        "first": first,
        "explanation": explanation,
        "hint": hint,
        "flags": list(flags),
        "note": note,
        "parts": parts,
    }


def points_of(key):
    """Return what gives points: name, points, prefix of tensors, whether about ordinary cases."""
    gradients = EQUATIONS[key].gradients
    share = 1 if gradients else 2  # without gradients, outputs take all points
    each = GRADIENTS / max(len(gradients), 1)
    parts = [
        ("forward", share * FORWARD, "out.", True),
        *((f"gradient of {name}", each, f"in_bar.{name}.", True) for name in gradients),
        ("hard cases: outputs", share * HARD / 2, "out.", False),
        ("hard cases: gradients", HARD / 2, "in_bar.", False),
    ]
    return parts if gradients else parts[:2]


def part_of(part, answers):
    """Return the points of one part, by its share of right answers."""
    name, of, *_ = part
    said = [wrong_in(part, *answer) for answer in answers]
    right, asked = said.count(""), len(said) - said.count(None)
    points = of * right / asked if asked else 0.0
    return {"name": name, "points": points, "of": of, "right": right, "asked": asked}


def wrong_in(part, case, wrong):
    """Return what is wrong with a part in a case, None if the case does not count for it."""
    _, _, prefix, ordinary = part
    counts = is_ordinary(case) == ordinary and first_of(expected(case.tensors), prefix) is not None
    return (first_of(wrong, prefix) or "") if counts else None


def first_of(tensors, prefix):
    """Return the value of the first tensor of a prefix, None if there is none."""
    return next((value for name, value in tensors.items() if f"{name}.".startswith(prefix)), None)


# --- one case -------------------------------------------------------------------------------------
def judged(case, port, deadline, reveal):
    """Return {tensor: what is wrong with it} of the answer to one case."""
    try:
        if time.monotonic() >= deadline:
            raise PortError("unasked", f"not asked, because {SECONDS} s are over")
        got = port.run(case)
    except PortError as error:
        said = str(error) if error.kind == "unasked" else f"{error.kind}: {error}"
        return dict.fromkeys(expected(case.tensors), said)
    wrong = differences(case, got, reveal)
    if first_of(wrong, "out."):  # a wrong forward is not punished twice
        again = differences(case, {**got, **port.follow}, reveal)
        wrong = {n: said for n, said in wrong.items() if n.startswith("out.") or n in again}
    for name in wrong:
        part = "forward" if name.startswith("out.") else "backward"
        if name not in got and part in port.said:
            wrong[name] = f"{part}: {port.said[part]}"
    return wrong


def differences(case, got, reveal):
    """Return {tensor: what is wrong with it}; expected values are said with `reveal` only."""
    wrong = {
        name: f"{name}: dtype: {a.dtype}, expected float64"
        for name, a in got.items()
        if a.dtype.kind == "f" and a.dtype != np.float64
    }
    for f in compare(case.tensors, got, case.tolerance("float64")):
        said = f.message if f.kind == "value" else f"{f.tensor}: {f.kind}: {f.message}"
        if f.kind == "value" and not reveal:
            said = said.partition(", expected")[0] + ", which is wrong"
        wrong.setdefault(f.tensor, said)
    return wrong


# --- the grades as text, JSON and CSV -----------------------------------------------------------
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
    return "\n".join(aligned([*zip(*rows)] if len(rows[0]) > len(rows) else rows))


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
