"""Grades a classroom: each equation in its own process, with points for each right part.

Points come from held-back inputs: the published cases of an equation, changed by a seed. Comments
on wrong answers come from the published cases, in the words of the tutorials' exercises.

The grades of a class are a dictionary with the seed, the students, who have a row for every
equation, and the pairs of students whose files are alike.
"""

from functools import cache

import numpy as np

from ...lessons import exercise_cases, problem
from ...oracle import published, tolerance
from ...oracle.compare import change_floats, compare, expected_tensors
from ...oracle.ports import PortError
from ...splatting.table import EQUATIONS
from ..writer import text_table
from .room import files_of, keys_of, parts_of, stub, text_of
from .similar import pairs, statements, unusual
from .student import Minute, Student

NOT_BEGUN = "not begun"
POINTS = 10  # of an equation, divided among the parts that it has in these shares:
SHARES = {"forward": 3, "gradients": 3, "hard cases": 4}
ROLES = {"forward": "out.", "backward": "in_bar."}
# Cases with these flags or names would lose their purpose if numbers changed. Their inputs stay;
# their cotangents are new.
FLAGS_OF_KEPT_INPUTS = {
    *("kink", "tie", "clamped", "outside", "order", "extreme", "tail", "narrow", "wide"),
    *("behind", "normalise", "identical", "H-P7.identical"),
}


def grade(*folders, classroom=None, seed=None, progress=lambda text: None):
    """Grade what students handed in, all on the same inputs, and compare their files.

    A folder contains a student's files, or a folder `student` with them, as a classroom does. The
    equations of `classroom` are graded; the default is the first folder. `seed` determines the
    inputs; the default is a random one. Nothing is written. Raises StudyError.
    """
    keys = keys_of(folders[0] if classroom is None else classroom)
    places = {str(folder): files_of(folder) for folder in folders}
    seed = np.random.SeedSequence().entropy % 2**32 if seed is None else seed
    students, works = [], []
    for name, files in places.items():
        progress(f"grading {name}")
        minute, read = Minute(), {key: source_in(files, key) for key in keys}
        works.append((name, {key: source for key, (source, _) in read.items()}))
        rows = [row_of(key, files, *read[key], seed, minute) for key in keys]
        points = round(sum(row["points"] for row in rows), 1)
        students.append(
            {"student": name, "points": points, "of": POINTS * len(rows), "equations": rows}
        )
    return {"seed": seed, "students": students, "alike": pairs(works)}


# --- one equation ---------------------------------------------------------------------------------
def source_in(folder, key):
    """Return what a student wrote of an equation and "", or "" and why it is not graded."""
    try:
        source = text_of(folder / f"{key}.py")
        statements(source)
    except (OSError, ValueError, SyntaxError, RecursionError, MemoryError) as error:
        return "", f"{key}.py: {type(error).__name__}: {error}"
    return ("", NOT_BEGUN) if source == stub(key) else (source, "")


def row_of(key, files, source, says, seed, minute):
    """Return the row of one equation; `says` is why its file is not graded, if it is not.

    `minute` is the time left for all answers of the student. In the row, `says` is the reason why
    points are missing, and `unusual` lists names that no equation needs; they cost no points.
    """
    parts, points = {}, 0.0
    if not says:
        with Student(files / f"{key}.py", minute) as student:
            parts = marks(key, student, cases(key, seed))
            shares = [right / asked for right, asked in parts.values()]
            points = POINTS * np.average(shares, weights=[SHARES[part] for part in parts])
            says = "" if points == POINTS else reason(key, student)
            points = min(round(float(points), 1), 9.9 if says else POINTS)
    return {
        "number": EQUATIONS[key].number,
        "key": key,
        "points": points,
        "parts": {part: f"{right} of {asked}" for part, (right, asked) in parts.items()},
        "unusual": " ".join(unusual(source)),
        "says": says,
    }


def marks(key, student, cases):
    """Return {part: (right, asked)}: how many outputs and gradients in all cases are right."""
    right = {part: [] for part in SHARES}
    for case in cases:
        wrong = set().union(*(wrong_in(case, student, part) for part in parts_of(key)))
        for name in expected_tensors(case.tensors):
            ordinary = "forward" if name.startswith("out.") else "gradients"
            right[ordinary if is_ordinary(case) else "hard cases"].append(name not in wrong)
    return {part: (sum(answers), len(answers)) for part, answers in right.items() if answers}


def wrong_in(case, student, part):
    """Return the names of the outputs or gradients of a case that are wrong or missing."""
    asked = {name for name in expected_tensors(case.tensors) if name.startswith(ROLES[part])}
    try:
        findings = compare(case.tensors, student.part(part).run(case), case.tolerance("float64"))
    except PortError:
        return asked
    return asked & {finding.tensor for finding in findings}


def reason(key, student):
    """Return what is wrong on the published cases, once for the forward and once for the backward.

    A backward that fails just as the forward does is not mentioned.
    """
    parts = {}  # {message: part}
    for part in parts_of(key):
        message, _ = problem(exercise_cases(key), student.part(part), (ROLES[part],))
        parts.setdefault(message, part)
    lines = [f"{part}: {message}" for message, part in parts.items() if message]
    return "\n".join(lines) or "right on the published cases, wrong on held-back inputs"


# --- inputs that are held back -------------------------------------------------------------------
def is_ordinary(case):
    """Return whether a case has typical inputs."""
    return case.record["flags"] == ["ordinary"]


@cache
def cases(key, seed):
    """Return held-back cases of an equation: three per ordinary published case, one per other case.

    They have the form of published cases and are drawn once for all students of a seed.
    """
    return [
        random_case(case, f"{case.id}#{i + 1}", seed)
        for case in exercise_cases(key)
        for i in range(3 if is_ordinary(case) else 1)
    ]


def random_case(case, id, seed):
    """Return a case with changed inputs, new cotangents and the reference's answers."""
    eq, inputs = EQUATIONS[case.equation], case.inputs()
    rng = np.random.default_rng([seed, *id.encode()])
    if not FLAGS_OF_KEPT_INPUTS & {case.name, *case.record["flags"]}:
        inputs = change_floats(inputs, lambda a: scale_rows(a, rng))
    cotangents = tolerance.cotangents_of(eq, eq(**inputs), f"{seed}/{id}")
    answer = tolerance.answer_of(eq)
    answers = answer(inputs, cotangents)
    scales = tolerance.scales(answer, inputs, cotangents, answers, id)
    tensors = {
        **published.flatten(inputs, "in."),
        **published.flatten({n.removesuffix("_bar"): a for n, a in cotangents.items()}, "out_bar."),
        **answers,
        **published.flatten(scales, "scale."),
    }
    return case._replace(id=id, tensors=tensors)


def scale_rows(a, rng):
    """Return an array whose rows are multiplied by random numbers; unit vectors stay.

    Factors from 0.8 to 1 preserve signs, zeros and upper bounds on magnitudes; one factor per row
    leaves covariances symmetric and conics positive definite.
    """
    lengths = np.linalg.norm(a, axis=-1) if a.shape[-1:] in ((3,), (4,)) else 0
    if np.allclose(lengths, 1, rtol=0, atol=1e-9):
        return a
    return (a * rng.uniform(0.8, 1, a.shape[:1] + (1,) * (a.ndim - 1))).astype(a.dtype)


# --- the grades as rows and as text ---------------------------------------------------------------
def rows_of(grades):
    """Return the table of a class: a row for each student, with the points of every equation."""
    return [
        {
            "student": cell(student["student"]),
            **{row["key"]: row["points"] for row in student["equations"]},
            "points": student["points"],
            "of": student["of"],
            "alike": sum(student["student"] in pair["students"] for pair in grades["alike"]),
            "unusual": " ".join(filter(None, (row["unusual"] for row in student["equations"]))),
            "seed": grades["seed"],
        }
        for student in grades["students"]
    ]


def cell(text):
    """Return a text as a cell, with an apostrophe where a spreadsheet would see a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def to_text(grades):
    """Return a table of the students' sums, the pairs that are alike, and the details of each."""
    names = ("student", "points", "of", "alike", "seed", "unusual")
    lines = text_table({name: f"{{{name}}}" for name in names}, rows_of(grades))
    alike = [f"    {' and '.join(p['students'])}: {', '.join(p['keys'])}" for p in grades["alike"]]
    if alike:
        lines += ["", "alike, which alone does not prove copying:", *alike]
    return "\n\n".join(["\n".join(lines), *map(details, grades["students"])])


def details(student):
    """Return the points of a student for each equation, and what is wrong."""
    lines, rows = [student["student"]], student["equations"]
    left = [row["key"] for row in rows if row["says"] == NOT_BEGUN]
    if left:
        lines.append(f"{NOT_BEGUN}: {', '.join(left)}")
    for row in (row for row in rows if row["key"] not in left):
        parts = ", ".join(f"{part} {right}" for part, right in row["parts"].items())
        lines.append(f"{row['key']:<20}  {row['points']:4.1f} of {POINTS}  {parts}".rstrip())
        lines += [f"    {line}" for line in row["says"].splitlines()]
    return "\n".join(lines)
