"""The multilayer perceptron behind every network of the paper, psi_alpha to psi_q.

    y = relu(... relu(x W_0 + b_0) ...) W_n + b_n

P-4DGS, appendix (hyperparameters). Rows are samples, and a layer is x W + b (Q3): W is the
transpose of the weight that PyTorch stores.
"""

import numpy as np


def forward(
    x,  # [N, I]  one sample per row
    weights,  # psi, I -> O
    biases,
):
    """Return y [N, O] and what `backward` needs: the input of every layer, and the weights."""
    inputs = [x]
    for W, b in zip(weights[:-1], biases[:-1]):
        hidden = inputs[-1] @ W
        hidden += b
        inputs.append(np.maximum(hidden, 0, out=hidden))
    y = inputs[-1] @ weights[-1] + biases[-1]
    return y, (inputs, weights)


def backward(saved, y_bar, needs_x=True) -> dict:
    """Return the gradients of x, unless `needs_x` is False, of weights and of biases.

    A ReLU passes the gradient if its input was positive, so at 0 the gradient is 0.
    """
    inputs, weights = saved
    weights_bar, biases_bar = [None] * len(weights), [None] * len(weights)
    for i in reversed(range(len(weights))):
        weights_bar[i] = inputs[i].T @ y_bar
        biases_bar[i] = np.einsum("no->o", y_bar)  # faster than .sum(axis=0)
        if i > 0 or needs_x:
            y_bar = y_bar @ weights[i].T
        if i > 0:
            y_bar *= (inputs[i] > 0).astype(y_bar.dtype)  # faster than times bool
    gradients = {"weights": weights_bar, "biases": biases_bar}
    return {"x": y_bar, **gradients} if needs_x else gradients
