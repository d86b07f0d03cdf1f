"""Counts what `budget.json` limits: `python -m tests.budget` prints the counts in its form.

A statement is a node of Python's syntax tree that is a statement, docstrings left out. A token is a
name, operator or number.
"""

import argparse
import ast
import gc
import json
import tokenize
from functools import cache

from p4dgs_ref.cli.parser import parser
from tests import ROOT

PACKAGE = ROOT / "p4dgs_ref"
# Rooms that are counted together.
SHARED = {
    **dict.fromkeys(
        ("splatting", "model", "attributes", "effects", "limits"), "splatting, model"
    ),
    "output": "scenes",
    **dict.fromkeys(
        ("cli", "version", "signals", "arithmetic", "__init__", "__main__"), "cli, root"
    ),
}


@cache
def parse(file):
    """The syntax tree of a file, which is parsed once."""
    gc.disable()  # it would look through all earlier trees again and again
    try:
        return ast.parse(file.read_text(encoding="utf-8"), str(file))
    finally:
        gc.enable()


def inside(node):
    """Every statement within a module or a statement; expressions, which hold none, are skipped."""
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, field, ()):
            if isinstance(child, ast.stmt):
                yield child
            yield from inside(child)


def statements(file):
    """The number of statements in a file."""
    return sum(not is_docstring(node) for node in inside(parse(file)))


def is_docstring(node):
    """Whether a statement is a constant that stands alone."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def tokens_per_line(files):
    """Tokens of code per line that holds any."""
    tokens = lines = 0
    for file in files:
        with open(file, "rb") as text:
            code = [
                token.start[0]
                for token in tokenize.tokenize(text.readline)
                if token.type in (tokenize.NAME, tokenize.OP, tokenize.NUMBER)
            ]
        tokens += len(code)
        lines += len(set(code))
    return round(tokens / lines, 2)


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


def rooms():
    """{room of the budget: statements} of the package."""
    counts = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        room = SHARED.get(room_of(file), room_of(file))
        counts[room] = counts.get(room, 0) + statements(file)
    return counts


def subcommands(command):
    """{name: parser} of what a command is divided into."""
    divided = (a for a in command._actions if isinstance(a, argparse._SubParsersAction))
    return {name: part for action in divided for name, part in action.choices.items()}


def options(command):
    """The pairs of a command and an option of it, --help left out."""
    own = sum(bool(a.option_strings) and a.dest != "help" for a in command._actions)
    return own + sum(map(options, subcommands(command).values()))


def budget():
    """The figures of DESIGN for the tree as it is."""
    package = sorted(PACKAGE.rglob("*.py"))
    tools = sorted((ROOT / "tutorials" / "tools").rglob("*.py"))
    tutorials = sorted(set((ROOT / "tutorials").rglob("*.py")) - set(tools))
    tests = sorted((ROOT / "tests").rglob("*.py"))
    return {
        **rooms(),
        "package": sum(map(statements, package)),
        "files": len(package),
        "commands": len(subcommands(parser())),
        "options": options(parser()),
        "tutorials": sum(map(statements, tutorials)),
        "tools": sum(map(statements, tools)),
        "tests": sum(map(statements, tests)),
        "tokens_per_line": tokens_per_line(package),
        "tutorial_tokens_per_line": tokens_per_line(tutorials),
    }


if __name__ == "__main__":
    print(json.dumps(budget(), indent=1))
