"""The equations of the paper in its order, then their building blocks: a row each.

`p4dgs_ref.splatting.table` adds the rows of splatting, and `p4dgs_ref.EQUATIONS` is all of them:

    outputs, pullback = EQUATIONS["offsets"].vjp(x_a=x_a, O_a=O_a, l_a=l_a)
    gradients = pullback(x_bar=x_bar)
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
    number: str  # as printed; "3'" for what Eq. (3) says by analogy, "" where the paper prints none
    formula: str
    module: ModuleType
    outputs: tuple[str, ...]
    gradients: tuple[str, ...]  # the inputs that receive a gradient; the others are data

    @property
    def forward(self) -> Callable:
        """The module's `forward`."""
        return self.module.forward

    @property
    def backward(self) -> Callable:
        """The module's `backward`."""
        return self.module.backward

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


def row(module: ModuleType, number: str, formula: str, outputs: str, gradients: str) -> Equation:
    """The row of a module, whose name is the key. Names of arrays are separated by blanks."""
    key = module.__name__.rpartition(".")[2]
    return Equation(key, number, formula, module, tuple(outputs.split()), tuple(gradients.split()))


ANCHOR_NETWORK = "f_a delta_vc d_vc weights biases"

ROWS = (
    row(offsets, "1", "x = x_a + O_a * l_a", "x", "x_a O_a l_a"),
    row(view, "2", "delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc", "delta_vc d_vc", "x_a"),
    row(opacity, "3", "alpha = tanh(psi_alpha(f_a, delta_vc, d_vc))", "alpha", ANCHOR_NETWORK),
    row(
        masking,
        "",
        "keep where mask and alpha >= tau_alpha",
        "alpha x color s r index",
        "alpha x color s r",
    ),
    row(color, "3'", "color = sigmoid(psi_c(f_a, delta_vc, d_vc))", "color", ANCHOR_NETWORK),
    row(
        rotation,
        "3'",
        "r = psi_r / |psi_r|, psi_r = psi_r(f_a, delta_vc, d_vc)",
        "r",
        ANCHOR_NETWORK,
    ),
    row(scale, "4", "s = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc))", "s", f"s_a {ANCHOR_NETWORK}"),
    row(positional_encoding, "", "E(p) = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1", "E", "p"),
    row(
        deformation,
        "5",
        "(delta_x, delta_s, delta_r) = psi_d(concat(E(x), E(t)))",
        "delta_x delta_s delta_r",
        "x weights biases",
    ),
    row(
        deformed,
        "6",
        "x_t = x + delta_x, s_t = s + delta_s, r_t = (r + delta_r) / |r + delta_r|",
        "x_t s_t r_t",
        "x s r delta_x delta_s delta_r",
    ),
    row(noise, "7", "f_noisy = f + u q", "f_noisy", "f q"),
    row(step, "8", "q = Q_0 (1 + tanh(psi_q(h)))", "q", "h weights biases"),
    row(hash_grid, "9", "h = H(x_a): multilinear reads of binary grids", "h", "grids"),
    row(rounding, "10", "f_hat = round_half_even(f / q) q", "symbols f_hat", ""),
    row(
        likelihood,
        "11",
        "bits = -log2(Phi((f_noisy + q/2 - mu) / sigma) - Phi((f_noisy - q/2 - mu) / sigma))",
        "bits",
        "f_noisy mu sigma q",
    ),
    row(prior, "12", "(mu, sigma) = psi_p(h)", "mu sigma", "h weights biases"),
    row(
        anchor_rate,
        "13",
        "R_anchor = sum of the bits of f, s, l, O over all anchors",
        "R_anchor",
        "bits_f bits_s bits_l bits_O",
    ),
    row(hash_rate, "14", "R_hash = N+ (-log2 p+) + N- (-log2 p-)", "R_hash n_pos n_neg", "grids"),
    row(total_loss, "15", "L_total = lambda_rate L_rate + L_render", "L_total", "L_render L_rate"),
    row(
        render_loss,
        "16",
        "L_render = (1 - lambda_ssim) L1 + lambda_ssim (1 - SSIM)",
        "L_render L1 D_SSIM",
        "image",
    ),
    row(
        rate_loss,
        "17",
        "bits = R_anchor + R_hash, L_rate = bits / n_parameters",
        "bits L_rate",
        "R_anchor R_hash",
    ),
    row(mlp, "", "y = relu(... relu(x W_0 + b_0) ...) W_n + b_n", "y", "x weights biases"),
    row(
        ssim,
        "",
        "mean (2 mu_x mu_y + C1)(2 sigma_xy + C2) "
        "/ ((mu_x^2 + mu_y^2 + C1)(sigma_x^2 + sigma_y^2 + C2))",
        "ssim",
        "image",
    ),
)
