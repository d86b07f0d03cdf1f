"""Writes a classroom: a folder for students, a folder with the key, and a README for each reader.

DIR/README.md     what the teacher does
DIR/student/      what is handed out and handed in: README.md with the rules, and <key>.py
DIR/key/          the complete files, which stay with the teacher
"""

import ast
import inspect
from importlib import import_module
from pathlib import Path

from ...lessons import tutorial_of
from ...oracle.report import name_of
from ...output import staged_folder
from ...splatting.table import EQUATIONS

MAX_STUDENT_BYTES = 200_000  # of a file that is handed in; the longest of the key has 6,000
# Functions that contain the answer as well. They are removed together with forward and backward.
HELPERS = {
    "compositing": ("alphas", "transmittances"),
    "covariance": ("rotation_matrix",),
    "deformed": ("moved",),
    "grid_nodes": ("locate", "nodes", "entries"),
    "hash_grid": ("query",),
    "hash_rate": ("entropy",),
    "likelihood": (
        "literal",
        "rate",
        "around_the_mean",
        "beside_the_mean",
        "far_from_the_mean",
        "narrow_bin",
        "slopes",
    ),
    "masking": ("scatter",),
    "projection": ("view", "view_backward", "covariance2d", "splats"),
    "ssim": ("dissimilarity",),
}
# Equations of which a part is a module of its own, which students write as well.
OTHER_MODULES = {"hash_grid": ("grid_nodes",)}


class ClassroomError(ValueError):
    """A folder or a file does not belong to a classroom, or a key to an equation."""


def hand_out(folder, only=None):
    """Write the files of equations to student/ and key/, and a README.md for each reader.

    `only` lists the equations; without it all are written. If the folder is a classroom already,
    equations are added, and the files of the students stay.

    Returns {"output", "equations": keys written, "functions": how many have to be written, "kept":
    keys left as they were}. Raises ClassroomError or OutputError.
    """
    folder = Path(folder)
    for key in only or ():
        if key not in EQUATIONS:
            raise ClassroomError(f"{key!r}: expected one of {', '.join(EQUATIONS)}")
    old = keys_of(folder / "student") if folder.is_dir() and any(folder.iterdir()) else []
    new = [key for key in EQUATIONS if key in (only or EQUATIONS) and key not in old]
    rows = "".join(
        f"| {EQUATIONS[key].number} | `{name}.py` | `tutorials/{tutorial_of(key).name}.py` "
        f"| {', '.join(f'`{function}`' for function in functions_of(name))} |\n"
        for key in EQUATIONS
        if key in old or key in new
        for name in modules_of(key)
    )
    files = {"README.md": TEACHER, "student/README.md": STUDENT + rows}
    for key in new:
        files |= {f"student/{name}.py": text for name, text in stubs_of(key).items()}
        files |= {f"key/{name}.py": text for name, text in sources_of(key).items()}
    with staged_folder(folder) as staging:
        for name, text in files.items():
            (staging / name).parent.mkdir(exist_ok=True)
            (staging / name).write_text(text, encoding="utf-8")
    return {
        "output": str(folder),
        "equations": new,
        "functions": sum(len(functions_of(name)) for key in new for name in modules_of(key)),
        "kept": old,
    }


def files_of(folder):
    """Return the folder with a student's files: the folder itself, or `student` inside it."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ClassroomError(f"{folder}: expected a classroom, or the folder of a student's files")
    return folder / "student" if (folder / "student").is_dir() else folder


def keys_of(folder):
    """Return the equations that students find in a classroom. Raises ClassroomError."""
    files = files_of(folder)
    keys = [key for key in EQUATIONS if (files / f"{key}.py").is_file()]
    if not keys:
        raise ClassroomError(
            f"{folder}: expected a classroom, which has files such as student/offsets.py; "
            "`p4dgs-ref classroom` writes one to a new folder"
        )
    return keys


def text_of(path):
    """Return the text of a student's file, with or without a byte order mark.

    Raises ClassroomError for a pipe, a device, a link to one, or a file that is too large, and
    OSError or UnicodeDecodeError where it cannot be read.
    """
    if path.exists() and not (path.is_file() and path.stat().st_size <= MAX_STUDENT_BYTES):
        raise ClassroomError(f"expected a regular file of at most {MAX_STUDENT_BYTES:,} bytes")
    return path.read_text(encoding="utf-8-sig")


# --- the files that students get ------------------------------------------------------------------
def modules_of(key):
    """Return {file name without .py: module} of an equation."""
    package = EQUATIONS[key].module.__package__
    return {name: f"{package}.{name}" for name in (key, *OTHER_MODULES.get(key, ()))}


def parts_of(name):
    """Return what students write of an equation: forward, and backward if it has gradients."""
    if name not in EQUATIONS:
        return ()
    return ("forward", "backward") if EQUATIONS[name].gradients else ("forward",)


def functions_of(name):
    """Return the functions to write in a file: ("forward", "backward", "entropy", ...)."""
    return (*parts_of(name), *HELPERS.get(name, ()))


def sources_of(key):
    """Return the complete files of an equation, {file name without .py: text}."""
    modules = modules_of(key).items()
    return {name: inspect.getsource(import_module(module)) for name, module in modules}


def stubs_of(key):
    """Return the files of an equation that students get, {file name without .py: text}."""
    return {name: stub(name, source) for name, source in sources_of(key).items()}


def stub(name, source):
    """Return a file without the bodies of the functions to write.

    Docstrings stay, and so do the first lines of a body that unpack `saved`: they show what the
    reference's forward saves.
    """
    lines, title = source.splitlines(keepends=True), name_of(name)
    # From the last function to the first, so that the line numbers stay valid.
    for function, node in reversed(functions_in(source).items()):
        if function in functions_of(name):
            message = f"{title}.{function} has to be written"
            lines[kept(node)[-1].end_lineno : node.end_lineno] = [
                f'    raise NotImplementedError("{message}")\n'
            ]
    return "".join(lines)


def functions_in(source):
    """Return {name: syntax tree} of the top-level functions."""
    nodes = ast.parse(source).body
    return {node.name: node for node in nodes if isinstance(node, ast.FunctionDef)}


def kept(node):
    """Return the leading statements that stay: the docstring and the unpacking of `saved`."""
    return node.body[: 1 + ast.unparse(node.body[1]).endswith(" = saved")]


# --- what both readers are told -------------------------------------------------------------------
STUDENT = """# Equations to write

Each file in this folder is one equation of the paper P-4DGS from which the bodies of some functions
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
- `p4dgs-ref grade DIR`, where DIR is this folder, prints your points on inputs that are new in
  every run; run it again after every change. Your teacher will use other inputs.
- In Python, `eq = classroom.load("DIR/offsets.py")` with `from p4dgs_ref.lab import classroom`
  loads the equation from your file. `eq.forward` and `eq.backward` are your functions, and
  `outputs, pullback = eq.vjp(**inputs)` calls them by name.
- Eq. (9) has two files: `hash_grid.py` imports what you write in `grid_nodes.py`.
- Hand in this folder. Each file is a regular file of at most 200,000 bytes in UTF-8.

## How it is graded

10 points an equation: 3 for the forward on ordinary inputs, 3 for the gradients, divided equally
among the inputs, and 4 for the hard cases (zeros, kinks, ties, tails, empty axes, clamps and
others), half of them for outputs and half for gradients. If there is no gradient, all points are
for outputs. Each part counts by its share of right answers. A formula that is right on paper but
has too few digits in float64 loses most of the hard cases.

- The inputs depend on a seed. They are those of the published test cases, changed at random where
  that does not defeat the purpose of the case. The cotangents are random.
  An answer is right if it agrees with the reference within the same bounds as for the published
  vectors. What is said about a wrong answer comes from the published cases, as in the tutorials.
- Each equation is graded alone. Whatever your file imports from `p4dgs_ref` is the reference's
  code, not yours: `opacity.py`, for example, uses the reference's networks. (The exception is your
  `grid_nodes.py`.) Only the modules that the file imported originally, and those that they use, can
  be imported from `p4dgs_ref`.
- A wrong forward is not punished twice. If yours is wrong or missing, your backward is also tried
  on what the reference's forward saves, so keep the line that unpacks `saved` until your forward
  works. The exceptions are `hash_grid`, `step` and `likelihood`, whose forwards save the slopes
  themselves.
- Functions receive float64 and must return NumPy arrays of float64, or of integers where the
  equation says so. A list or an array of another type is named and gets no points. Printed
  text is ignored, and functions that run for too long are stopped.
- Names that no equation needs, such as `open`, `exec` or `sys`, are listed for your teacher. That
  takes no points away.
- A file with a copy of the package's functions gets no points. Copies are recognised whatever their
  names, comments and layout are. Short functions, which are alike by chance, do not count, unless
  the text is the reference's line for line: with its comments, or in three files or more.
- Your teacher is told which files of two students are alike. That takes no points away.

## The equations

| no. | file | tutorial | functions to write |
|---|---|---|---|
"""

TEACHER = """# For the teacher

- Hand out `student/`, the equations with bodies removed and a page with the rules. Students hand
  in the same folder. Keep `key/`, the complete files.
- Collect what students hand in as one folder a student, such as `hand_in/anna`, which is her
  `student/` renamed or contains it. `p4dgs-ref grade hand_in/* --classroom COURSE -o marks` grades
  all of them by the same inputs, asks for the equations of COURSE, which is this folder (without
  it, those of the first student), and writes one table: `grades.csv` with a line for each student;
  `grades.txt` and `grades.json` have the details, too.
- The inputs depend on a seed. Without `--seed` one is drawn at grading time and printed, so that
  the same points can be had again after an appeal. If you choose a seed, keep it to yourself until
  everybody has handed in: with it and the installed package a student has the answers.
- The points come from these inputs. What is said about a wrong answer comes from the published
  cases, which everybody has, so no report gives the expected values away.
- Files of students are run on your machine, each in a process of its own with a time limit, with
  your rights and without any other protection. Use an account or a container that they may break.

## What is noticed, and what remains possible

While a file is graded, its process cannot import the equation that it should compute, nor anything
else of `p4dgs_ref` that the original file does not import.

**Copies of the package** cost all points of the equation: functions that agree in four fifths of
their text with those of the key or of the installed package, whatever their names, comments,
docstrings and layout are. The report names them beside the points that the file would have had, so
that you can decide otherwise.

**Short equations** are written by everybody in the same way: `offsets`, `view`, `opacity`, `color`,
`rotation`, `scale`, `noise`, `step`, `total_loss`, `rate_loss`. Equal code is no proof there. A
file of these counts as a copy if it has all lines of the key as they are in the key, comments and
names included, and chance can be excluded: because one of these lines has a comment, or because
there are three such files or more. The report then says *all lines of the key*.

**Students are compared in pairs**, and the report lists the equations in which two of them are
alike, by the same two rules. It takes no points away, since it proves nothing by itself: both may
have worked together, or started from the same solution of a tutorial. Short equations with equal
code are not listed, for the reason above. A group of students who copied from each other is listed
as all its pairs.

**Names that no equation needs**, such as `exec`, `open`, `sys`, `os`, `gc` or `inspect`, have a
column of their own, *unusual*, and a line below the equation. They take no points away, because a
variable may have such a name.

This keeps honest students honest. It does not stop a student who is determined to cheat:

- A copy of which more was changed is not noticed, and neither is one of a short equation without
  its comments, or with other names.
- A file can open the installed package as a text and run it, undo the lock on imports, start a
  process of its own or look into the memory of the one that it runs in. It then gets full
  points. The column *unusual* shows the plain forms of this; a name that is put together while the
  file runs shows only when you read the file.
- Solutions of the tutorials, ports on the web, answers of earlier years and those of language
  models are not compared.

Read a file of which you are in doubt, or let its author explain a line of it.
"""
