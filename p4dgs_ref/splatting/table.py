"""The table of all equations: those of the paper, their building blocks, and those of splatting.

    from p4dgs_ref import EQUATIONS
    outputs, pullback = EQUATIONS["offsets"].vjp(x_a=x_a, O_a=O_a, l_a=l_a)
    gradients = pullback(x_bar=x_bar)

`p4dgs-ref oracle equations` prints it.
"""

from inspect import Parameter, signature
from itertools import starmap
from types import ModuleType
from typing import Any, Callable, NamedTuple

import numpy as np

from ..equations.table import ROWS
from . import compositing, covariance, projection


class Equation(NamedTuple):
    """One row of the table."""

    key: str  # the same name for the module, the published vectors and the file of test cases
    number: str  # further columns as in `equations.table`
    formula: str
    module: ModuleType
    outputs: tuple[str, ...]
    gradients: tuple[str, ...]

    @property
    def forward(self) -> Callable:
        """The module's `forward`."""
        return self.module.forward

    @property
    def backward(self) -> Callable:
        """The module's `backward`."""
        return self.module.backward

    def by_name(self, output: Any) -> dict[str, Any]:
        """The output of `forward` as {name: array}."""
        arrays = output if isinstance(output, tuple) else (output,)
        return dict(zip(self.outputs, arrays, strict=True))

    def __call__(self, **inputs) -> dict[str, Any]:
        """Return {output name: array}."""
        return self.by_name(self.forward(**inputs)[0])

    def vjp(self, **inputs) -> tuple[dict[str, Any], Callable]:
        """Return the outputs and their pullback.

        `pullback(x_bar=...)` returns {input name: gradient}. Cotangents that are left out are zero.
        """
        output, saved = self.forward(**inputs)
        outputs = self.by_name(output)

        def pullback(**cotangents):
            for name, parameter in signature(self.backward).parameters.items():
                if name.endswith("_bar") and parameter.default is Parameter.empty:
                    cotangents.setdefault(name, np.zeros_like(outputs[name.removesuffix("_bar")]))
            return self.backward(saved, **cotangents)

        return outputs, pullback


def equation(module, number, formula, outputs, gradients):
    """The Equation of a row; its key is the module's name."""
    key = module.__name__.rpartition(".")[2]
    return Equation(key, number, formula, module, tuple(outputs.split()), tuple(gradients.split()))


# Rows as in `equations.table`.
OF_SPLATTING = (
    (covariance, "", "Sigma = R(r) diag(s)^2 R(r)^T", "Sigma", "s r"),
    (
        projection,
        "",
        "Sigma_2D = J W Sigma W^T J^T + 0.3 I",
        "mean2d cov2d conic depth visible",
        "x Sigma",
    ),
    (
        compositing,
        "",
        "C = sum_i c_i alpha_i T_i + T_N background",
        "image transmittance",
        "mean2d conic alpha color background",
    ),
)
EQUATIONS: dict[str, Equation] = {row.key: row for row in starmap(equation, (*ROWS, *OF_SPLATTING))}


def to_markdown():
    """The table as Markdown, as tutorials/reference.md shows it."""
    # A bare bar in a formula would end its column.
    lines = ["| no. | key | file | formula |", "|---|---|---|---|"]
    for eq in EQUATIONS.values():
        file, formula = eq.module.__name__.replace(".", "/"), eq.formula.replace("|", "\\|")
        lines.append(f"| {eq.number} | `{eq.key}` | `{file}.py` | `{formula}` |")
    return "\n".join(lines)
