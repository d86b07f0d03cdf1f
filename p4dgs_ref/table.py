"""The table of equations: the paper's in its order, then their building blocks.

    from p4dgs_ref import EQUATIONS
    outputs, pullback = EQUATIONS["offsets"].vjp(x_a=x_a, O_a=O_a, l_a=l_a)
    gradients = pullback(x_bar=x_bar)

`p4dgs-ref oracle equations` prints it. An equation's module is imported when it is first used.
"""

from importlib import import_module
from inspect import Parameter, signature
from typing import Any, Callable, NamedTuple

import numpy as np

from .attributes import GROUPS


class Equation(NamedTuple):
    """One row of the table."""

    key: str  # the same name for the module, the published vectors and the file of test cases
    number: str  # as printed; "3'" for what Eq. (3) says by analogy, "" where the paper prints none
    formula: str
    module: str
    outputs: tuple[str, ...]
    gradients: tuple[str, ...]  # the inputs that receive a gradient; the others are data

    @property
    def forward(self) -> Callable:
        """The module's `forward`."""
        return import_module(self.module).forward

    @property
    def backward(self) -> Callable:
        """The module's `backward`."""
        return import_module(self.module).backward

    def named(self, output: Any) -> dict[str, Any]:
        """The output of `forward` as {name: array}."""
        arrays = output if isinstance(output, tuple) else (output,)
        return dict(zip(self.outputs, arrays, strict=True))

    def __call__(self, **inputs) -> dict[str, Any]:
        """Return {output name: array}."""
        return self.named(self.forward(**inputs)[0])

    def vjp(self, **inputs) -> tuple[dict[str, Any], Callable]:
        """Return the outputs and their pullback.

        `pullback(x_bar=...)` returns {input name: gradient}. Cotangents that are left out are zero.
        """
        output, saved = self.forward(**inputs)
        outputs = self.named(output)

        def pullback(**cotangents):
            for name, parameter in signature(self.backward).parameters.items():
                if name.endswith("_bar") and parameter.default is Parameter.empty:
                    cotangents.setdefault(name, np.zeros_like(outputs[name.removesuffix("_bar")]))
            return self.backward(saved, **cotangents)

        return outputs, pullback


ANCHOR_NETWORK = ("f_a", "delta_vc", "d_vc", "weights", "biases")

_ROWS = (
    Equation(
        "offsets",
        "1",
        "x = x_a + O_a * l_a",
        "p4dgs_ref.equations.offsets",
        ("x",),
        ("x_a", "O_a", "l_a"),
    ),
    Equation(
        "view",
        "2",
        "delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc",
        "p4dgs_ref.equations.view",
        ("delta_vc", "d_vc"),
        ("x_a",),
    ),
    Equation(
        "opacity",
        "3",
        "alpha = tanh(psi_alpha(f_a, delta_vc, d_vc))",
        "p4dgs_ref.equations.opacity",
        ("alpha",),
        ANCHOR_NETWORK,
    ),
    Equation(
        "masking",
        "",
        "keep where mask and alpha >= tau_alpha",
        "p4dgs_ref.equations.masking",
        ("alpha", "x", "color", "s", "r", "index"),
        ("alpha", "x", "color", "s", "r"),
    ),
    Equation(
        "color",
        "3'",
        "color = sigmoid(psi_c(f_a, delta_vc, d_vc))",
        "p4dgs_ref.equations.color",
        ("color",),
        ANCHOR_NETWORK,
    ),
    Equation(
        "rotation",
        "3'",
        "r = psi_r / |psi_r|, psi_r = psi_r(f_a, delta_vc, d_vc)",
        "p4dgs_ref.equations.rotation",
        ("r",),
        ANCHOR_NETWORK,
    ),
    Equation(
        "scale",
        "4",
        "s = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc))",
        "p4dgs_ref.equations.scale",
        ("s",),
        ("s_a", *ANCHOR_NETWORK),
    ),
    Equation(
        "positional_encoding",
        "",
        "E(p) = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1",
        "p4dgs_ref.equations.positional_encoding",
        ("E",),
        ("p",),
    ),
    Equation(
        "deformation",
        "5",
        "(delta_x, delta_s, delta_r) = psi_d(concat(E(x), E(t)))",
        "p4dgs_ref.equations.deformation",
        ("delta_x", "delta_s", "delta_r"),
        ("x", "weights", "biases"),
    ),
    Equation(
        "deformed",
        "6",
        "x_t = x + delta_x, s_t = s + delta_s, r_t = (r + delta_r) / |r + delta_r|",
        "p4dgs_ref.equations.deformed",
        ("x_t", "s_t", "r_t"),
        ("x", "s", "r", "delta_x", "delta_s", "delta_r"),
    ),
    Equation(
        "noise",
        "7",
        "f_noisy = f + u q",
        "p4dgs_ref.equations.noise",
        ("f_noisy",),
        ("f", "q"),
    ),
    Equation(
        "step",
        "8",
        "q = Q_0 (1 + tanh(psi_q(h)))",
        "p4dgs_ref.equations.step",
        ("q",),
        ("h", "weights", "biases"),
    ),
    Equation(
        "hash_grid",
        "9",
        "h = H(x_a): multilinear reads of binary grids",
        "p4dgs_ref.equations.hash_grid",
        ("h",),
        ("grids",),
    ),
    Equation(
        "rounding",
        "10",
        "f_hat = round_half_even(f / q) q",
        "p4dgs_ref.equations.rounding",
        ("symbols", "f_hat"),
        (),
    ),
    Equation(
        "likelihood",
        "11",
        "bits = -log2(Phi((f_noisy + q/2 - mu) / sigma) - Phi((f_noisy - q/2 - mu) / sigma))",
        "p4dgs_ref.equations.likelihood",
        ("bits",),
        ("f_noisy", "mu", "sigma", "q"),
    ),
    Equation(
        "prior",
        "12",
        "(mu, sigma) = psi_p(h)",
        "p4dgs_ref.equations.prior",
        ("mu", "sigma"),
        ("h", "weights", "biases"),
    ),
    Equation(
        "anchor_rate",
        "13",
        f"R_anchor = sum of the bits of {', '.join(GROUPS)} over all anchors",
        "p4dgs_ref.equations.anchor_rate",
        ("R_anchor",),
        tuple(f"bits_{group}" for group in GROUPS),
    ),
    Equation(
        "hash_rate",
        "14",
        "R_hash = N+ (-log2 p+) + N- (-log2 p-)",
        "p4dgs_ref.equations.hash_rate",
        ("R_hash", "n_pos", "n_neg"),
        ("grids",),
    ),
    Equation(
        "total_loss",
        "15",
        "L_total = lambda_rate L_rate + L_render",
        "p4dgs_ref.equations.total_loss",
        ("L_total",),
        ("L_render", "L_rate"),
    ),
    Equation(
        "render_loss",
        "16",
        "L_render = (1 - lambda_ssim) L1 + lambda_ssim (1 - SSIM)",
        "p4dgs_ref.equations.render_loss",
        ("L_render", "L1", "D_SSIM"),
        ("image",),
    ),
    Equation(
        "rate_loss",
        "17",
        "bits = R_anchor + R_hash, L_rate = bits / n_parameters",
        "p4dgs_ref.equations.rate_loss",
        ("bits", "L_rate"),
        ("R_anchor", "R_hash"),
    ),
    Equation(
        "mlp",
        "",
        "y = relu(... relu(x W_0 + b_0) ...) W_n + b_n",
        "p4dgs_ref.equations.mlp",
        ("y",),
        ("x", "weights", "biases"),
    ),
    Equation(
        "ssim",
        "",
        "mean (2 mu_x mu_y + C1)(2 sigma_xy + C2) "
        "/ ((mu_x^2 + mu_y^2 + C1)(sigma_x^2 + sigma_y^2 + C2))",
        "p4dgs_ref.equations.ssim",
        ("ssim",),
        ("image",),
    ),
    Equation(
        "covariance",
        "",
        "Sigma = R(r) diag(s)^2 R(r)^T",
        "p4dgs_ref.splatting.covariance",
        ("Sigma",),
        ("s", "r"),
    ),
    Equation(
        "projection",
        "",
        "Sigma_2D = J W Sigma W^T J^T + 0.3 I",
        "p4dgs_ref.splatting.projection",
        ("mean2d", "cov2d", "conic", "depth", "visible"),
        ("x", "Sigma"),
    ),
    Equation(
        "compositing",
        "",
        "C = sum_i c_i alpha_i T_i + T_N background",
        "p4dgs_ref.splatting.compositing",
        ("image", "transmittance"),
        ("mean2d", "conic", "alpha", "color", "background"),
    ),
)

EQUATIONS: dict[str, Equation] = {row.key: row for row in _ROWS}


def to_markdown(equations=EQUATIONS):
    """The table as Markdown, as tutorials/reference.md shows it."""
    # A bare bar in a formula would end its column.
    lines = ["| no. | key | file | formula |", "|---|---|---|---|"]
    for eq in equations.values():
        file, formula = eq.module.replace(".", "/"), eq.formula.replace("|", "\\|")
        lines.append(f"| {eq.number} | `{eq.key}` | `{file}.py` | `{formula}` |")
    return "\n".join(lines)
