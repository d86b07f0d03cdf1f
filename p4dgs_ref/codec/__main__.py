"""`python -m p4dgs_ref.codec` prints the complete format as one page: what its files say of themselves, and the tables.

Each part of the format stands in the docstring of the file that implements it; this is the order in which to read them.
"""

import sys
from importlib import import_module

from .fixed_point import table

PAGES = (
    ".container",
    ".file",
    ".header",
    ".context",
    "..equations.grid_nodes",
    ".fixed_point",
    ".gaussian_table",
    ".streams",
    ".rans",
)
TABLES = ("phi", "exp2", "sigmoid", "log2")


def page():
    """The format page as text."""
    parts = []
    for number, name in enumerate(PAGES, 1):
        module = import_module(name, __package__)
        title = f"{number}. {module.__name__.replace('.', '/')}.py"
        parts.append(f"{title}\n{'=' * len(title)}\n\n{module.__doc__.strip()}\n")
        if name.endswith("grid_nodes"):  # its formulas stand with its functions
            parts += [
                f"{function.__name__}{chr(10)}{function.__doc__.strip()}\n"
                for function in (module.nodes, module.entries)
            ]
    for name in TABLES:
        parts.append(f"table {name!r}\n" + " ".join(map(str, table(name).tolist())) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    sys.stdout.write(page())
