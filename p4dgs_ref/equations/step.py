r"""Eq. (8): the quantisation step of every anchor and attribute group, learnt from the hash feature.

.. math:: q = Q_0 \cdot (1 + \tanh \psi_q(h)) = 2 Q_0\,\mathrm{sigmoid}(2 \psi_q(h))
"""

from typing import NamedTuple

import numpy as np
from scipy.special import expit

from . import mlp
from .equation import Case, declare

FLOOR = (
    2.0**-10
)  # of Q_0: 1 + tanh is exactly 0 in float32 from psi_q = -10 on, and f/q would be infinite


class Out(NamedTuple):
    q: np.ndarray  # (A, G)


class Res(NamedTuple):
    slope: np.ndarray  # (A, G)  dq / d psi_q
    mlp: tuple


def forward(h, weights, biases, Q_0):
    """Predict steps.

    Shapes     h (A, I), weights and biases of psi_q (I -> G), Q_0 (G,) -> q (A, G); G = 4 groups f, s, l, O
    Units      q, Q_0: of the group's attribute; h: dimensionless
    Domain     all reals, Q_0 > 0; FLOOR * Q_0 <= q <= 2 Q_0
    Raises     ValueError from NumPy where widths do not chain
    Gradient   h, weights, biases; 0 on the floor; Q_0 is data
    Choice     Q7: the sigmoid form, which keeps digits where 1 + tanh cancels, and its floor
    Reference  P-4DGS Eq. (8)
    """
    y, res = mlp.forward(h, weights, biases)
    share = expit(2 * y)
    # sigmoid' = s (1 - s), where 1 - s is sigmoid(-v): it keeps its digits where s rounds to 1
    slope = np.where(share > FLOOR / 2, 4 * Q_0 * share * expit(-2 * y), 0)
    return Out(2 * Q_0 * np.maximum(share, FLOOR / 2)), Res(slope, res)


def backward(res, q_bar):
    gradients = mlp.backward(res.mlp, q_bar * res.slope)
    return {"h": gradients["x"], "weights": gradients["weights"], "biases": gradients["biases"]}


def cases():
    from ..studies.random_inputs import random_network

    rng = np.random.default_rng(13)
    weights, biases = random_network(rng, 5, 7, 4)
    inputs = dict(
        h=rng.normal(size=(6, 5)),
        weights=weights,
        biases=biases,
        Q_0=np.array([1.0, 0.001, 0.002, 0.2]),
    )
    yield Case("ordinary", inputs)
    yield Case("no_anchor", {**inputs, "h": inputs["h"][:0]}, ("empty",))
    flat = dict(h=np.zeros((1, 5)), weights=[np.zeros((5, 4))], Q_0=np.ones(4))
    # by hand: psi_q = 0 gives Q_0; tanh(1); on the floor; far below it
    yield Case(
        "saturated",
        {**flat, "biases": [np.array([0.0, 1.0, -10.0, -1e4])]},
        ("saturated", "clamped"),
        smooth=False,
        cotangents={"q_bar": np.array([[2.0, 3.0, 5.0, 7.0]])},
        expected={
            "q": np.array([[1.0, 1.7615941559557649, FLOOR, FLOOR]]),
            "biases_bar": [np.array([2.0, 3 * 0.41997434161402607, 0.0, 0.0])],
        },
    )
    # 1 - tanh^2 is 0 in floats from 19 on; the slope is 4 exp(-2u)
    yield Case(
        "large",
        {**flat, "biases": [np.array([20.0, 30, 400, 1e4])]},
        ("saturated", "extreme"),
        smooth=False,
        cotangents={"q_bar": np.array([[0.0, 5.0, 7.0, 11.0]])},
        expected={"q": np.full((1, 4), 2.0), "biases_bar": [np.array([0, 20 * np.exp(-60), 0, 0])]},
    )


step = declare(
    "step",
    "8",
    "q = Q_0 (1 + tanh(psi_q(h)))",
    {"h": "A I", "weights": "*I J", "biases": "*J", "Q_0": "G", "q": "A G"},
    ("h", "weights", "biases"),
    forward,
    backward,
    cases,
)
