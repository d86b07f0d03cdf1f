"""The table of all equations: those of the paper, their building blocks, and those of splatting.

    from p4dgs_ref import EQUATIONS
    outputs, pullback = EQUATIONS["offsets"].vjp(x_a=x_a, O_a=O_a, l_a=l_a)
    gradients = pullback(x_bar=x_bar)

`p4dgs-ref oracle equations` prints it.
"""

from ..equations.table import PAPER, Equation, equation
from . import compositing, covariance, projection

SPLATTING = (
    equation(
        covariance,
        formula="Sigma = R(r) diag(s)^2 R(r)^T",
        outputs="Sigma",
        gradients="s r",
    ),
    equation(
        projection,
        formula="Sigma_2D = J W Sigma W^T J^T + 0.3 I",
        outputs="mean2d cov2d conic depth visible",
        gradients="x Sigma",
    ),
    equation(
        compositing,
        formula="C = sum_i c_i alpha_i T_i + T_N background",
        outputs="image transmittance",
        gradients="mean2d conic alpha color background",
    ),
)
EQUATIONS: dict[str, Equation] = {row.key: row for row in (*PAPER, *SPLATTING)}


def to_markdown():
    """Return the table as Markdown, as tutorials/reference.md shows it."""
    # A bare bar in a formula would end its column.
    lines = ["| no. | key | file | formula |", "|---|---|---|---|"]
    for eq in EQUATIONS.values():
        file, formula = eq.module.__name__.replace(".", "/"), eq.formula.replace("|", "\\|")
        lines.append(f"| {eq.number} | `{eq.key}` | `{file}.py` | `{formula}` |")
    return "\n".join(lines)
