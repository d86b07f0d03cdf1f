r"""Eq. (3) applied to colour: the colours of an anchor's k Gaussians, predicted from its feature and the view.

.. math:: \{c_0,\dots,c_{k-1}\} = \mathrm{sigmoid}\,\psi_c(f_a, \delta_{vc}, d_{vc})
"""

from typing import NamedTuple

import numpy as np
from scipy.special import expit as sigmoid

from . import mlp
from .equation import Case, declare
from .opacity import split_view, view_inputs, without_view


class Out(NamedTuple):
    color: np.ndarray  # (A, k, 3) red, green, blue in [0, 1]


class Res(NamedTuple):
    slope: np.ndarray  # (A, k, 3)  sigmoid'
    mlp: mlp.Res
    d: int  # width of the feature, where the input splits


def forward(f_a, delta_vc, d_vc, weights, biases):
    """Predict colours.

    Shapes     f_a (A, d), delta_vc (A, 1), d_vc (A, 3), weights and biases of psi_c (d+4 -> 3k) -> color (A, k, 3)
    Units      color: RGB of the images, 0 to 1; delta_vc: scene units
    Domain     all reals; delta_vc and d_vc of zero width where the scene lists no view effect
    Raises     ValueError from NumPy where widths do not chain or the last one is no multiple of 3
    Gradient   f_a, delta_vc, d_vc, weights, biases; kinks of the ReLUs only; fades as exp(-|psi|)
    Choice     Q3: input order as printed, outputs child by child; Q4: sigmoid, as the parent Scaffold-GS
    Reference  P-4DGS Eq. (3), "predicted analogously"
    """
    y, res = mlp.forward(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
    A, width = y.y.shape
    color, rest = (
        sigmoid(v).reshape(A, width // 3, 3) for v in (y.y, -y.y)
    )  # 1 - color cancels near 1
    return Out(color), Res(color * rest, res, f_a.shape[1])


def backward(res, color_bar):
    A, k, _ = res.slope.shape
    return split_view(mlp.backward(res.mlp, (color_bar * res.slope).reshape(A, 3 * k)), res.d)


def cases():
    inputs = view_inputs(np.random.default_rng(7), A=6, d=2, k=5, outputs=3)
    yield Case("ordinary", inputs)
    yield Case("no_view", without_view(inputs), ("off",))
    yield Case(
        "one_anchor",
        {n: a if isinstance(a, list) else a[:1] for n, a in inputs.items()},
        ("single",),
    )
    yield Case(
        "no_anchor", {n: a if isinstance(a, list) else a[:0] for n, a in inputs.items()}, ("empty",)
    )
    # Constant logits: as 1 / (1 + exp(-psi)) they would overflow at -800, as (1 + tanh(psi / 2)) / 2 vanish at -40.
    weights = [*inputs["weights"][:-1], 0 * inputs["weights"][-1]]
    for name, psi, exact in (
        ("dark", -40.0, np.exp(-40.0)),
        ("black", -800.0, 0.0),
        ("white", 800.0, 1.0),
    ):
        yield Case(
            name,
            {**inputs, "weights": weights, "biases": [*inputs["biases"][:-1], np.full(15, psi)]},
            ("saturated",),
            expected={"color": np.full((6, 5, 3), exact)},
        )


color = declare(
    "color",
    "3'",
    "color = sigmoid(psi_c(f_a, delta_vc, d_vc))",
    {
        "f_a": "A d",
        "delta_vc": "A 1",
        "d_vc": "A 3",
        "weights": "*I J",
        "biases": "*J",
        "color": "A k 3",
    },
    ("f_a", "delta_vc", "d_vc", "weights", "biases"),
    forward,
    backward,
    cases,
)
