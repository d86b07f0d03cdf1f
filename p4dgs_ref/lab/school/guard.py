"""Notices copies of the package in a student's file by their text.

Functions are compared line by line, without names, comments, docstrings and layout, so a copy is
still one after small changes. Short functions are alike by chance; only a file with enough text in
functions that are alike counts as a copy.
"""

import ast
import re
from functools import cache
from pathlib import Path

from .removal import functions_of, without_bodies
from .room import source_of

PACKAGE = Path(__file__).resolve().parents[2]
ALIKE = 0.8  # of a function's text; where tutorials and tests compute the same, it is below 0.4
ENOUGH = 200  # characters of such functions in a file; names count as one


def copies(source, key, asked):
    """Return the functions of a student's file that are copies of functions of the package.

    The entries have the form "forward (line 5)". There are none if together they are so short that
    they may be alike by chance. Raises SyntaxError or ValueError if the file cannot be parsed.
    """
    given = handed_out(key, tuple(asked))
    found, size = [], 0
    for function in functions(source):
        mine = [line for line in lines_of(function) if line not in given]
        alike = [line for line in mine if line in lines_of_the_package()]
        if alike and length(alike) >= ALIKE * length(mine):
            found.append(f"{function.name} (line {function.lineno})")
            size += length(alike)
    return found if size >= ENOUGH else []


@cache
def lines_of_the_package():
    """Return the lines of all functions in the rooms that hold equations."""
    files = [path for room in ("equations", "splatting") for path in (PACKAGE / room).glob("*.py")]
    return {
        line
        for path in files
        for function in functions(path.read_text(encoding="utf-8"))
        for line in lines_of(function)
    }


@cache
def handed_out(key, asked):
    """Return the lines of the functions in the file that students get."""
    stub = without_bodies(source_of(key), functions_of(key, asked), str)
    return {line for function in functions(stub) for line in lines_of(function)}


def functions(source):
    """Return the syntax trees of all functions in a file."""
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]


def lines_of(function):
    """Return the body of a function, a statement a line, with numbers in place of names.

    Docstrings and assignments of constants are left out.
    """
    for node in ast.walk(function):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [s for s in body if not isinstance(getattr(s, "value", 0), ast.Constant)]
    return [
        nameless(line.strip()) for line in ast.unparse(ast.Module(function.body, [])).splitlines()
    ]


def nameless(line):
    """Return a line with numbers in place of names; the names of attributes stay."""
    names = {}
    return re.sub(
        r"(?<![.\w])[A-Za-z_]\w*", lambda name: str(names.setdefault(name[0], len(names))), line
    )


def length(lines):
    """Return the number of characters."""
    return sum(map(len, lines))
