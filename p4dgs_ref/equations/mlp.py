r"""Support: the multilayer perceptron behind every network of the paper (psi_alpha ... psi_q).

.. math:: y = W_n\,\mathrm{relu}(\dots \mathrm{relu}(x W_0 + b_0) \dots) + b_n
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    y: np.ndarray  # (N, O)


class Res(NamedTuple):
    inputs: list  # what entered each layer, (N, width): the input, then the hidden activations
    weights: list  # the untouched input


def forward(x, weights, biases):
    """Apply a network: a ReLU after every layer but the last.

    Shapes     x (N, I), weights [(I, J), ..., (K, O)], biases [(J,), ..., (O,)] -> y (N, O)
    Units      whatever the network was trained on
    Domain     all reals; N may be zero
    Raises     ValueError from NumPy where widths do not chain
    Gradient   x, weights, biases; at a ReLU's kink the gradient is 0
    Choice     Q3: rows are samples, a layer is x W + b; this is the transpose of PyTorch's storage
    Reference  P-4DGS appendix, hyperparameters
    """
    inputs = [x]
    for W, b in zip(weights[:-1], biases[:-1]):
        hidden = inputs[-1] @ W
        hidden += b
        inputs.append(np.maximum(hidden, 0, out=hidden))
    return Out(inputs[-1] @ weights[-1] + biases[-1]), Res(inputs, weights)


def backward(res, y_bar, needs_x=True):
    """Gradients of x, weights and biases; `needs_x=False` saves the last product and leaves x out."""
    weights_bar, biases_bar = [None] * len(res.weights), [None] * len(res.weights)
    for i in reversed(range(len(res.weights))):
        weights_bar[i] = res.inputs[i].T @ y_bar
        biases_bar[i] = y_bar.sum(axis=0)
        if i > 0 or needs_x:
            y_bar = y_bar @ res.weights[i].T
        if i > 0:
            y_bar *= res.inputs[i] > 0  # the ReLU lets through what it let through
    gradients = {"weights": weights_bar, "biases": biases_bar}
    return {"x": y_bar, **gradients} if needs_x else gradients


def random_network(rng, *widths):
    """Weights and biases of the given widths for test cases, scaled to keep activations of order one."""
    pairs = list(zip(widths[:-1], widths[1:]))
    return (
        [rng.normal(size=pair) / np.sqrt(max(pair[0], 1)) for pair in pairs],
        [rng.normal(size=n) * 0.3 for _, n in pairs],
    )


def cases():
    rng = np.random.default_rng(2)
    weights, biases = random_network(rng, 4, 6, 5, 2)
    yield Case("ordinary", dict(x=rng.normal(size=(7, 4)), weights=weights, biases=biases))
    yield Case("no_rows", dict(x=np.zeros((0, 4)), weights=weights, biases=biases), ("empty",))
    yield Case(
        "one_layer",
        dict(x=rng.normal(size=(7, 4)), weights=weights[:1], biases=biases[:1]),
        ("single",),
    )
    one = [np.ones((1, 1))] * 2
    yield Case(
        "at_the_kink",
        dict(x=np.array([[-1.0], [0.0], [2.0]]), weights=one, biases=[np.zeros(1)] * 2),
        ("kink",),
        smooth=False,
        cotangents={"y_bar": np.array([[5.0], [7.0], [11.0]])},
        expected={"y": np.array([[0.0], [0.0], [2.0]]), "x_bar": np.array([[0.0], [0.0], [11.0]])},
    )


mlp = declare(
    "mlp",
    "",
    "y = W_n relu(... relu(x W_0 + b_0) ...) + b_n",
    {"x": "N I", "weights": "*I J", "biases": "*J", "y": "N O"},
    ("x", "weights", "biases"),
    forward,
    backward,
    cases,
)
