"""Writes a classroom: the students' files, the teacher's key, and a README that says what is asked."""

import json
from importlib import import_module
from pathlib import Path

from ..equations import EQUATIONS
from ..oracle.subjects import FLOW
from ..scenes.output import OutputError, filled
from ..syllabus import tutorial_of
from .removal import functions_of, without_bodies

RECORD = "classroom.json"
PARTS = ("forward", "backward")


class ClassroomError(ValueError):
    """A folder that is no classroom, or a key that is no equation: one line saying what was expected."""


def classroom(folder, only=None, backward_only=False, seed=None):
    """Write DIR/student/<key>.py, DIR/key/<key>.py and DIR/README.md.

    `only` names the equations (all by default); `backward_only` leaves the forwards as they are; `seed` is the one that
    `grade` takes by default, 0 at first.  In a folder that is a classroom already, equations are added, and what a student
    has stays.

    Returns    {"output", "equations": keys written, "functions": how many were emptied, "kept": keys left as they were}
    Raises     ClassroomError, output.OutputError
    """
    parts, folder = PARTS[1:] if backward_only else PARTS, Path(folder)
    record, new = _record(folder), {}
    for key in _chosen(only):
        asked = [part for part in parts if part == "forward" or EQUATIONS[key].differentiable]
        if asked and key not in record["equations"]:
            new[key] = asked
    kept = sorted(record["equations"])
    record = {
        **record,
        "seed": record["seed"] if seed is None else seed,
        "equations": {**record["equations"], **new},
    }
    emptied = 0
    try:
        with (
            filled(folder) as top,
            filled(folder / "key") as full,
            filled(folder / "student") as open_,
        ):
            for key, asked in new.items():
                source, names = source_of(key), functions_of(key, asked)
                emptied += len(names)
                (full / f"{key}.py").write_text(source, encoding="utf-8")
                (open_ / f"{key}.py").write_text(
                    without_bodies(source, names, lambda name: _task(key, name)), encoding="utf-8"
                )
            (top / "README.md").write_text(readme(record), encoding="utf-8")
            (top / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    except FileExistsError as error:
        raise OutputError(f"{error.filename}: expected a folder or nothing") from None
    return {"output": str(folder), "equations": list(new), "functions": emptied, "kept": kept}


def source_of(key):
    """The file of an equation as text."""
    return Path(import_module(EQUATIONS[key].module).__file__).read_text(encoding="utf-8")


def read_record(folder):
    """What classroom.json says: {"seed": 0, "equations": {"offsets": ["forward", "backward"], ...}}.

    Raises     ClassroomError
    """
    path = Path(folder) / RECORD
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        right = (
            record["p4dgs_classroom"] == 1
            and type(record["seed"]) is int
            and set(record["equations"]) <= set(EQUATIONS)
            and all(parts and set(parts) <= set(PARTS) for parts in record["equations"].values())
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        right = False
    if not right:
        raise ClassroomError(
            f"{folder}: expected a classroom, a folder with the {RECORD} of `p4dgs-ref classroom`"
        )
    return record


def _record(folder):
    """The record of a classroom that is there already, or that of an empty one."""
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / RECORD).exists():
            raise ClassroomError(
                f"{folder}: expected an empty folder, a new one or a classroom; there are other files in it"
            )
        return read_record(folder)
    return {"p4dgs_classroom": 1, "seed": 0, "equations": {}}


def _chosen(only):
    for key in only or ():
        if key not in EQUATIONS:
            raise ClassroomError(f"{key!r}: expected one of {', '.join(FLOW)}")
    return [key for key in FLOW if not only or key in only]


def _task(key, name):
    number = EQUATIONS[key].number
    return f"{key}.{name}: yours to write" + (f", Eq. ({number})" if number else "")


README = """# Classroom

Each file in `student/` is one equation of the paper P-4DGS with the bodies of some functions taken out. Read the
docstring, which says shapes, units, domain and every choice; derive the backward on paper; write the body in place of
`raise NotImplementedError(...)`. Nothing else in the file needs to change. The tutorial named below explains the equation.

- `p4dgs-ref grade DIR` says how far you are; again after every change.
- In Python, `school.load("DIR/student/offsets.py")` with `from p4dgs_ref import school` gives the equation in your file:
  call its `forward` and `backward`, and look at its `cases()` where they do not need what is not written yet.
- `key/` has the complete files. A teacher hands out this folder without it.

## How it is graded

{WHOLE} points an equation: {FORWARD} for the forward on ordinary inputs, {GRADIENTS} for the gradients, in equal parts
for each input, {HARD} for the hard cases (zeros, kinks, ties, tails, empty axes, clamps ...), half of them for outputs and
half for gradients. Where one of forward and backward is given or there is no gradient, its points go to the other. Parts
count by the share of right answers.

- Inputs are drawn by the seed: those of the project's test cases, changed at random, or in another order where a
  change would undo what the case is about; cotangents are random. Right is what the reference answers, within the bounds
  that the golden vectors grant too.
- Every equation is graded alone: what your file imports from `p4dgs_ref` is the reference's, not yours. `opacity.py` works
  with the reference's `mlp`, whether or not you have written `mlp.py`.
- A wrong forward is not punished twice: where yours is wrong or missing, your backward is tried on what the reference's
  forward remembers, provided that `Res` still has the fields it came with.
- Functions get float64 and must return float64. What you print is ignored; what loops for ever is stopped.
- Files may import from `p4dgs_ref` what they came with, nothing more: points are withheld from a file that asks the
  reference for the answer.

## The equations

| no. | file | tutorial | yours to write |
|---|---|---|---|
"""


def readme(record):
    """The text of DIR/README.md."""
    from .grading import FORWARD, GRADIENTS, HARD

    head = README
    for name, value in {
        "WHOLE": FORWARD + GRADIENTS + HARD,
        "FORWARD": FORWARD,
        "GRADIENTS": GRADIENTS,
        "HARD": HARD,
    }.items():
        head = head.replace("{" + name + "}", str(value))
    rows = [
        f"| {EQUATIONS[key].number} | `student/{key}.py` | `tutorials/{tutorial_of(key).name}.py` | "
        + ", ".join(f"`{name}`" for name in functions_of(key, record["equations"][key]))
        + " |"
        for key in FLOW
        if key in record["equations"]
    ]
    return head + "\n".join(rows) + "\n"
