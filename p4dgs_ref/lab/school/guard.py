"""Keeps the package's own code out of a student's answer: by its text and by its imports.

Functions are compared with those of the package line by line, without names, comments, docstrings
and layout, so a copy is still one after small changes. Short functions are alike by chance; only a
file with enough text in functions that are alike counts as a copy. While a file is graded, its
process cannot import the equation that the file should compute.
"""

import ast
import re
import sys
from functools import cache
from importlib import import_module
from pathlib import Path

from ...table import EQUATIONS
from .room import MERGED, stub_of

PACKAGE = Path(__file__).resolve().parents[2]
ALIKE = 0.8  # of a function's text; where tutorials and tests compute the same, it is below 0.4
ENOUGH = 200  # characters of such functions in a file; names count as one


# --- copies ---------------------------------------------------------------------------------------
def copies(source, key, alike=ALIKE):
    """Return the functions of a student's file that are copies of functions of the package.

    The entries have the form "forward (line 5)". There are none if together they are so short that
    they may be alike by chance. Raises SyntaxError or ValueError if the file cannot be parsed.
    """
    given, found, size = lines_of(stub_of(key)), [], 0
    for function in functions(source):
        mine = [line for line in body_of(function) if line not in given]
        same = "".join(line for line in mine if line in lines_of_the_package())
        if same and len(same) >= alike * len("".join(mine)):
            found.append(f"{function.name} (line {function.lineno})")
            size += len(same)
    return found if size >= ENOUGH else []


@cache
def lines_of_the_package():
    """Return the lines of all functions in the rooms that hold equations."""
    files = [path for room in ("equations", "splatting") for path in (PACKAGE / room).glob("*.py")]
    return set().union(*(lines_of(path.read_text(encoding="utf-8")) for path in files))


@cache
def lines_of(source):
    """Return the lines of all functions in a file."""
    return {line for function in functions(source) for line in body_of(function)}


def functions(source):
    """Return the syntax trees of all functions in a file."""
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]


def body_of(function):
    """Return the body of a function, a statement a line, with numbers in place of names.

    Docstrings and assignments of constants are left out.
    """
    for node in ast.walk(function):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [s for s in body if not isinstance(getattr(s, "value", 0), ast.Constant)]
    lines = ast.unparse(ast.Module(function.body, [])).splitlines()
    return [nameless(line.strip()) for line in lines]


def nameless(line):
    """Return a line with numbers in place of names; the names of attributes stay."""
    names = {}
    return re.sub(
        r"(?<![.\w])[A-Za-z_]\w*", lambda name: str(names.setdefault(name[0], len(names))), line
    )


# --- imports --------------------------------------------------------------------------------------
class Lock:
    """A finder of modules that refuses those of the project."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        """Raise ImportError for a module of the project; leave others to the next finder."""
        if name.startswith("p4dgs_ref"):
            raise ImportError(f"{name} cannot be imported by a file that is graded")


def alone(key):
    """Return the module of the reference's equation, which cannot be imported from now on.

    Of the project, only the modules that it imports can still be imported.
    """
    for name in [name for name in sys.modules if name.startswith("p4dgs_ref")]:
        del sys.modules[name]
    reference = import_module(EQUATIONS[key].module)
    package = EQUATIONS[key].module.rpartition(".")[0]
    for name in {key, MERGED.get(key, key)}:
        del sys.modules[f"{package}.{name}"]
        delattr(sys.modules[package], name)
    sys.meta_path.insert(0, Lock)
    return reference
