r"""Eq. (5): how far every canonical Gaussian has moved, stretched and turned at time t.

.. math:: (\Delta x, \Delta s, \Delta r) = \psi_d(\mathrm{concat}(\mathcal{E}(x), \mathcal{E}(t)))
"""

from typing import NamedTuple

import numpy as np

from . import mlp, positional_encoding
from .equation import Case, declare


class Out(NamedTuple):
    delta_x: (
        np.ndarray
    )  # (N, 3), or (N, 0) where the scene does not list the effect; so too the others
    delta_s: np.ndarray  # (N, 3)
    delta_r: np.ndarray  # (N, 4)


class Res(NamedTuple):
    E_x: positional_encoding.Res
    E_t: np.ndarray  # (1, 1 + 2 L_t)
    mlp: mlp.Res
    widths: list  # of the three heads


def forward(x, t, weights, biases, L_x, L_t):
    """Query the deformation field.

    Shapes     x (N, 3), t, L_x, L_t scalars, weights [trunk ..., (h, 3), (h, 3), (h, 4)], biases alike
               -> delta_x (N, 3), delta_s (N, 3), delta_r (N, 4)
    Units      x, delta_x, delta_s: scene units; t: normalised time, taken in the precision of x; delta_r: quaternion
    Domain     all reals; a head of zero width (h, 0) for an effect the scene does not list
    Raises     ValueError from NumPy where widths do not chain
    Gradient   x, weights, biases; t is data; at a ReLU's kink the gradient is 0
    Choice     Q1: two hidden layers and linear heads; Q2: L_x, L_t; Q10: the pipeline asks for no gradient of x
    Reference  P-4DGS Eq. (5), appendix, hyperparameters
    """
    E_x, res_x = positional_encoding.forward(x, L_x)
    E_t = positional_encoding.forward(np.full((1, 1), t, dtype=x.dtype), L_t)[0].E
    # The heads side by side are one last layer.  All rows share t, so what the first layer makes of E(t) is a bias.
    first, *rest = *weights[:-3], np.concatenate(weights[-3:], axis=1)
    bias, *biases_rest = *biases[:-3], np.concatenate(biases[-3:])
    columns = E_x.E.shape[1]
    y, res = mlp.forward(
        E_x.E, [first[:columns], *rest], [bias + (E_t @ first[columns:])[0], *biases_rest]
    )
    widths = [W.shape[1] for W in weights[-3:]]
    return Out(*np.split(y.y, np.cumsum(widths[:2]), axis=1)), Res(res_x, E_t, res, widths)


def backward(res, delta_x_bar=None, delta_s_bar=None, delta_r_bar=None, needs_x=True):
    """Gradients of x, weights and biases; `needs_x=False` neither computes nor returns that of x."""
    N, dtype = len(res.E_x.E), res.E_x.E.dtype
    bars = [
        np.zeros((N, width), dtype) if bar is None else bar
        for bar, width in zip((delta_x_bar, delta_s_bar, delta_r_bar), res.widths)
    ]
    gradients = mlp.backward(res.mlp, np.concatenate(bars, axis=1), needs_x)
    weights_bar, biases_bar, cuts = (
        gradients["weights"],
        gradients["biases"],
        np.cumsum(res.widths[:2]),
    )
    weights_bar[0] = np.concatenate(
        [weights_bar[0], np.outer(res.E_t, biases_bar[0])]
    )  # every row saw the same E(t)
    x = positional_encoding.backward(res.E_x, gradients["x"])["p"] if needs_x else None
    split = {
        "weights": [*weights_bar[:-1], *np.split(weights_bar[-1], cuts, axis=1)],
        "biases": [*biases_bar[:-1], *np.split(biases_bar[-1], cuts)],
    }
    return {"x": x, **split} if needs_x else split


def random_field(rng, L_x, L_t, *hidden, heads=(3, 3, 4)):
    """Weights and biases of a deformation network for test cases: hidden layers, then the three heads."""
    weights, biases = mlp.random_network(rng, 3 * (1 + 2 * L_x) + 1 + 2 * L_t, *hidden, sum(heads))
    cuts = np.cumsum(heads[:2])
    return dict(
        weights=[*weights[:-1], *np.split(weights[-1], cuts, axis=1)],
        biases=[*biases[:-1], *np.split(biases[-1], cuts)],
        L_x=L_x,
        L_t=L_t,
    )


def cases():
    rng = np.random.default_rng(10)
    x, t = rng.uniform(-1.3, 1.3, size=(7, 3)), 0.3
    field = random_field(rng, 2, 1, 6, 5)
    yield Case("ordinary", dict(x=x, t=t, **field))
    yield Case("start", dict(x=x, t=0.0, **field), ("zero",))
    yield Case("no_rows", dict(x=x[:0], t=t, **field), ("empty",))
    for name, heads in (("moves_only", (3, 0, 0)), ("turns_only", (0, 0, 4)), ("rests", (0, 0, 0))):
        yield Case(name, dict(x=x, t=t, **random_field(rng, 2, 1, 6, 5, heads=heads)), ("off",))
    yield Case("paper_frequencies", dict(x=x, t=t, **random_field(rng, 10, 6, 8, 6)), ("extreme",))
    yield Case("no_trunk", dict(x=x, t=t, **random_field(rng, 1, 2)), ("single",))


deformation = declare(
    "deformation",
    "5",
    "(delta_x, delta_s, delta_r) = psi_d(concat(E(x), E(t)))",
    {
        "x": "N 3",
        "t": "",
        "weights": "*I J",
        "biases": "*J",
        "L_x": "",
        "L_t": "",
        "delta_x": "N 3",
        "delta_s": "N 3",
        "delta_r": "N 4",
    },
    ("x", "weights", "biases"),
    forward,
    backward,
    cases,
)
