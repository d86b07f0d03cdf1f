"""Writes a classroom: the files for students, the teacher's key, and a README with the rules."""

import json
from importlib import import_module
from pathlib import Path

from ..oracle import published
from ..scenes.output import OutputError, filled
from ..table import EQUATIONS
from .removal import functions_of, without_bodies
from .syllabus import tutorial_of

RECORD = "classroom.json"
PARTS = ("forward", "backward")
FORWARD, GRADIENTS, HARD = 4, 4, 2  # points of an equation


class ClassroomError(ValueError):
    """The folder is not a classroom, or the key is not one of an equation."""


def classroom(folder, only=None, backward_only=False, seed=None):
    """Write DIR/student/<key>.py, DIR/key/<key>.py and DIR/README.md.

    `only` lists the equations; without it all are written. With `backward_only` the forwards stay
    as they are. `seed` is the seed that `grade` uses by default; it is 0 in a new classroom. If the
    folder is a classroom already, equations are added, and the files of the students stay.

    Returns {"output", "equations": keys written, "functions": how many have to be written, "kept":
    keys left as they were}. Raises ClassroomError or OutputError.
    """
    folder = Path(folder)
    record = record_in(folder)
    old = record["equations"]
    asked_of = {key: parts_asked(key, backward_only) for key in chosen(only)}
    new = {key: asked for key, asked in asked_of.items() if asked and key not in old}
    record["equations"] = {**old, **new}
    record["seed"] = record["seed"] if seed is None else seed
    try:
        with (
            filled(folder) as top,
            filled(folder / "key") as complete,
            filled(folder / "student") as to_write,
        ):
            for key, asked in new.items():
                source, names = source_of(key), functions_of(key, asked)
                stub = without_bodies(source, names, lambda name: task(key, name))
                (complete / f"{key}.py").write_text(source, encoding="utf-8")
                (to_write / f"{key}.py").write_text(stub, encoding="utf-8")
            (top / "README.md").write_text(readme(record), encoding="utf-8")
            (top / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    except FileExistsError as error:
        raise OutputError(f"{error.filename}: expected a folder or nothing") from None
    count = sum(len(functions_of(key, asked)) for key, asked in new.items())
    return {"output": str(folder), "equations": list(new), "functions": count, "kept": sorted(old)}


def parts_asked(key, backward_only):
    """Return which of forward and backward students write."""
    parts = [] if backward_only else ["forward"]
    return [*parts, "backward"] if EQUATIONS[key].gradients else parts


def source_of(key):
    """Return the source of an equation's file."""
    return Path(import_module(EQUATIONS[key].module).__file__).read_text(encoding="utf-8")


def read_record(folder):
    """Return the contents of classroom.json.

    They have the form {"seed": 0, "equations": {"offsets": ["forward", "backward"], ...}}. Raises
    ClassroomError if the folder is not a classroom.
    """
    try:
        record = json.loads((Path(folder) / RECORD).read_text(encoding="utf-8"))
        asked = record["equations"]
        valid = (
            record["p4dgs_classroom"] == 1
            and type(record["seed"]) is int
            and set(asked) <= set(EQUATIONS)
            and all(parts and set(parts) <= set(PARTS) for parts in asked.values())
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        valid = False
    if not valid:
        raise ClassroomError(
            f"{folder}: expected a classroom, a folder with the {RECORD} of `p4dgs-ref classroom`"
        )
    return record


def record_in(folder):
    """Return the record of an existing classroom, or that of an empty one."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return {"p4dgs_classroom": 1, "seed": 0, "equations": {}}
    if not (folder / RECORD).exists():
        raise ClassroomError(
            f"{folder}: expected an empty folder, a new one or a classroom; it contains other files"
        )
    return read_record(folder)


def chosen(only):
    """Return the keys to write, in the order in which data flows."""
    for key in only or ():
        if key not in EQUATIONS:
            raise ClassroomError(f"{key!r}: expected one of {', '.join(published.equations())}")
    return [key for key in published.equations() if not only or key in only]


def task(key, name):
    """Return the message of a function that has to be written."""
    number = EQUATIONS[key].number
    return f"{key}.{name} has to be written" + (f", Eq. ({number})" if number else "")


README = """# Classroom

Each file in `student/` is one equation of the paper P-4DGS from which the bodies of some functions
have been removed. The docstring at the top contains the formula, and the comments beside the
arguments give their shapes and units. Derive the backward on paper, then write the bodies in place
of `raise NotImplementedError(...)`. The other functions without a body are helpers of these two;
write them or delete them. Import NumPy or SciPy if you need them. The table below names the
tutorial that explains each equation.

- `forward` returns a pair: the output (a tuple if there are several) and a tuple `saved` with
  everything that `backward` needs.
- `backward` returns a dictionary from input names to gradients. Some backwards keep the line that
  unpacks `saved`, which shows what the reference's forward saves. You may save something else and
  change that line.
- `p4dgs-ref grade DIR` prints your points; run it again after every change.
- In Python, `eq = school.load("DIR/student/offsets.py")` with `from p4dgs_ref import school` loads
  the equation from your file. `eq.forward` and `eq.backward` are your functions, and
  `outputs, pullback = eq.vjp(**inputs)` calls them by name.
- `key/` contains the complete files. A teacher hands out this folder without it.

## How it is graded

{WHOLE} points an equation: {FORWARD} for the forward on ordinary inputs, {GRADIENTS} for the
gradients, divided equally among the inputs, and {HARD} for the hard cases (zeros, kinks, ties,
tails, empty axes, clamps and others), half of them for outputs and half for gradients. If forward
or backward is given, or if there is no gradient, its points go to the other one. Each part counts
by its share of right answers.

- The inputs depend on the seed. They are those of the published test cases, changed at random, or
  in another order where a change would defeat the purpose of the case. The cotangents are random.
  An answer is right if it agrees with the reference within the same bounds as for the published
  vectors.
- Each equation is graded alone. Whatever your file imports from `p4dgs_ref` is the reference's
  code, not yours: `opacity.py`, for example, uses the reference's networks.
- A wrong forward is not punished twice. If yours is wrong or missing, your backward is also tried
  on what the reference's forward saves, so keep the line that unpacks `saved` until your forward
  works.
- Functions receive float64 and must return float64. Printed text is ignored, and functions that run
  for too long are stopped.
- Files may import from `p4dgs_ref` only what they imported originally. A file that asks the
  reference for the answer gets no points.

## The equations

| no. | file | tutorial | functions to write |
|---|---|---|---|
"""


def readme(record):
    """Return the text of DIR/README.md."""
    text = README.format(
        WHOLE=FORWARD + GRADIENTS + HARD, FORWARD=FORWARD, GRADIENTS=GRADIENTS, HARD=HARD
    )
    asked_of = record["equations"]
    for key in sorted(asked_of, key=published.equations().index):
        to_write = ", ".join(f"`{name}`" for name in functions_of(key, asked_of[key]))
        text += (
            f"| {EQUATIONS[key].number} | `student/{key}.py` "
            f"| `tutorials/{tutorial_of(key).name}.py` | {to_write} |\n"
        )
    return text
