"""Counts what DESIGN counts: `python -m tests.budget` prints one line of JSON.

A statement is a node of Python's syntax tree that is a statement, docstrings left out. A token is a
name, operator or number.
"""

import ast
import json
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "p4dgs_ref"
CORE = ("equations", "splatting", "table", "model", "effects", "scenes", "training", "codec")


def statements(file):
    """The number of statements in a file."""
    return sum(
        isinstance(node, ast.stmt) and not is_docstring(node)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
    )


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


def room_of(file):
    """The first part of a module's path below the package."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def is_core(file):
    """Whether a file belongs to what trains, compresses and renders; the simulator only draws."""
    return room_of(file) in CORE and "simulator" not in file.parts


def rooms():
    """{room: statements} of the package."""
    counts = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        counts[room_of(file)] = counts.get(room_of(file), 0) + statements(file)
    return counts


def budget():
    """The figures of DESIGN for the tree as it is."""
    package = sorted(PACKAGE.rglob("*.py"))
    tutorials = sorted((ROOT / "tutorials").rglob("*.py"))
    written = [*package, *tutorials, *sorted((ROOT / "tests").rglob("*.py"))]
    return {
        "equations": sum(statements(file) for file in package if room_of(file) == "equations"),
        "core": sum(statements(file) for file in package if is_core(file)),
        "package": sum(statements(file) for file in package),
        "tokens_per_line": tokens_per_line(package),
        "tutorial_tokens_per_line": tokens_per_line(tutorials),
        "longest_line": max(
            len(line) for file in written for line in file.read_text(encoding="utf-8").splitlines()
        ),
    }


if __name__ == "__main__":
    print(json.dumps(budget()))
