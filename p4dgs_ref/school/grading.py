"""Grades a classroom: every equation in a process of its own, on held-back inputs, with credit for each part."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..equations import EQUATIONS
from ..oracle import doctor
from ..oracle.checker import sentence
from ..oracle.compare import Finding, compare, precision
from ..oracle.ports import PortError
from ..oracle.subjects import FLOW, subjects
from . import held_back
from .guard import suspicions
from .removal import unwritten
from .room import ClassroomError, read_record
from .student import Student

FORWARD, GRADIENTS, HARD = 4, 4, 2  # points of an equation
SECONDS = 30  # for all cases of an equation, after which the rest is not asked


class Part(NamedTuple):
    """One thing that gives points: the forward, the gradient of one input, the hard cases of either."""

    name: str
    of: float  # points
    right: int  # answers
    asked: int

    @property
    def points(self):
        return self.of * self.right / self.asked if self.asked else 0.0


class Grade(NamedTuple):
    """How one equation stands."""

    key: str
    parts: tuple  # Part
    first: str  # what failed first, with its worst element; empty if nothing did
    explanation: str  # a known mistake that explains it
    flags: (
        tuple  # what the file does to get at the reference; points are withheld where there is any
    )
    note: str  # "", "not begun", "missing" ...

    @property
    def of(self):
        return round(sum(part.of for part in self.parts), 6)  # thirds and sixths add up to a whole

    @property
    def earned(self):
        """Points before flags."""
        return round(sum(part.points for part in self.parts), 6)

    @property
    def points(self):
        return 0.0 if self.flags else self.earned


class Report(NamedTuple):
    """All grades, in the order in which data flows."""

    seed: int
    grades: tuple

    @property
    def points(self):
        return sum(grade.points for grade in self.grades)

    @property
    def of(self):
        return sum(grade.of for grade in self.grades)


def grade(folder, seed=None, student=None, timeout=5.0, progress=lambda text: None):
    """Grade DIR/student, or the files in another folder `student`; nothing is written.

    `seed` draws the held-back inputs, by default the classroom's; `timeout` in seconds, for one case.

    Returns    Report; see `marks` for its text, JSON and CSV
    Raises     ClassroomError
    """
    record = read_record(folder)
    files = Path(student) if student is not None else Path(folder) / "student"
    if not files.is_dir():
        raise ClassroomError(f"{files}: expected a folder with the files of a student")
    seed = record["seed"] if seed is None else seed
    grades, known = [], subjects()
    for key in FLOW:
        if key in record["equations"]:
            progress(f"grading {key}")
            grades.append(
                _equation(known[key], files / f"{key}.py", record["equations"][key], seed, timeout)
            )
    return Report(seed, tuple(grades))


def parts_of(key, asked):
    """{name of a part: its points} of an equation whose functions `asked` are to be written."""
    inputs = EQUATIONS[key].differentiable if "backward" in asked else ()
    both, hard = "forward" in asked and inputs, {}
    share = 1 if both else 2
    parts = {"forward": FORWARD + (0 if both else GRADIENTS)} if "forward" in asked else {}
    parts.update(
        {
            f"gradient of {name}": (GRADIENTS + (0 if both else FORWARD)) / len(inputs)
            for name in inputs
        }
    )
    if "forward" in asked:
        hard["hard cases: outputs"] = HARD / 2 * share
    if inputs:
        hard["hard cases: gradients"] = HARD / 2 * share
    return {**parts, **hard}


def _equation(subject, path, asked, seed, timeout):
    """The grade of one file."""
    worth = parts_of(subject.key, asked)
    nothing = tuple(Part(name, of, 0, 0) for name, of in worth.items())
    try:
        source = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return Grade(
            subject.key, nothing, "", "", (), f"{path.name}: expected a file of Python text"
        )
    if all(unwritten(source, name) for name in asked):
        return Grade(subject.key, nothing, "", "", (), "not begun")
    try:
        flags = tuple(suspicions(source, subject.key))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        return Grade(
            subject.key,
            nothing,
            f"{path.name}: {type(error).__name__}: {error}",
            "",
            (),
            "cannot be read",
        )
    counts, first, answers, begun = {name: [0, 0] for name in worth}, "", [], time.monotonic()
    with Student(path, timeout) as port:
        for case in held_back.cases(subject, seed):
            left = SECONDS - (time.monotonic() - begun)
            wrong, why, got = (
                _case(case, port) if left > 0 else ({}, f"not asked: {SECONDS} s are over", None)
            )
            for name, verdict in _verdicts(case, worth, wrong, got).items():
                counts[name][0] += not verdict
                counts[name][1] += 1
                if verdict and not first:
                    first = f"{case.id}: {why if got is None else verdict}"
            if got:
                answers.append((case, got))
    said = _explained(subject.key, answers) if first else ""
    return Grade(
        subject.key,
        tuple(Part(name, worth[name], *counts[name]) for name in worth),
        first,
        said,
        flags,
        "",
    )


def _case(case, port):
    """({tensor: what is wrong}, why there is no answer at all, {tensor: array} or None) of one case."""
    try:
        got = port.run(case)
    except PortError as error:
        return {}, f"{error.kind}: {error}", None
    bound = case.tolerance("float64")
    wrong = _wrong(case, got, bound)
    if any(name.startswith("out.") for name in wrong):  # a wrong forward is not punished twice
        follow = {**got, **port.follow}
        again = _wrong(case, follow, bound)
        for name in [n for n in wrong if n.startswith("in_bar.") and n not in again]:
            del wrong[name]
            got[name] = follow[name]
    for name in wrong:
        reason = port.said.get("forward" if name.startswith("out.") else "backward")
        if name not in got and reason:
            wrong[name] = f"{'forward' if name.startswith('out.') else 'backward'}: {reason}"
    return wrong, "", got


def _wrong(case, got, bound):
    """{tensor: what is wrong with it}."""
    strange = [
        Finding(name, "dtype", f"{a.dtype}, expected float64")
        for name, a in got.items()
        if a.dtype.kind == "f" and a.dtype != np.float64
    ]
    found = [*strange, *compare(case.tensors, got, bound)]
    return {
        f.tensor: f.message if f.kind == "value" else f"{f.tensor}: {f.kind}: {f.message}"
        for f in reversed(found)
    }


def _verdicts(case, worth, wrong, got):
    """{part: what is wrong, empty if right} of the parts that this case counts for."""

    def worst(prefixes):
        if got is None:
            return "no answer"
        return next((said for name, said in wrong.items() if (name + ".").startswith(prefixes)), "")

    ordinary, gradients = (
        tuple(case.record["flags"]) == ("ordinary",),
        any(n.startswith("in_bar.") for n in case.tensors),
    )
    found = {}
    for name in worth:
        if name.startswith("hard"):
            role = "out." if name.endswith("outputs") else "in_bar."
            if not ordinary and (role == "out." or gradients):
                found[name] = worst((role,))
        elif ordinary:
            found[name] = worst(
                ("out.",)
                if name == "forward"
                else (f"in_bar.{name.removeprefix('gradient of ')}.",)
            )
    return found


def _explained(key, answers):
    """The known mistakes that explain the outputs where those are wrong, else the gradients; empty if none does.

    What is not written yet is no mistake: a case counts with what was answered alone.
    """
    for role in ("out.", "in_bar."):
        asked = []
        for case, got in answers:
            mine = {name: a for name, a in got.items() if name.startswith(role)}
            case = case._replace(
                tensors={
                    name: a
                    for name, a in case.tensors.items()
                    if name in mine or not name.startswith(("out.", "in_bar."))
                }
            )
            if mine:
                asked.append((case, mine, bool(_wrong(case, mine, case.tolerance("float64")))))
        if any(wrong for _, _, wrong in asked):
            found = doctor.explain(
                key, [row for row in asked if row[0].tolerance(precision(row[1]))]
            )
            return sentence(
                [row for row in found if 2 * row[1] >= row[2]]
            )  # what explains a few cases misleads
    return ""
