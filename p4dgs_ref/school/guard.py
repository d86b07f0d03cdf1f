"""Does a student's file ask the reference for the answer?  A look at its syntax, meant to be fair rather than tight."""

import ast

from ..equations import EQUATIONS
from .room import source_of

# Ways to a module that no import statement shows, and the table that holds every reference.
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
    """What a file does that the file it came from does not: ["line 5: imports p4dgs_ref.equations.offsets", ...].

    Raises     SyntaxError, ValueError where the file cannot be parsed
    """
    given = {what for _, what in _doors(source_of(key), key)}
    return [
        f"line {line}: {what}" for line, what in sorted(_doors(source, key)) if what not in given
    ]


def _doors(source, key):
    package = EQUATIONS[key].module.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names = [f"{module}.{alias.name}" for alias in node.names]
        elif isinstance(node, (ast.Name, ast.Attribute)):
            name = node.id if isinstance(node, ast.Name) else node.attr
            if name in DOORS:
                yield node.lineno, f"uses {name}"
            continue
        else:
            continue
        yield from (
            (node.lineno, f"imports {name}")
            for name in names
            if name.split(".")[0] in {"p4dgs_ref", *LOADERS}
        )
