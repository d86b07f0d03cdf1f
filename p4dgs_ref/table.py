"""The whole table of equations: the paper's, then the support it takes from 3DGS; printed by `p4dgs-ref equations`."""

from . import splatting  # noqa: F401  declares covariance, projection, compositing after the paper's equations
from .equations import EQUATIONS


def rows():
    """One row {number, key, file, formula} an equation, in paper order; an empty number is text or support."""
    return [
        {
            "number": eq.number,
            "key": eq.key,
            "file": eq.module.replace(".", "/") + ".py",
            "formula": eq.formula,
        }
        for eq in EQUATIONS.values()
    ]


def table():
    """The table as Markdown, the form in which the README holds its copy."""
    lines = ["| no. | key | file | formula |", "|---|---|---|---|"]
    for row in rows():
        formula = row["formula"].replace("|", "\\|")  # a bar would end the column
        lines.append(f"| {row['number']} | `{row['key']}` | `{row['file']}` | `{formula}` |")
    return "\n".join(lines)
