"""Grades a classroom: each equation in a process of its own, with points for every right part.

Points come from held-back inputs. What is said about a wrong answer comes from the published cases,
in the words of the tutorials' exercises.

The grades of a class have the form of grades.json: a dictionary with the seed, the students, who
have a row for every equation, which has its parts, and the pairs of students whose files are alike.
"""

import json
import secrets
from itertools import combinations
from pathlib import Path

from ...lessons import problem, tutorial_of
from ...oracle import published
from ...oracle.compare import compare, expected
from ...oracle.ports import PortError
from ...oracle.report import name_of
from ...output import staged_folder
from ...report.figures import write_csv
from ...scenes.fields import printable
from ...splatting.table import EQUATIONS
from ..writer import text_table
from .held_back import cases, is_ordinary
from .room import (
    ClassroomError,
    files_of,
    keys_of,
    modules_of,
    parts_of,
    sources_of,
    stubs_of,
    text_of,
)
from .student import Student, alike, copies, functions, joined, same_lines, unusual

FORWARD, GRADIENTS, HARD = 3, 3, 4  # points of an equation
ROLES = {"forward": "out.", "backward": "in_bar.", "follow": "in_bar."}
# The forwards of these save slopes, from which their backwards follow in a line or two.
SAVES_SLOPES = {"hash_grid", "step", "likelihood"}
ALL_LINES = "all lines of the key"  # what was copied, where functions are short


def grade(*folders, classroom=None, seed=None, progress=lambda text: None):
    """Grade what students handed in, all by the same inputs, and compare it in pairs.

    A folder contains a student's files, or a folder `student` with them, as a classroom does.
    `classroom` is the one whose equations are asked for; the default is the first folder. `seed`
    determines the inputs; without it one is drawn. Nothing is written. Raises ClassroomError.
    """
    keys = keys_of(folders[0] if classroom is None else classroom)
    seed = secrets.randbelow(2**32) if seed is None else seed
    places = [files_of(folder) for folder in folders]
    names = [printable(folder) for folder in folders]
    students, works = [], []
    for name, files in zip(names, places):
        progress(f"grading {name}")
        read = {key: source_in(files, key) for key in keys}
        works.append({key: source for key, (source, _) in read.items()})
        whole = same_lines(works[-1], {key: joined(sources_of(key)) for key in keys})
        rows = [row_of(key, files, *read[key], key in whole, seed) for key in keys]
        students.append(
            {
                "student": name,
                "points": round(sum(row["points"] for row in rows), 4),
                "of": sum(row["of"] for row in rows),
                "equations": rows,
            }
        )
    pairs = [
        {"students": [one, other], "equations": sorted(alike(a, b) | alike(b, a))}
        for (one, a), (other, b) in combinations(zip(names, works), 2)
    ]
    return {"seed": seed, "students": students, "alike": [p for p in pairs if p["equations"]]}


# --- one equation ---------------------------------------------------------------------------------
def source_in(folder, key):
    """Return what a student wrote of an equation and "", or "" and why it is not graded."""
    files = {}
    for name in modules_of(key):
        try:
            files[name] = text_of(folder / f"{name}.py")
            functions(files[name])
        except ClassroomError as error:
            return "", f"{name}.py: {error}"
        except (OSError, ValueError, SyntaxError, RecursionError, MemoryError) as error:
            return "", f"{name}.py cannot be read: {type(error).__name__}: {error}"
    return ("", "not begun") if files == stubs_of(key) else (joined(files), "")


def row_of(key, files, source, says, is_whole, seed):
    """Return the row of one equation; `says` is why its file is not graded, if it is not.

    In the row, `says` is the reason why points are missing. `flags` are copies; with any of them
    there are no points. `unusual` are names that no equation needs; they cost no points.
    """
    row = {
        "number": EQUATIONS[key].number,
        "key": key,
        "tutorial": tutorial_of(key).name,
        "points": 0.0,
        "of": FORWARD + GRADIENTS + HARD,
        "flags": [],
        "unusual": unusual(source),
        "parts": [],
        "says": says,
    }
    if says:
        return row
    flags = copies(source, key) or [ALL_LINES] * is_whole
    with Student(files / f"{key}.py") as student:
        parts = marks(key, student, cases(key, seed))
        points = round(sum(part["points"] for part in parts), 4)
        says = reason(key, student) if points < row["of"] else ""
    if flags:
        points, says = 0.0, f"{points:g} points withheld, copied: {', '.join(flags)}\n{says}"
    return {**row, "points": points, "flags": flags, "parts": parts, "says": says}


def marks(key, student, cases):
    """Return the parts of an equation with their points, by the share of right answers."""
    wrong = {case.id: wrong_in(case, student, "forward") for case in cases}
    for case in cases:
        again = wrong[case.id] and key not in SAVES_SLOPES  # a wrong forward is not punished twice
        mine = wrong_in(case, student, "follow" if again else "backward")
        if again and mine:
            mine &= wrong_in(case, student, "backward")
        wrong[case.id] |= mine
    parts = []
    for name, of, prefix, ordinary in points_of(key):
        is_wrong = [
            any(f"{tensor}.".startswith(prefix) for tensor in wrong[case.id])
            for case in cases
            if is_ordinary(case) == ordinary
            if any(f"{tensor}.".startswith(prefix) for tensor in expected(case.tensors))
        ]
        right, asked = is_wrong.count(False), len(is_wrong)
        points = of * right / max(asked, 1)
        parts.append({"name": name, "points": points, "of": of, "right": right, "asked": asked})
    return parts


def points_of(key):
    """Return what gives points: name, points, prefix of tensors, whether about ordinary cases."""
    names = EQUATIONS[key].gradients
    share = 1 if names else 2  # without gradients, outputs take all points
    return [
        ("forward", share * FORWARD, "out.", True),
        *(
            (f"gradient of {name}", GRADIENTS / len(names), f"in_bar.{name}.", True)
            for name in names
        ),
        ("hard cases: outputs", share * HARD / 2, "out.", False),
        *[("hard cases: gradients", HARD / 2, "in_bar.", False)] * bool(names),
    ]


def wrong_in(case, student, part):
    """Return the names of the outputs or gradients of a case that are wrong or missing."""
    role = ROLES[part]
    try:
        findings = compare(case.tensors, student.part(part).run(case), case.tolerance("float64"))
        return {finding.tensor for finding in findings if finding.tensor.startswith(role)}
    except PortError:
        return {name for name in expected(case.tensors) if name.startswith(role)}


def reason(key, student):
    """Return what is wrong with the forward or the backward on the published cases."""
    problems = (
        (part, problem(published.cases(key), student.part(part), (ROLES[part],)))
        for part in parts_of(key)
    )
    unseen = "right on the published cases, wrong on inputs that are held back"
    return next((f"{part}: {message}" for part, message in problems if message), unseen)


# --- the grades as text, JSON and CSV -----------------------------------------------------------
def rows_of(grades):
    """Return the table of a class: a row for each student, with the points of every equation."""
    return [
        {
            "student": student["student"],
            **{row["key"]: row["points"] for row in student["equations"]},
            "points": student["points"],
            "of": student["of"],
            "copied": sum(bool(row["flags"]) for row in student["equations"]),
            "alike": sum(student["student"] in pair["students"] for pair in grades["alike"]),
            "unusual": " ".join(
                sorted({n for row in student["equations"] for n in row["unusual"]})
            ),
            "seed": grades["seed"],
        }
        for student in grades["students"]
    ]


def to_text(grades):
    """Return the sums of all students as a table, who are alike, and then the details of each."""
    sums = ("student", "points", "of", "copied", "alike", "seed", "unusual")
    lines = text_table({name: f"{{{name}}}" for name in sums}, rows_of(grades))
    pairs = [
        f"    {' and '.join(pair['students'])}: {', '.join(pair['equations'])}"
        for pair in grades["alike"]
    ]
    lines += ["", "alike, which alone does not prove that anybody copied:", *pairs] * bool(pairs)
    return "\n\n".join(["\n".join(lines), *map(details, grades["students"])])


def details(student):
    """Return the points of a student by equation, with what is wrong."""
    lines = [student["student"]]
    for row in student["equations"]:
        parts = [
            f"{part['name']} {part['right']} of {part['asked']}"
            for part in row["parts"]
            if part["right"] < part["asked"]
        ]
        points = f"{row['points']:5.2f} of {row['of']}"
        lines.append(f"{name_of(row['key']):<28}  {points}  {', '.join(parts)}".rstrip())
        lines += [f"    unusual: {' '.join(row['unusual'])}"] * bool(row["unusual"])
        lines += [f"    {line}" for line in row["says"].splitlines()]
    return "\n".join(lines)


def write(grades, folder):
    """Write grades.txt, grades.json and grades.csv to a folder. Raises OutputError."""
    with staged_folder(Path(folder)) as staging:
        (staging / "grades.txt").write_text(to_text(grades) + "\n", encoding="utf-8")
        (staging / "grades.json").write_text(json.dumps(grades, indent=1) + "\n", encoding="utf-8")
        write_csv(staging / "grades.csv", rows_of(grades))
