"""Cases of H2."""

import numpy as np

from tests.golden.cases import Case


def inputs(hidden, seed=24, N=5):
    """Random features and layers; `hidden` are the widths of phi."""
    rng = np.random.default_rng(seed)
    W = hidden[-1]
    layers = [*zip((6, *hidden), hidden), (W, W), (W, 3), (W, W), (W, 3), (W, W), (W, 4)]
    return dict(
        features=rng.normal(size=(N, 6)),
        weights=[rng.normal(size=shape) / np.sqrt(shape[0]) for shape in layers],
        biases=[rng.normal(size=columns) for _, columns in layers],
    )


def cases():
    yield Case("ordinary", inputs((5,)))
    yield Case("deeper", inputs((3, 4, 2)))
    yield Case("no_gaussians", inputs((2,), N=0), ("empty",))
    hands = [np.array([[1.0, -1]]), *(np.eye(2), np.array([[1.0, 2, 3], [4, 5, 6]])) * 2]
    hands += [np.eye(2), np.array([[1.0, 2, 3, 4], [5, 6, 7, 8]])]
    zeros = [np.zeros(W.shape[1]) for W in hands]
    yield Case(
        "by_hand",  # h is (2, 0), (0, 1) and (0, 0), where phi is at its kink
        dict(
            features=np.array([[2.0], [-1], [0]]),
            weights=hands,
            biases=[*zeros[:5], np.array([1.0, 0]), zeros[6]],
        ),
        ("kink", "single"),  # the other hidden unit of every head is at the kink of its ReLU
        smooth=False,
        cotangents={"delta_raw_r_bar": np.ones((3, 1)) * [1, -1, 1, -1]},
        expected={
            "delta_x": np.array([[2.0, 4, 6], [4, 5, 6], [0, 0, 0]]),
            "delta_log_s": np.array([[2.0, 4, 6], [4, 5, 6], [0, 0, 0]]),
            "delta_raw_r": np.array([[3.0, 6, 9, 12], [6, 8, 10, 12], [1, 2, 3, 4]]),
            "features_bar": np.array([[-2.0], [2], [0]]),
        },
    )
