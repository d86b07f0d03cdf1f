"""Reads the form of a tutorial from its source.

A file in percent format is a sequence of cells. Each begins with a line `# %%`; a cell of prose
begins with `# %% [markdown]`, and all its lines are comments.
"""

import re

from tutorials.tools.notebooks import cells

HEADINGS = [
    "Claim",
    "By hand",
    "In code",
    "Backward by hand",
    "Break it",
    "What a codec does with it",
    "Exercises",
    "Check your port",
]


def headings(source):
    """The second-level headings in order."""
    prose = "\n".join(cell.text for cell in cells(source) if cell.prose)
    return re.findall(r"^## (.*)$", prose, re.M)


def flaws(source):
    """Code in cells of prose: ["line 5", ...]."""
    return [
        f"line {i}"
        for cell in cells(source)
        for i, line in enumerate(cell.lines, cell.line + 1)
        if cell.prose and line.strip() and not line.startswith("#")
    ]
