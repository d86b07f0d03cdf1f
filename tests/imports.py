"""What the Python files of the checkout import, for tests of the order of the house."""

import ast

from tests import ROOT

PACKAGE = ROOT / "p4dgs_ref"


def files(folder):
    """Return the Python files below a folder of the checkout."""
    return sorted((ROOT / folder).rglob("*.py"))


def imported(file, package=PACKAGE):
    """Yield the full dotted names that a file imports, at its top and inside functions."""
    here = file.relative_to(package.parent).parts[:-1]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            start = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{start}.{alias.name}" for alias in node.names)
