r"""Eq. (15): what training minimises.

.. math:: \mathcal{L}_{total} = \lambda_{rate} \mathcal{L}_{rate} + \mathcal{L}_{render}
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    L_total: np.ndarray  # ()


class Res(NamedTuple):
    lambda_rate: float  # the untouched input


def forward(L_render, L_rate, lambda_rate):
    """Weigh rate against distortion.

    Shapes     L_render, L_rate, lambda_rate () -> L_total ()
    Units      L_render: loss; L_rate: bits per parameter (Q12); lambda_rate: loss per that
    Domain     all reals; lambda_rate >= 0
    Raises     nothing
    Gradient   L_render, L_rate; linear; lambda_rate is data
    Choice     Q12: with L_rate per parameter, lambda_rate in 5e-4 ... 4e-3 means the same at every size
    Reference  P-4DGS Eq. (15)
    """
    return Out(np.asarray(lambda_rate * L_rate + L_render)), Res(lambda_rate)


def backward(res, L_total_bar):
    return {
        "L_render": np.asarray(L_total_bar),
        "L_rate": np.asarray(res.lambda_rate * L_total_bar),
    }


def cases():
    one = lambda x: np.asarray(x, float)
    yield Case("ordinary", dict(L_render=one(0.07), L_rate=one(2.4), lambda_rate=1e-3))
    yield Case(
        "no_rate",
        dict(L_render=one(0.07), L_rate=one(2.4), lambda_rate=0.0),
        ("zero",),
        cotangents={"L_total_bar": one(5)},
        expected={"L_total": one(0.07), "L_rate_bar": one(0), "L_render_bar": one(5)},
    )
    yield Case(
        "rate_alone",
        dict(L_render=one(0), L_rate=one(2.0), lambda_rate=1e6),
        ("extreme",),
        expected={"L_total": one(2e6)},
    )


total_loss = declare(
    "total_loss",
    "15",
    "L_total = lambda_rate L_rate + L_render",
    {"L_render": "", "L_rate": "", "lambda_rate": "", "L_total": ""},
    ("L_render", "L_rate"),
    forward,
    backward,
    cases,
)
