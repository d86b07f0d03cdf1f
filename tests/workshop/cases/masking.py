"""Cases of the masking after Eq. (4)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(5)
    A, k = 6, 5
    alpha = rng.uniform(0.1, 0.9, size=(A, k)) * rng.choice([-1, 1], size=(A, k))
    inputs = dict(
        alpha=alpha,
        mask=rng.random((A, k)) < 0.8,
        tau_alpha=0.0,
        x=rng.normal(size=(A, k, 3)),
        color=rng.random((A, k, 3)),
        s=rng.random((A, k, 3)),
        r=rng.normal(size=(A, k, 4)),
    )
    # Computed by hand: child 1 is exactly on the threshold, child 2 below it, child 3 is masked.
    child = np.arange(4.0).reshape(1, 4, 1)
    return [
        Case("ordinary", inputs),
        Case("all_masked", {**inputs, "mask": np.zeros((A, k), bool)}, ("masked", "empty")),
        Case(
            "all_kept",
            {**inputs, "mask": np.ones((A, k), bool), "tau_alpha": -1.0},
            ("negative",),
            expected={
                "index": np.arange(A * k),
                "alpha": alpha.ravel(),
                "r": inputs["r"].reshape(-1, 4),
            },
        ),
        Case(
            "no_anchor",
            {n: a if n == "tau_alpha" else a[:0] for n, a in inputs.items()},
            ("empty",),
        ),
        Case(
            "at_the_threshold",
            dict(
                alpha=np.array([[0.5, 0.25, 0.125, 0.75]]),
                mask=np.array([[True, True, True, False]]),
                tau_alpha=0.25,
                x=child + np.zeros(3),
                color=child + np.ones(3),
                s=child + np.ones(3),
                r=child + np.ones(4),
            ),
            ("kink", "masked"),
            smooth=False,
            cotangents={
                "alpha_bar": np.array([2.0, -3.0]),
                "x_bar": np.array([[1.0, 2, 3], [-4, 5, 6]]),
            },
            expected={
                "alpha": np.array([0.5, 0.25]),
                "x": np.array([[0.0, 0, 0], [1, 1, 1]]),
                "index": np.array([0, 1]),
                "alpha_bar": np.array([[2.0, -3, 0, 0]]),
                "x_bar": np.array([[[1.0, 2, 3], [-4, 5, 6], [0, 0, 0], [0, 0, 0]]]),
                "color_bar": np.zeros((1, 4, 3)),
                "s_bar": np.zeros((1, 4, 3)),
                "r_bar": np.zeros((1, 4, 4)),
            },
        ),
    ]
