r"""Eq. (3): the opacities of an anchor's k Gaussians, predicted from its feature and the view.

.. math:: \{\alpha_0,\dots,\alpha_{k-1}\} = \tanh\,\psi_\alpha(f_a, \delta_{vc}, d_{vc})

The paper prints psi_alpha alone; the tanh is the activation of its parent, Scaffold-GS (Q4).
"""

from typing import NamedTuple

import numpy as np

from . import mlp
from .equation import Case, declare


class Out(NamedTuple):
    alpha: np.ndarray  # (A, k) in [-1, 1]; Gaussians below tau_alpha are masked afterwards


class Res(NamedTuple):
    alpha: (
        np.ndarray
    )  # (A, k)  for who watches training: growing looks at opacities before the mask
    slope: np.ndarray  # (A, k)  tanh'
    mlp: mlp.Res
    d: int  # width of the feature, where the input splits


def forward(f_a, delta_vc, d_vc, weights, biases):
    """Predict opacities.

    Shapes     f_a (A, d), delta_vc (A, 1), d_vc (A, 3), weights and biases of psi_alpha (d+4 -> k) -> alpha (A, k)
    Units      opacity, dimensionless; delta_vc: scene units
    Domain     all reals; delta_vc and d_vc of zero width where the scene lists no view effect
    Raises     ValueError from NumPy where widths do not chain
    Gradient   f_a, delta_vc, d_vc, weights, biases; kinks of the ReLUs only; fades as 4 exp(-2 |psi|)
    Choice     Q3: input order as printed; Q4: tanh, as the parent Scaffold-GS
    Reference  P-4DGS Eq. (3)
    """
    y, res = mlp.forward(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
    fading = np.exp(
        -2 * np.abs(y.y)
    )  # tanh' = 4 e / (1 + e)^2; 1 - tanh^2 cancels where tanh is near 1
    alpha = np.tanh(y.y)
    return Out(alpha), Res(alpha, 4 * fading / (1 + fading) ** 2, res, f_a.shape[1])


def backward(res, alpha_bar):
    return split_view(mlp.backward(res.mlp, alpha_bar * res.slope), res.d)


def split_view(gradients, d):
    """Give the gradient of a network's concatenated input back to feature, distance and direction."""
    x_bar = gradients.pop("x")
    return {
        "f_a": x_bar[:, :d],
        "delta_vc": x_bar[:, d : d + 1],
        "d_vc": x_bar[:, d + 1 :],
        **gradients,
    }


def view_inputs(rng, A=5, d=2, k=4, outputs=1, hidden=(7, 6)):
    """Inputs of an anchor network for the cases of Eqs. (3) and (4)."""
    d_vc = rng.normal(size=(A, 3))
    weights, biases = mlp.random_network(rng, d + 4, *hidden, k * outputs)
    return dict(
        f_a=rng.normal(size=(A, d)),
        delta_vc=rng.uniform(1, 5, size=(A, 1)),
        d_vc=d_vc / np.linalg.norm(d_vc, axis=1, keepdims=True),
        weights=weights,
        biases=biases,
    )


def without_view(inputs):
    """The same inputs for a scene without view effects: no view columns, no view rows in the first weight."""
    d = inputs["f_a"].shape[1]
    return {
        **inputs,
        "delta_vc": inputs["delta_vc"][:, :0],
        "d_vc": inputs["d_vc"][:, :0],
        "weights": [inputs["weights"][0][:d], *inputs["weights"][1:]],
    }


def cases():
    inputs = view_inputs(np.random.default_rng(3))
    yield Case("ordinary", inputs)
    yield Case("no_view", without_view(inputs), ("off",))
    biases = [*inputs["biases"][:-1], np.array([40.0, -40.0, 0.0, 400.0])]
    weights = [*inputs["weights"][:-1], 0 * inputs["weights"][-1]]
    yield Case(
        "saturated",
        {**inputs, "weights": weights, "biases": biases},
        ("saturated",),
        expected={"alpha": np.tile([1.0, -1.0, 0.0, 1.0], (5, 1))},
    )


opacity = declare(
    "opacity",
    "3",
    "alpha = tanh(psi_alpha(f_a, delta_vc, d_vc))",
    {
        "f_a": "A d",
        "delta_vc": "A 1",
        "d_vc": "A 3",
        "weights": "*I J",
        "biases": "*J",
        "alpha": "A k",
    },
    ("f_a", "delta_vc", "d_vc", "weights", "biases"),
    forward,
    backward,
    cases,
)
