"""Counts what `budget.json` limits: `python -m tests.budget` prints each count and its ceiling.

A token is a name, operator, number or string of Python; comments and docstrings are free.
"""

import argparse
import ast
import gc
import io
import json
import tokenize
from functools import cache

from p4dgs_ref.cli.parser import parser
from tests import ROOT

PACKAGE = ROOT / "p4dgs_ref"
CEILINGS = json.loads((ROOT / "tests" / "budget.json").read_text(encoding="utf-8"))
CODE = (tokenize.NAME, tokenize.OP, tokenize.NUMBER, tokenize.STRING)


@cache
def parse(file):
    """The syntax tree of a file, which is parsed once."""
    gc.disable()  # it would look through all earlier trees again and again
    try:
        return ast.parse(file.read_text(encoding="utf-8"), str(file))
    finally:
        gc.enable()


@cache
def tokens(file):
    """The number of tokens of a file."""
    holders = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    firsts = [
        node.body[0] for node in ast.walk(parse(file)) if isinstance(node, holders) and node.body
    ]
    docstrings = {(first.lineno, first.col_offset) for first in firsts if is_docstring(first)}
    text = io.StringIO(file.read_text(encoding="utf-8"))
    found = tokenize.generate_tokens(text.readline)
    return sum(token.type in CODE and token.start not in docstrings for token in found)


def is_docstring(node):
    """Whether a statement is a constant that stands alone."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def inside(node):
    """Every statement within a module or a statement; expressions, which hold none, are skipped."""
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, field, ()):
            if isinstance(child, ast.stmt):
                yield child
            yield from inside(child)


def imported(file, package=PACKAGE):
    """The full dotted names that a file imports, at its top and inside functions."""
    here = file.relative_to(package.parent).parts[:-1]
    for node in inside(parse(file)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            start = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{start}.{alias.name}" for alias in node.names)


def room_of(file):
    """The first part of a module's path below the package."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def entry_of(room):
    """The entry that names a room; modules of the root share one."""
    named = (entry for entry in CEILINGS if room in entry.replace(" with ", ", ").split(", "))
    return next(named, "cli, root")


def subcommands(command):
    """{name: parser} of what a command is divided into."""
    divided = (a for a in command._actions if isinstance(a, argparse._SubParsersAction))
    return {name: part for action in divided for name, part in action.choices.items()}


def options(command):
    """The pairs of a command and an option of it, --help left out."""
    own = sum(bool(a.option_strings) and a.dest != "help" for a in command._actions)
    return own + sum(map(options, subcommands(command).values()))


def files(folder, *without):
    """The Python files below a folder of the checkout, those below some folders in it left out."""
    place = ROOT / folder
    left_out = {file for name in without for file in (place / name).rglob("*.py")}
    return sorted({*place.rglob("*.py")} - left_out)


@cache
def budget():
    """{entry of budget.json: its count} for the tree as it is."""
    package = files("p4dgs_ref")
    rooms = {}
    for file in package:
        entry = entry_of(room_of(file))
        rooms[entry] = rooms.get(entry, 0) + tokens(file)
    groups = {
        "package": package,
        "tutorials with solutions": files("tutorials", "tools", "experiments"),
        "tools": files("tutorials/tools"),
        "experiments": files("tutorials/experiments"),
        "tests": files("tests"),
    }
    scripts = [*(PACKAGE / "viewer").glob("*.js")]
    return {
        **rooms,
        **{entry: sum(map(tokens, group)) for entry, group in groups.items()},
        "files": len(package),
        "commands": len(subcommands(parser())),
        "options": options(parser()),
        "JavaScript lines": sum(len(f.read_text(encoding="utf-8").splitlines()) for f in scripts),
    }


if __name__ == "__main__":
    for entry, count in budget().items():
        ceiling = CEILINGS.get(entry, 0)
        print(f"{count:8,} of {ceiling:8,}  {entry}{'  TOO MUCH' * (count > ceiling)}")
