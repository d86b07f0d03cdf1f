"""The table of all equations: those of the paper, their building blocks, and those of splatting.

`p4dgs-ref oracle equations` prints it.
"""

from ..equations.table import ROWS, Equation, row
from . import compositing, covariance, projection

ALL = (
    *ROWS,
    row(covariance, "", "Sigma = R(r) diag(s)^2 R(r)^T", "Sigma", "s r"),
    row(
        projection,
        "",
        "Sigma_2D = J W Sigma W^T J^T + 0.3 I",
        "mean2d cov2d conic depth visible",
        "x Sigma",
    ),
    row(
        compositing,
        "",
        "C = sum_i c_i alpha_i T_i + T_N background",
        "image transmittance",
        "mean2d conic alpha color background",
    ),
)
EQUATIONS: dict[str, Equation] = {row.key: row for row in ALL}


def to_markdown(equations=EQUATIONS):
    """The table as Markdown, as tutorials/reference.md shows it."""
    # A bare bar in a formula would end its column.
    lines = ["| no. | key | file | formula |", "|---|---|---|---|"]
    for eq in equations.values():
        file, formula = eq.module.__name__.replace(".", "/"), eq.formula.replace("|", "\\|")
        lines.append(f"| {eq.number} | `{eq.key}` | `{file}.py` | `{formula}` |")
    return "\n".join(lines)
