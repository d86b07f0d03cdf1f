"""`python -m p4dgs_ref.codec` prints the complete file format as one page.

Every part of the format is the docstring of the module that implements it. The page begins at the
outside of the file and ends with the tables of integers that a decoder needs and with a section on
how a picture is drawn from the decoded arrays.
"""

import sys
from importlib import import_module
from pathlib import Path
from textwrap import fill

from .gaussian_table import lookup_table

PARTS = (
    "container",
    "file",
    "header",
    "context",
    "gaussian_table",
    "streams",
    "rans",
)
PICTURE = Path(__file__).with_name("picture.txt")
TABLES = {
    "phi": "round(2^24 Phi(z)) at z = -6, -6 + 1/64, ... 6, Phi the normal distribution function",
    "exp2": "round(2^16 2^(-i/16)) for i = 0, 1, ... 15",
    "sigmoid": "round(2^24 / (1 + exp(-2 u))) at u = -4, -4 + 1/64, ... 6",
    "log2": "round(2^16 log2(1 + i/256)) for i = 0, 1, ... 256",
}


def page():
    """Return the format page as text."""
    texts = {
        **{f"{name}.py": import_module(f".{name}", __package__).__doc__ for name in PARTS},
        **{
            f"Table {name}": f"{meaning}\n\n{fill(' '.join(map(str, lookup_table(name))), 100)}"
            for name, meaning in TABLES.items()
        },
        "From the arrays to a picture": PICTURE.read_text(encoding="utf-8"),
    }
    whole = "The file format of p4dgs_ref\n"
    for number, (name, text) in enumerate(texts.items(), 1):
        heading = f"{number}. {name}"
        whole += f"\n\n{heading}\n{'=' * len(heading)}\n\n{text.strip()}\n"
    return whole


if __name__ == "__main__":
    if sys.flags.optimize > 1:  # Python has removed the docstrings
        sys.stderr.write("the page consists of docstrings; expected Python without -OO\n")
        sys.exit(2)
    print(page(), end="")
