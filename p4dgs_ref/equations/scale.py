r"""Eq. (4): the scales of an anchor's k Gaussians, as fractions of the anchor's own scale.

.. math:: \{s_0,\dots,s_{k-1}\} = s_a \cdot \mathrm{sigmoid}\,\psi_s(f_a, \delta_{vc}, d_{vc})
"""

from typing import NamedTuple

import numpy as np
from scipy.special import expit as sigmoid

from . import mlp
from .equation import Case, declare
from .opacity import split_view, view_inputs, without_view


class Out(NamedTuple):
    s: np.ndarray  # (A, k, 3)


class Res(NamedTuple):
    s_a: np.ndarray  # (A, 3)  the untouched input
    fraction: np.ndarray  # (A, k, 3)  of s_a
    slope: np.ndarray  # (A, k, 3)  sigmoid'
    mlp: mlp.Res
    d: int  # width of the feature, where the input splits


def forward(s_a, f_a, delta_vc, d_vc, weights, biases):
    """Predict scales.

    Shapes     s_a (A, 3), f_a (A, d), delta_vc (A, 1), d_vc (A, 3), psi_s (d+4 -> 3k) -> s (A, k, 3)
    Units      s_a, s: scene units, standard deviations along the axes of the Gaussian; delta_vc: scene units
    Domain     all reals; delta_vc and d_vc of zero width where the scene lists no view effect
    Raises     ValueError from NumPy where widths do not chain or the last one is no multiple of 3
    Gradient   s_a, f_a, delta_vc, d_vc, weights, biases; kinks of the ReLUs only; fades as exp(-|psi|)
    Choice     Q3: input order as printed, outputs child by child; Q5: s_a is the linear value, not its logarithm
    Reference  P-4DGS Eq. (4)
    """
    y, res = mlp.forward(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
    A, width = y.y.shape
    fraction, rest = (
        sigmoid(v).reshape(A, width // 3, 3) for v in (y.y, -y.y)
    )  # 1 - fraction cancels near 1
    return Out(s_a[:, None, :] * fraction), Res(s_a, fraction, fraction * rest, res, f_a.shape[1])


def backward(res, s_bar):
    A, k, _ = res.fraction.shape
    y_bar = s_bar * res.s_a[:, None, :] * res.slope
    return {
        "s_a": (s_bar * res.fraction).sum(axis=1),  # one anchor scales all its children: sum over k
        **split_view(mlp.backward(res.mlp, y_bar.reshape(A, 3 * k)), res.d),
    }


def cases():
    rng = np.random.default_rng(9)
    inputs = dict(s_a=rng.lognormal(size=(6, 3)), **view_inputs(rng, A=6, d=2, k=5, outputs=3))
    yield Case("ordinary", inputs)
    yield Case("no_view", without_view(inputs), ("off",))
    yield Case(
        "no_anchor", {n: a if isinstance(a, list) else a[:0] for n, a in inputs.items()}, ("empty",)
    )
    yield Case("negative", {**inputs, "s_a": -inputs["s_a"]}, ("negative",))
    yield Case(
        "flat", {**inputs, "s_a": 0 * inputs["s_a"]}, ("zero",), expected={"s": np.zeros((6, 5, 3))}
    )
    weights = [*inputs["weights"][:-1], 0 * inputs["weights"][-1]]
    for name, psi, exact in (("needle", -40.0, np.exp(-40.0)), ("full", 800.0, 1.0)):
        yield Case(
            name,
            {**inputs, "weights": weights, "biases": [*inputs["biases"][:-1], np.full(15, psi)]},
            ("saturated",),
            expected={"s": np.repeat(inputs["s_a"][:, None] * exact, 5, axis=1)},
        )


scale = declare(
    "scale",
    "4",
    "s = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc))",
    {
        "s_a": "A 3",
        "f_a": "A d",
        "delta_vc": "A 1",
        "d_vc": "A 3",
        "weights": "*I J",
        "biases": "*J",
        "s": "A k 3",
    },
    ("s_a", "f_a", "delta_vc", "d_vc", "weights", "biases"),
    forward,
    backward,
    cases,
)
