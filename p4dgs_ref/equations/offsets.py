r"""Eq. (1): the k Gaussian centres that one anchor proposes.

.. math:: \{x_0,\dots,x_{k-1}\} = x_a + \{O_0,\dots,O_{k-1}\} \cdot l_a
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    x: np.ndarray  # (A, k, 3)


class Res(NamedTuple):
    O_a: np.ndarray  # (A, k, 3)  needed by l_a_bar; the untouched input
    l_a: np.ndarray  # (A, 3)     needed by O_a_bar; the untouched input


def forward(x_a, O_a, l_a):
    """Place the children of every anchor.

    Shapes     x_a (A, 3), O_a (A, k, 3), l_a (A, 3) -> x (A, k, 3)
    Units      x_a, l_a, x: scene units; O_a: multiples of l_a
    Domain     all reals; l_a may be zero (all children on the anchor) or negative (after noise)
    Raises     nothing
    Gradient   x_a, O_a, l_a; smooth everywhere
    Choice     Q5: l_a is the linear value, not its logarithm
    Reference  P-4DGS Eq. (1), section 3.2, spatial prediction
    """
    return Out(x_a[:, None, :] + O_a * l_a[:, None, :]), Res(O_a, l_a)


def backward(res, x_bar):
    return {
        "x_a": x_bar.sum(axis=1),  # one anchor moves all its children: sum over k
        "O_a": x_bar * res.l_a[:, None, :],
        "l_a": (x_bar * res.O_a).sum(axis=1),
    }


def cases():
    rng = np.random.default_rng(1)
    x_a, O_a, l_a = rng.normal(size=(5, 3)), rng.normal(size=(5, 4, 3)), rng.lognormal(size=(5, 3))
    yield Case("ordinary", dict(x_a=x_a, O_a=O_a, l_a=l_a))
    yield Case(
        "zero_reach",
        dict(x_a=x_a, O_a=O_a, l_a=0 * l_a),
        ("zero",),
        expected={"x": np.repeat(x_a[:, None], 4, axis=1)},
    )
    yield Case("one_child", dict(x_a=x_a, O_a=O_a[:, :1], l_a=-l_a), ("single", "negative"))
    yield Case(
        "by_hand",
        dict(
            x_a=np.array([[1.0, 0, 0]]),
            O_a=np.array([[[1.0, 0, 0], [0, 0, -1.0]]]),
            l_a=np.array([[0.5, 0.5, 2.0]]),
        ),
        ("single",),
        cotangents={"x_bar": np.array([[[0, 0, 0], [0, 0, 3.0]]])},
        expected={
            "x": np.array([[[1.5, 0, 0], [1, 0, -2.0]]]),
            "l_a_bar": np.array([[0, 0, -3.0]]),
        },
    )


offsets = declare(
    "offsets",
    "1",
    "x = x_a + O_a * l_a",
    {"x_a": "A 3", "O_a": "A k 3", "l_a": "A 3", "x": "A k 3"},
    ("x_a", "O_a", "l_a"),
    forward,
    backward,
    cases,
)
