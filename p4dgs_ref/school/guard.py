"""Looks in the syntax of a student's file for ways to ask the reference for the answer.

The check is meant to be fair. It does not stop a student who is determined to cheat.
"""

import ast

from ..table import EQUATIONS
from .room import source_of

# Names that reach a module without an import statement, or the table of all references.
DOORS = {"EQUATIONS", "__import__", "import_module", "exec", "eval", "globals", "modules"}
LOADERS = {
    "importlib",
    "runpy",
    "pkgutil",
    "gc",
    "inspect",
    "builtins",
    "subprocess",
    "multiprocessing",
    "ctypes",
}


def suspicions(source, key):
    """Return what the file does that the original file does not.

    The entries have the form "line 5: imports p4dgs_ref.equations.offsets". Raises SyntaxError or
    ValueError if the file cannot be parsed.
    """
    original = {what for _, what in doors(source_of(key), key)}
    found = [(line, what) for line, what in doors(source, key) if what not in original]
    return [f"line {line}: {what}" for line, what in sorted(found)]


def doors(source, key):
    """Yield (line, what) for imports of the project or of a loader, and for names in DOORS."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            for name in imported(node, key):
                if name.split(".")[0] in {"p4dgs_ref", *LOADERS}:
                    yield node.lineno, f"imports {name}"
        elif isinstance(node, (ast.Name, ast.Attribute)):
            name = node.id if isinstance(node, ast.Name) else node.attr
            if name in DOORS:
                yield node.lineno, f"uses {name}"


def imported(node, key):
    """Return the full names that an import statement in the file of an equation imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    package = EQUATIONS[key].module.split(".")[:-1]
    base = package[: len(package) + 1 - node.level] if node.level else []
    module = ".".join([*base, *([node.module] if node.module else [])])
    return [f"{module}.{alias.name}" for alias in node.names]
