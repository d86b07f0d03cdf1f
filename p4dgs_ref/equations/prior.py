r"""Eq. (12): mean and deviation of every coded attribute, predicted from the hash feature.

.. math:: (\mu, \sigma) = \psi_p(h)
"""

from typing import NamedTuple

import numpy as np

from . import mlp
from .equation import Case, declare

RAW_MIN, RAW_MAX = -14.0, 6.0  # of log sigma: 8e-7 to 403 attribute units


class Out(NamedTuple):
    mu: np.ndarray  # (A, n)  group by group f, s, l, O
    sigma: np.ndarray  # (A, n)


class Res(NamedTuple):
    sigma: np.ndarray  # (A, n)
    free: np.ndarray  # (A, n)  bool, raw within its clamp
    columns: tuple  # where mu and raw sigma stand in the network's output, two index arrays (n,)
    mlp: tuple


def layout(widths):
    """Columns of mu and of raw sigma in the output of psi_p: per group, all mu, then all raw sigma."""
    starts = np.cumsum((0, *widths[:-1]))
    mu = np.concatenate([2 * start + np.arange(width) for start, width in zip(starts, widths)])
    return mu, mu + np.repeat(widths, widths)


def forward(h, weights, biases, widths):
    """Predict the prior.

    Shapes     h (A, I), weights and biases of psi_p (I -> 2n), widths: numbers per group, sum n -> mu, sigma (A, n)
    Units      mu, sigma: of the attribute
    Domain     all reals; sigma from exp(-14) to exp(6)
    Raises     IndexError from NumPy where psi_p has fewer than 2n outputs
    Gradient   h, weights, biases; raw sigma: 1 inside its clamp and on the ends, 0 outside
    Choice     Q8: sigma = exp(clip(raw)); Scaffold's children clamp a raw sigma at 1e-9, where gradients die
    Reference  P-4DGS Eq. (12)
    """
    y, res = mlp.forward(h, weights, biases)
    columns = layout(widths)
    raw = y[:, columns[1]]
    sigma = np.exp(np.clip(raw, RAW_MIN, RAW_MAX))
    return Out(y[:, columns[0]], sigma), Res(
        sigma, (raw >= RAW_MIN) & (raw <= RAW_MAX), columns, res
    )


def backward(res, mu_bar=None, sigma_bar=None):
    y_bar = np.zeros((len(res.sigma), 2 * res.sigma.shape[1]), res.sigma.dtype)
    if mu_bar is not None:
        y_bar[:, res.columns[0]] = mu_bar
    if sigma_bar is not None:
        y_bar[:, res.columns[1]] = sigma_bar * res.sigma * res.free
    gradients = mlp.backward(res.mlp, y_bar)
    return {"h": gradients["x"], "weights": gradients["weights"], "biases": gradients["biases"]}


def cases():
    from ..studies.random_inputs import random_network

    rng = np.random.default_rng(17)
    weights, biases = random_network(rng, 5, 7, 22)
    inputs = dict(h=rng.normal(size=(6, 5)), weights=weights, biases=biases, widths=(2, 3, 3, 3))
    yield Case("ordinary", inputs)
    yield Case("no_anchor", {**inputs, "h": inputs["h"][:0]}, ("empty",))
    # by hand: groups of 1 and 2, output (mu_0, raw_0, mu_1, mu_2, raw_1, raw_2); raw on, beyond and inside its clamp
    yield Case(
        "clamped",
        dict(
            h=np.zeros((1, 1)),
            weights=[np.zeros((1, 6))],
            widths=(1, 2),
            biases=[np.array([1.0, -14.0, 2.0, 3.0, 7.0, 0.0])],
        ),
        ("clamped", "single"),
        smooth=False,
        cotangents={
            "mu_bar": np.array([[2.0, 3.0, 5.0]]),
            "sigma_bar": np.array([[7.0, 11.0, 13.0]]),
        },
        expected={
            "mu": np.array([[1.0, 2.0, 3.0]]),
            "sigma": np.array([[np.exp(-14), np.exp(6), 1.0]]),
            "biases_bar": [np.array([2.0, 7 * np.exp(-14), 3.0, 5.0, 0.0, 13.0])],
        },
    )


prior = declare(
    "prior",
    "12",
    "(mu, sigma) = psi_p(h)",
    {"h": "A I", "weights": "*I J", "biases": "*J", "widths": "G", "mu": "A n", "sigma": "A n"},
    ("h", "weights", "biases"),
    forward,
    backward,
    cases,
)
