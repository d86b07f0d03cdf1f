"""Notices a copy of the package in a student's file by its text.

Functions are compared by their syntax trees without names, comments, docstrings and layout. Short
functions are alike by chance, so only a file with much that is alike counts as a copy. A copy whose
statements were changed is not noticed.
"""

import ast
import re
from functools import cache
from pathlib import Path

from .removal import functions_of, without_bodies
from .room import source_of

PACKAGE = Path(__file__).resolve().parents[1]
ENOUGH = 160  # nodes of the syntax tree that must be alike in all


def copies(source, key, asked):
    """Return the functions of a student's file that are copies of functions of the package.

    The entries have the form "line 5: forward is that of p4dgs_ref/equations/mlp.py". There are
    none if the functions together are so short that they may be alike by chance. Raises SyntaxError
    or ValueError if the file cannot be parsed.
    """
    known, given = functions_of_the_package(), handed_out(key, tuple(asked))
    alike = []
    for node in functions(ast.parse(source)):
        body = normalised(node)
        if body in known and body not in given:
            alike.append((node, known[body]))
    if sum(len(list(ast.walk(node))) for node, _ in alike) < ENOUGH:
        return []
    return [f"line {node.lineno}: {node.name} is that of {place}" for node, place in alike]


@cache
def functions_of_the_package():
    """Return {normalised body: "p4dgs_ref/equations/mlp.py"} of the rooms that hold equations."""
    known = {}
    for room in ("splatting", "equations"):
        for path in sorted((PACKAGE / room).glob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            place = path.relative_to(PACKAGE.parent).as_posix()
            known.update({normalised(node): place for node in functions(tree)})
    return known


@cache
def handed_out(key, asked):
    """Return the normalised bodies of the functions that students get with the file."""
    stub = without_bodies(source_of(key), functions_of(key, asked), str)
    return {normalised(node) for node in functions(ast.parse(stub))}


def functions(tree):
    """Return the syntax trees of all functions in a file."""
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def normalised(function):
    """Return the body of a function as text, with numbers in place of names."""
    for node in ast.walk(function):
        if isinstance(getattr(node, "body", None), list):
            node.body = [line for line in node.body if not is_idle(line)]
    text = ast.dump(ast.Module(function.body, []))
    names = {}
    return re.sub(
        r"\b(?:id|arg|name)='(\w+)'",
        lambda found: str(names.setdefault(found[1], len(names))),
        text,
    )


def is_idle(statement):
    """Whether a statement does nothing: a docstring or `pass`."""
    is_constant = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    return is_constant or isinstance(statement, ast.Pass)
