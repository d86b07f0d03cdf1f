"""What a row of the table of equations is, and the rows of the paper: its equations in their order.

`splatting.table` joins them with the rows of splatting.
"""

from inspect import Parameter, signature
from types import ModuleType
from typing import Any, Callable, NamedTuple

import numpy as np

from . import (
    anchor_rate,
    color,
    deformation,
    deformed,
    hash_grid,
    hash_rate,
    likelihood,
    masking,
    mlp,
    noise,
    offsets,
    opacity,
    positional_encoding,
    prior,
    rate_loss,
    render_loss,
    rotation,
    rounding,
    scale,
    ssim,
    step,
    total_loss,
    view,
)


class Equation(NamedTuple):
    """One row of the table."""

    key: str  # the same name for the module, the published vectors and the file of test cases
    number: str  # "3'" for what Eq. (3) says by analogy, "" if the paper prints none
    formula: str
    module: ModuleType
    outputs: tuple[str, ...]
    gradients: tuple[str, ...]  # the inputs that receive a gradient

    @property
    def forward(self) -> Callable:
        """The module's `forward`."""
        return self.module.forward

    @property
    def backward(self) -> Callable:
        """The module's `backward`."""
        return self.module.backward

    def by_name(self, output: Any) -> dict[str, Any]:
        """Return the output of `forward` as {name: array}."""
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


def equation(module, *, number="", formula, outputs, gradients=""):
    """Return the row of a module; the names of outputs and gradients are separated by spaces."""
    return Equation(
        key=module.__name__.rpartition(".")[2],
        number=number,
        formula=formula,
        module=module,
        outputs=tuple(outputs.split()),
        gradients=tuple(gradients.split()),
    )


ANCHOR_NETWORK = "f_a delta_vc d_vc weights biases"
PAPER = (
    equation(
        offsets,
        number="1",
        formula="x = x_a + O_a * l_a",
        outputs="x",
        gradients="x_a O_a l_a",
    ),
    equation(
        view,
        number="2",
        formula="delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc",
        outputs="delta_vc d_vc",
        gradients="x_a",
    ),
    equation(
        opacity,
        number="3",
        formula="alpha = tanh(psi_alpha(f_a, delta_vc, d_vc))",
        outputs="alpha",
        gradients=ANCHOR_NETWORK,
    ),
    equation(
        masking,
        formula="keep where mask and alpha >= tau_alpha",
        outputs="alpha x color s r index",
        gradients="x s r alpha color",
    ),
    equation(
        color,
        number="3'",
        formula="color = sigmoid(psi_c(f_a, delta_vc, d_vc))",
        outputs="color",
        gradients=ANCHOR_NETWORK,
    ),
    equation(
        rotation,
        number="3'",
        formula="r = psi_r / |psi_r|, psi_r = psi_r(f_a, delta_vc, d_vc)",
        outputs="r",
        gradients=ANCHOR_NETWORK,
    ),
    equation(
        scale,
        number="4",
        formula="s = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc))",
        outputs="s",
        gradients=f"s_a {ANCHOR_NETWORK}",
    ),
    equation(
        positional_encoding,
        formula="E(p) = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1",
        outputs="E",
        gradients="p",
    ),
    equation(
        deformation,
        number="5",
        formula="(delta_x, delta_s, delta_r) = psi_d(concat(E(x), E(t)))",
        outputs="delta_x delta_s delta_r",
        gradients="x weights biases",
    ),
    equation(
        deformed,
        number="6",
        formula="x_t = x + delta_x, s_t = s + delta_s, r_t = (r + delta_r) / |r + delta_r|",
        outputs="x_t s_t r_t",
        gradients="x s r delta_x delta_s delta_r",
    ),
    equation(
        noise,
        number="7",
        formula="f_noisy = f + u q",
        outputs="f_noisy",
        gradients="f q",
    ),
    equation(
        step,
        number="8",
        formula="q = Q_0 (1 + tanh(psi_q(h)))",
        outputs="q",
        gradients="h weights biases",
    ),
    equation(
        hash_grid,
        number="9",
        formula="h = H(x_a): multilinear reads of binary grids",
        outputs="h",
        gradients="grids",
    ),
    equation(
        rounding,
        number="10",
        formula="f_hat = round_half_even(f / q) q",
        outputs="symbols f_hat",
    ),
    equation(
        likelihood,
        number="11",
        formula="bits = -log2(Phi((f_noisy + q/2 - mu) / sigma) "
        "- Phi((f_noisy - q/2 - mu) / sigma))",
        outputs="bits",
        gradients="f_noisy mu sigma q",
    ),
    equation(
        prior,
        number="12",
        formula="(mu, sigma) = psi_p(h)",
        outputs="mu sigma",
        gradients="h weights biases",
    ),
    equation(
        anchor_rate,
        number="13",
        formula="R_anchor = sum of the bits of f, s, l, O over all anchors",
        outputs="R_anchor",
        gradients="bits_f bits_s bits_l bits_O",
    ),
    equation(
        hash_rate,
        number="14",
        formula="R_hash = N+ (-log2 p+) + N- (-log2 p-)",
        outputs="R_hash n_pos n_neg",
        gradients="grids",
    ),
    equation(
        total_loss,
        number="15",
        formula="L_total = lambda_rate L_rate + L_render",
        outputs="L_total",
        gradients="L_render L_rate",
    ),
    equation(
        render_loss,
        number="16",
        formula="L_render = (1 - lambda_ssim) L1 + lambda_ssim (1 - SSIM)",
        outputs="L_render L1 D_SSIM",
        gradients="image",
    ),
    equation(
        rate_loss,
        number="17",
        formula="bits = R_anchor + R_hash, L_rate = bits / n_parameters",
        outputs="bits L_rate",
        gradients="R_anchor R_hash",
    ),
    equation(
        mlp,
        formula="y = relu(... relu(x W_0 + b_0) ...) W_n + b_n",
        outputs="y",
        gradients="x weights biases",
    ),
    equation(
        ssim,
        formula="mean (2 mu_x mu_y + C1)(2 sigma_xy + C2) "
        "/ ((mu_x^2 + mu_y^2 + C1)(sigma_x^2 + sigma_y^2 + C2))",
        outputs="ssim",
        gradients="image",
    ),
)
