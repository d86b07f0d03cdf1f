"""Writes a classroom: a folder for students, a folder with the key, and a README for each reader.

DIR/README.md     what the teacher does
DIR/student/      what is handed out and handed in: README.md with the rules, and <key>.py
DIR/key/          the complete files, which stay with the teacher
"""

import ast
import inspect
import tokenize
from pathlib import Path

from ...lessons import tutorial_of
from ...oracle.report import name_of
from ...output import staged_folder
from ...splatting.table import EQUATIONS
from .. import StudyError, entry

MAX_STUDENT_BYTES = 200_000  # of a file that is handed in; the longest in the key has 6,000


def hand_out(folder, only=None):
    """Write the files of equations to student/ and key/, and a README.md for each reader.

    `only` lists the equations; without it all are written. If the folder is already a classroom,
    equations are added and the students' files stay.

    Returns {"output", "equations": keys written, "functions": how many students have to write,
    "kept": keys left as they were}. Raises StudyError or OutputError.
    """
    folder = Path(folder)
    for key in only or ():
        entry(EQUATIONS, "equation", key)
    functions = {key: functions_of(key) for key in EQUATIONS}
    with staged_folder(folder) as staging:
        old = keys_of(folder / "student") if any(folder.glob("[!.]*")) else []
        new = [key for key in EQUATIONS if key in (only or EQUATIONS) and key not in old]
        rows = "".join(
            f"| {EQUATIONS[key].number} | `{key}.py` | `tutorials/{tutorial_of(key).name}.py` "
            f"| {', '.join(f'`{name}`' for name in functions[key])} |\n"
            for key in EQUATIONS
            if key in old or key in new
        )
        files = {"README.md": TEACHER, "student/README.md": STUDENT + rows}
        for key in new:
            files |= {f"student/{key}.py": stub(key), f"key/{key}.py": source_of(key)}
        for name, text in files.items():
            (staging / name).parent.mkdir(exist_ok=True)
            (staging / name).write_text(text, encoding="utf-8")
    return {
        "output": str(folder),
        "equations": new,
        "functions": sum(len(functions[key]) for key in new),
        "kept": old,
    }


def files_of(folder):
    """Return the folder with a student's files: the folder itself, or `student` inside it."""
    folder = Path(folder)
    if not folder.is_dir():
        raise StudyError(f"{folder}: not a folder; expected a classroom or a student's folder")
    return folder / "student" if (folder / "student").is_dir() else folder


def keys_of(folder):
    """Return the keys of the equations in a classroom. Raises StudyError."""
    files = files_of(folder)
    keys = [key for key in EQUATIONS if (files / f"{key}.py").is_file()]
    if not keys:
        raise StudyError(
            f"{folder}: expected a classroom, which has files such as student/offsets.py; "
            "`p4dgs-ref classroom` writes one to a new folder"
        )
    return keys


def text_of(path):
    """Return the text of a student's file, decoded as Python decodes it.

    Raises StudyError for a pipe, a device, a link to one, or a file that is too large; OSError if
    it cannot be read; and SyntaxError or UnicodeDecodeError if it does not match its encoding.
    """
    if path.exists() and not (path.is_file() and path.stat().st_size <= MAX_STUDENT_BYTES):
        raise StudyError(f"expected a regular file of at most {MAX_STUDENT_BYTES:,} bytes")
    with tokenize.open(path) as file:
        return file.read()


# --- the files that students get ------------------------------------------------------------------
def source_of(key):
    """Return the complete file of an equation."""
    return inspect.getsource(EQUATIONS[key].module)


def parts_of(key):
    """Return the graded parts of an equation: forward, and backward if it has gradients."""
    return ("forward", "backward") if EQUATIONS[key].gradients else ("forward",)


def functions_of(key):
    """Return {name: syntax tree} of the functions that students write."""
    nodes = [node for node in ast.parse(source_of(key)).body if isinstance(node, ast.FunctionDef)]
    return {n.name: n for n in nodes if n.name != "backward" or n.name in parts_of(key)}


def stub(key):
    """Return the file that students get: its functions keep only their docstrings."""
    lines, title = source_of(key).splitlines(keepends=True), name_of(key)
    # From the last function to the first, so that the line numbers stay valid.
    for name, node in reversed(functions_of(key).items()):
        message = f"{title}.{name} has to be written"
        lines[node.body[0].end_lineno : node.end_lineno] = [
            f'    raise NotImplementedError("{message}")\n'
        ]
    return "".join(lines)


# --- the pages for students and teachers ----------------------------------------------------------
STUDENT = """# Equations to write

Each file in this folder is one equation of the paper P-4DGS, with the bodies of its functions
removed. The docstring at the top contains the formula, and the comments beside the arguments give
their shapes and units. Derive the backward on paper, then write the bodies in place
of `raise NotImplementedError(...)`. Functions other than `forward` and `backward` are helpers of
these two; write them or delete them. Import NumPy or SciPy if you need them. The table below names
the tutorial that explains each equation.

- `forward` returns a pair: the output (a tuple if there are several) and a tuple `saved` with
  everything that `backward` needs.
- `backward` gets what your `forward` saves, so write `forward` first. It returns a dictionary that
  maps input names to gradients.
- `p4dgs-ref grade DIR`, where DIR is this folder, prints your points on inputs that are new in
  every run; run it after every change. Your teacher will use other inputs.
- In Python, `eq = classroom.load("DIR/offsets.py")` with `from p4dgs_ref.lab import classroom`
  loads the equation from your file. `eq.forward` and `eq.backward` are your functions, and
  `outputs, pullback = eq.vjp(**inputs)` calls them by name.
- Hand in this folder. Each file must be a regular file of at most 200,000 bytes, in UTF-8 or in
  the encoding that it declares.

## How it is graded

Each equation gives 10 points: 3 for the forward on ordinary inputs, 3 for the gradients, and 4 for
the hard cases (zeros, kinks, ties, tails, clamps and others). If there is no gradient, the other
parts share all points. You get the share of a part's points that equals its share of right outputs
and gradients. A formula that is right on paper but has too few digits in float64 loses most of the
hard cases.

- The inputs depend on a seed. They are those of the published test cases, changed at random where
  that does not defeat the purpose of the case. The cotangents are random. An answer is right if it
  agrees with the reference within the bounds of the published vectors. Comments on a wrong answer
  come from the published cases, as in the tutorials.
- Each equation is graded alone. Whatever your file imports from `p4dgs_ref` is the reference's
  code, not yours: `opacity.py`, for example, uses the reference's networks, and `hash_grid.py` its
  nodes. From `p4dgs_ref` you can import only the modules that the original file imports, and those
  that they use.
- Functions receive float64 and must return float64, or integers where the equation says so, in
  arrays or nested lists. Other types get no points, and neither do masked arrays or functions that
  write into their arguments. Printed text is ignored.
- A function that runs for more than 5 seconds on one input is stopped. All answers from your files
  together have one minute; when little of it is left, an answer gets a tenth of the rest.
- Your teacher is told which files of two students are alike, which resemble the package's own, and
  which use names that no equation needs, such as `open`, `exec` or `sys`. This costs no points.

## The equations

| no. | file | tutorial | functions to write |
|---|---|---|---|
"""

TEACHER = """# For the teacher

- Hand out `student/`: the equations without bodies, and a page with the rules. Students hand in the
  same folder. Keep `key/`, the complete files.
- Collect one folder per student, such as `hand_in/anna`, which is her `student/` renamed, or
  contains it. `p4dgs-ref grade hand_in/* --classroom COURSE -o marks` grades all of them on the
  same inputs. COURSE is this folder, whose equations are graded (without it, those of the first
  student). The table `grades.csv` has a line for each student; `grades.txt` also has the details.
- The inputs depend on a seed. Without `--seed` a random one is chosen at grading time and printed,
  so that grading can be repeated after an appeal. If you choose a seed, keep it to yourself until
  everybody has handed in: with it and the installed package a student has the answers.
- The points come from these inputs. Comments on a wrong answer come from the published cases, which
  everybody has, so no report gives the expected values away.
- Students' files run on your machine, each in its own process with a time limit, but with your
  rights and no other protection. Use an account or a container that they may break.

## What you should look at

While a file is graded, its process cannot import the equation that it should compute, nor anything
else from `p4dgs_ref` that the original file does not import. Nothing below costs points; you
decide.

**Files that are alike** are listed in pairs, of two students or of a student and the key: their
texts are equal, or four fifths of the statements of one are in the other, apart from names,
comments, docstrings and layout. This proves nothing by itself: both may have worked together, or
started from the same solution of a tutorial. **Short equations** look alike whoever writes them:
`offsets`, `view`, `opacity`, `color`, `rotation`, `scale`, `noise`, `step`, `total_loss`,
`rate_loss`. They are listed only where the whole text is equal.

**Names that no equation needs**, such as `exec`, `open`, `sys`, `os`, `gc` or `inspect`, are listed
in the column *unusual*. A variable may have such a name.

This keeps honest students honest. It does not stop a student who is determined to cheat:

- A copy that was changed more than that is not noticed.
- A file can read the installed package as text and run it, undo the lock on imports, start a
  process, or inspect the memory of the process in which it runs. It then gets full points. The
  column *unusual* shows the plain forms of this; a name that is assembled while the file runs shows
  only when you read the file.
- Solutions of the tutorials, ports on the web, answers from earlier years and from language models
  are not compared.

Read a file that you doubt, or ask its author to explain a line of it.
"""
