"""Grades a classroom: each equation in a process of its own, with points for every right part."""

import secrets
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...oracle import published
from ...oracle.checker import check_subject
from ...oracle.compare import compare, expected
from ...oracle.ports import PortError
from ...table import EQUATIONS
from . import held_back
from .guard import copies
from .removal import unwritten
from .room import FORWARD, GRADIENTS, HARD, ClassroomError, read_record
from .student import Student

SECONDS = 30  # for all cases of an equation; the cases after that are not asked


class Part(NamedTuple):
    """One thing that gives points: the forward, one gradient, or the hard cases."""

    name: str
    of: float  # points
    prefix: str  # of the tensors that have to be right
    ordinary: bool  # whether it is about the ordinary cases or about the hard ones
    right: int = 0  # answers
    asked: int = 0

    @property
    def points(self):
        return self.of * self.right / self.asked if self.asked else 0.0


class Grade(NamedTuple):
    """The points of one equation."""

    key: str
    parts: tuple  # of Part
    first: str = ""  # the first wrong answer with its worst element
    explanation: str = ""  # the known mistake that explains the wrong answers
    hint: str = ""  # a known mistake that agrees with most of them
    flags: tuple = ()  # copies of the package; with any of them there are no points
    note: str = ""  # "not begun", "cannot be read" ...

    @property
    def of(self):
        return round(sum(part.of for part in self.parts), 6)  # fractions whose sum is an integer

    @property
    def earned(self):
        """The points without regard to flags."""
        return round(sum(part.points for part in self.parts), 6)

    @property
    def points(self):
        return 0.0 if self.flags else self.earned


class Report(NamedTuple):
    """The grades of one student in all equations, in the order in which data flows."""

    student: str  # the folder
    seed: int
    grades: tuple

    @property
    def points(self):
        return sum(grade.points for grade in self.grades)

    @property
    def of(self):
        return sum(grade.of for grade in self.grades)


def grade(
    *folders, classroom=None, seed=None, timeout=5.0, reveal=False, progress=lambda text: None
):
    """Grade what students handed in, all by the same inputs, and return a Report for each of them.

    A folder is a classroom, of which DIR/student counts, or contains a student's files itself.
    `classroom` is the one whose equations are asked for; the default is the first folder. `seed`
    determines the inputs; without it one is drawn. `timeout` is the time for one case, in seconds.
    With `reveal`, messages contain expected values. Nothing is written. Raises ClassroomError.
    """
    asked_of = read_record(folders[0] if classroom is None else classroom)["equations"]
    seed = secrets.randbelow(2**32) if seed is None else seed
    places = [files_of(folder) for folder in folders]
    reports = []
    for folder, files in zip(folders, places):
        grades = []
        for key in sorted(asked_of, key=published.equations().index):
            progress(f"grading {folder}: {key}")
            path = files / f"{key}.py"
            grades.append(grade_of(key, path, asked_of[key], seed, timeout, reveal))
        reports.append(Report(str(folder), seed, tuple(grades)))
    return tuple(reports)


def files_of(folder):
    """Return the folder with a student's files."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ClassroomError(f"{folder}: expected a folder with the files of a student")
    return folder / "student" if (folder / "student").is_dir() else folder


def parts_of(key, asked):
    """Return the parts of an equation with the functions `asked` to write, worth 10 points."""
    gradients = EQUATIONS[key].gradients if "backward" in asked else ()
    forward = "forward" in asked
    share = 1 if forward and gradients else 2  # one of the two takes all points
    parts = [
        Part(f"gradient of {name}", share * GRADIENTS / len(gradients), f"in_bar.{name}.", True)
        for name in gradients
    ]
    if forward:
        parts.insert(0, Part("forward", share * FORWARD, "out.", True))
        parts.append(Part("hard cases: outputs", share * HARD / 2, "out.", False))
    if gradients:
        parts.append(Part("hard cases: gradients", share * HARD / 2, "in_bar.", False))
    return parts


def grade_of(key, path, asked, seed, timeout, reveal):
    """Return the Grade of one file."""
    parts = parts_of(key, asked)
    nothing = Grade(key, tuple(parts))
    try:
        source = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return nothing._replace(note=f"{path.name}: expected a file of Python text")
    try:
        flags = tuple(copies(source, key, asked))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        return nothing._replace(
            first=f"{path.name}: {type(error).__name__}: {error}", note="cannot be read"
        )
    if all(unwritten(source, name) for name in asked):
        return nothing._replace(note="not begun")
    first = explanation = hint = ""
    deadline = time.monotonic() + SECONDS
    with Student(path, timeout) as port:
        for case in held_back.cases(key, seed):
            wrong = judged(case, port, deadline, reveal)
            for i, part in enumerate(parts):
                if counts(part, case):
                    said = first_of(wrong, part.prefix)
                    parts[i] = part._replace(right=part.right + (not said), asked=part.asked + 1)
                    if said and not first:
                        first = f"{case.id}: {said}"
        if first:
            explanation, hint = explained(key, port)
    return Grade(key, tuple(parts), first, explanation, hint, flags)


def counts(part, case):
    """Whether a part counts this case: of its kind, with a tensor that has to be right."""
    asked = any((name + ".").startswith(part.prefix) for name in expected(case.tensors))
    return asked and part.ordinary == held_back.is_ordinary(case)


def first_of(wrong, prefix):
    """Return what is wrong with the first tensor of a prefix, "" if nothing."""
    return next((said for name, said in wrong.items() if (name + ".").startswith(prefix)), "")


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
        wrong = {
            name: said
            for name, said in wrong.items()
            if name in again or not name.startswith("in_bar.")
        }
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


def explained(key, port):
    """Return what the doctor says of the answers to the published cases: explanation and hint.

    The held-back cases cannot be used for this, because the wrong answers to them are not known.
    """
    wrong = [r for r in check_subject(published.cases(key), port) if r.findings]
    explanation = next((r.explanation for r in wrong if r.explanation), "")
    return explanation, next((r.hint for r in wrong if r.hint), "")
