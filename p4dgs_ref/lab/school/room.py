"""Writes a classroom: the files for students, the teacher's key, and a README with the rules."""

import ast
import inspect
import json
import re
from importlib import import_module
from itertools import takewhile
from pathlib import Path

from ...oracle import published
from ...scenes.output import filled
from ...table import EQUATIONS
from .syllabus import tutorial_of

RECORD = "classroom.json"
FORWARD, GRADIENTS, HARD = 3, 3, 4  # points of an equation
# Functions that contain the answer as well. They are removed together with forward or backward.
HELPERS = {
    ("compositing", "forward"): ("alphas", "transmittances"),
    ("covariance", "forward"): ("rotation_matrix",),
    ("deformed", "forward"): ("as_printed", "moved"),
    ("hash_grid", "forward"): ("locate", "nodes", "entries", "query"),
    ("hash_rate", "forward"): ("entropy",),
    ("likelihood", "forward"): (
        "literal",
        "rate",
        "around_the_mean",
        "beside_the_mean",
        "far_from_the_mean",
        "narrow_bin",
    ),
    ("likelihood", "backward"): ("slopes",),
    ("masking", "backward"): ("scatter",),
    ("ssim", "forward"): ("dissimilarity",),
}
# The forwards of these save slopes, from which their backwards follow in a line or two.
SAVES_SLOPES = {"hash_grid", "step", "likelihood"}
# Files with half of an equation: students write their functions in the equation's own file.
MERGED = {"hash_grid": "grid_nodes"}


class ClassroomError(ValueError):
    """The folder is not a classroom, or the key is not one of an equation."""


def classroom(folder, only=None):
    """Write DIR/student/<key>.py, DIR/key/<key>.py and a README.md for each of the two readers.

    `only` lists the equations; without it all are written. If the folder is a classroom already,
    equations are added, and the files of the students stay.

    Returns {"output", "equations": keys written, "functions": how many have to be written, "kept":
    keys left as they were}. Raises ClassroomError or OutputError.
    """
    folder = Path(folder)
    old = keys_in(folder)
    new = [key for key in chosen(only) if key not in old]
    record = json.dumps(record_of([*old, *new]), indent=1) + "\n"
    files = {"README.md": readme([*old, *new]), "key/README.md": TEACHER, RECORD: record}
    for key in new:
        files |= {f"key/{key}.py": source_of(key), f"student/{key}.py": stub_of(key)}
    with filled(folder) as beside:
        for name, text in files.items():
            (beside / name).parent.mkdir(exist_ok=True)
            (beside / name).write_text(text, encoding="utf-8")
    count = sum(len(functions_of(key)) for key in new)
    return {"output": str(folder), "equations": new, "functions": count, "kept": sorted(old)}


def record_of(keys):
    """Return the contents of classroom.json."""
    return {"p4dgs_classroom": 1, "equations": {key: parts_of(key) for key in keys}}


def keys_of(folder):
    """Return the equations of a classroom. Raises ClassroomError if the folder is not one."""
    try:
        record = json.loads((Path(folder) / RECORD).read_text(encoding="utf-8"))
        valid = record == record_of(record["equations"])
    except (OSError, ValueError, KeyError, TypeError):
        valid = False
    if not valid:
        raise ClassroomError(
            f"{folder}: expected a classroom, a folder with the {RECORD} of `p4dgs-ref classroom`"
        )
    return list(record["equations"])


def keys_in(folder):
    """Return the equations of an existing classroom, or none of a folder that is to become one."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return []
    if not (folder / RECORD).exists():
        raise ClassroomError(
            f"{folder}: expected an empty folder, a new one or a classroom; it contains other files"
        )
    return keys_of(folder)


def chosen(only):
    """Return the keys to write, in the order in which data flows."""
    for key in only or ():
        if key not in EQUATIONS:
            raise ClassroomError(f"{key!r}: expected one of {', '.join(published.equations())}")
    return [key for key in published.equations() if not only or key in only]


# --- the files that students get ------------------------------------------------------------------
def parts_of(key):
    """Return what students write: forward, and backward where the equation has gradients."""
    return ["forward", "backward"] if EQUATIONS[key].gradients else ["forward"]


def functions_of(key):
    """Return the functions to write for an equation: ("forward", "entropy", ...)."""
    return tuple(name for part in parts_of(key) for name in (part, *HELPERS.get((key, part), ())))


def source_of(key):
    """Return the source of an equation's file, which contains the file merged with it."""
    module = EQUATIONS[key].module
    source = text_of(module)
    if key not in MERGED:
        return source
    other = MERGED[key]
    merged = text_of(f"{module.rpartition('.')[0]}.{other}")
    return re.sub(rf"import numpy as np\n\nfrom \.{other} import \w+\n", lambda _: merged, source)


def text_of(module):
    """Return the text of a module."""
    return inspect.getsource(import_module(module))


def stub_of(key):
    """Return the file that students get: everything but the bodies of the functions to write.

    Docstrings stay, and so do the first lines of a body that unpack `saved`: they show what the
    reference's forward saves.
    """
    source, number = source_of(key), EQUATIONS[key].number
    lines, functions = source.splitlines(keepends=True), functions_in(source)
    task = "has to be written" + (f", Eq. ({number})" if number else "")
    # From the last function to the first, so that the line numbers stay valid.
    nodes = [functions[name] for name in functions_of(key)]
    for node in sorted(nodes, key=lambda node: -node.lineno):
        stub = f"    raise NotImplementedError({json.dumps(f'{key}.{node.name} {task}')})\n"
        lines[kept(node)[-1].end_lineno : node.end_lineno] = [stub]
    return "".join(lines)


def functions_in(source):
    """Return {name: syntax tree} of the top-level functions."""
    nodes = ast.parse(source).body
    return {node.name: node for node in nodes if isinstance(node, ast.FunctionDef)}


def kept(node):
    """Return the leading statements that stay: the docstring and the unpacking of `saved`."""

    def stays(statement):
        value = getattr(statement, "value", None)
        is_text = isinstance(value, ast.Constant) and isinstance(value.value, str)
        return is_text or ast.unparse(statement).endswith(" = saved")

    return list(takewhile(stays, node.body))


def unwritten(source, name):
    """Whether a function is still as students got it, or missing."""
    node = functions_in(source).get(name)
    body = node.body[len(kept(node)) :] if node else []
    return not node or [ast.unparse(s)[:25] for s in body] == ["raise NotImplementedError"]


# --- what both readers are told -------------------------------------------------------------------
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
- `p4dgs-ref grade DIR` prints your points on inputs that are new in every run; run it again after
  every change. Your teacher will use other inputs.
- In Python, `eq = school.load("DIR/student/offsets.py")` with `from p4dgs_ref import school` loads
  the equation from your file. `eq.forward` and `eq.backward` are your functions, and
  `outputs, pullback = eq.vjp(**inputs)` calls them by name.
- Hand in this folder.

## How it is graded

{WHOLE} points an equation: {FORWARD} for the forward on ordinary inputs, {GRADIENTS} for the
gradients, divided equally among the inputs, and {HARD} for the hard cases (zeros, kinks, ties,
tails, empty axes, clamps and others), half of them for outputs and half for gradients. If there is
no gradient, all points are for outputs. Each part counts by its share of right answers. A formula
that is right on paper but has too few digits in float64 loses most of the hard cases.

- The inputs depend on a seed. They are those of the published test cases, changed at random, or
  in another order where a change would defeat the purpose of the case. The cotangents are random.
  An answer is right if it agrees with the reference within the same bounds as for the published
  vectors.
- Each equation is graded alone. Whatever your file imports from `p4dgs_ref` is the reference's
  code, not yours: `opacity.py`, for example, uses the reference's networks. Only the modules that
  the file imported originally, and those that they use, can be imported from `p4dgs_ref`.
- A wrong forward is not punished twice. If yours is wrong or missing, your backward is also tried
  on what the reference's forward saves, so keep the line that unpacks `saved` until your forward
  works. The exceptions are {SLOPES}, whose forwards save the slopes themselves.
- Functions receive float64 and must return float64. Printed text is ignored, and functions that run
  for too long are stopped.
- A file with a copy of the package's functions gets no points. Copies are recognised whatever their
  names, comments and layout are; short functions, which are alike by chance, do not count.

## The equations

| no. | file | tutorial | functions to write |
|---|---|---|---|
"""

TEACHER = """# For the teacher

This folder, `key/`, contains the complete files. Hand out its parent folder without `key/`.

- `p4dgs-ref grade hand_in/* --classroom COURSE -o marks` grades all folders in `hand_in/` by the
  same inputs, asks for the equations of COURSE, which is your copy of this classroom, and writes
  one table: `grades.csv` with a line for each student; `grades.txt` and `grades.json` have the
  details, too.
- The inputs depend on a seed. Without `--seed` one is drawn at grading time and printed, so that
  the same points can be had again after an appeal. If you choose a seed, keep it to yourself until
  everybody has handed in: with it and the installed package a student has the answers.
- Expected values are printed with `--reveal` only. Use it after grading is closed, with the same
  seed.
- Files of students are run on your machine, each in a process of its own with a time limit, with
  your rights and without any other protection. Use an account or a container that they may break.

## What is noticed, and what remains possible

While a file is graded, its process cannot import the equation that it should compute, nor anything
else of `p4dgs_ref` that the original file does not import. Functions that agree in four fifths of
their text with those of the key or of the installed package, whatever their names, comments,
docstrings and layout are, cost all points of the equation. The report names them beside the points
that the file would have had, so that you can decide otherwise.

This keeps honest students honest. It does not stop a student who is determined to cheat:

- A copy of which more was changed is not noticed, and neither is one of the short equations, which
  everybody writes in the same way: `view`, `offsets`, `opacity`, `color`, `rotation`, `scale`,
  `step`, `noise`, `rate_loss`, `total_loss`.
- A file can open the installed package as a text and run it, undo the lock on imports, start a
  process of its own or look into the memory of the one that it runs in. Whoever reads the file sees
  this at once.
- Solutions of the tutorials, ports on the web, answers of other students and those of language
  models are not compared.

Read a file of which you are in doubt, or let its author explain a line of it.
"""


def readme(keys):
    """Return the text of DIR/README.md."""
    text = README.format(
        WHOLE=FORWARD + GRADIENTS + HARD,
        FORWARD=FORWARD,
        GRADIENTS=GRADIENTS,
        HARD=HARD,
        SLOPES=", ".join(f"`{key}`" for key in published.equations() if key in SAVES_SLOPES),
    )
    for key in sorted(keys, key=published.equations().index):
        to_write = ", ".join(f"`{name}`" for name in functions_of(key))
        text += (
            f"| {EQUATIONS[key].number} | `student/{key}.py` "
            f"| `tutorials/{tutorial_of(key).name}.py` | {to_write} |\n"
        )
    return text
