"""Cases of D1."""

import numpy as np

from tests.golden.cases import Case


def cases():
    rng = np.random.default_rng(21)
    inputs = dict(
        log_s=rng.normal(size=(5, 3)) - 2,
        raw_r=rng.normal(size=(5, 4)),
        logit_alpha=3 * rng.normal(size=5),
    )
    yield Case("ordinary", inputs)
    yield Case("no_gaussians", {name: a[:0] for name, a in inputs.items()}, ("empty",))
    yield Case(
        "by_hand",
        dict(
            log_s=np.log([[2.0, 4, 8]]),
            raw_r=np.array([[1.0, 2, 2, 4]]),
            logit_alpha=np.log([3.0]),
        ),
        ("normalise", "single"),
        cotangents={
            "s_bar": np.array([[1.0, -1, 0.5]]),
            "r_bar": np.array([[25.0, 0, 0, 0]]),
            "alpha_bar": np.array([16.0]),
        },
        expected={
            "s": np.array([[2.0, 4, 8]]),
            "r": np.array([[0.2, 0.4, 0.4, 0.8]]),
            "alpha": np.array([0.75]),
            "log_s_bar": np.array([[2.0, -4, 4]]),
            "raw_r_bar": np.array([[4.8, -0.4, -0.4, -0.8]]),
            "logit_alpha_bar": np.array([3.0]),
        },
    )
    one = dict(log_s=np.zeros((1, 3)), logit_alpha=np.zeros(1))
    yield Case(
        "no_rotation",
        {**one, "raw_r": np.zeros((1, 4))},
        ("normalise", "zero"),
        smooth=False,
        cotangents={"r_bar": np.array([[3.0, -5, 7, 11]])},
        expected={"r": np.zeros((1, 4)), "raw_r_bar": np.array([[3e12, -5e12, 7e12, 11e12]])},
    )
    yield Case(
        "saturated",
        {**one, "raw_r": np.array([[0.0, 0, 0, 2]]), "logit_alpha": np.array([50.0])},
        ("saturated",),
        cotangents={"alpha_bar": np.ones(1)},
        expected={"alpha": np.ones(1), "logit_alpha_bar": np.exp([-50.0])},
    )
    yield Case(
        "far_logits",
        dict(
            log_s=np.array([[-30.0, 0, 30], [0, 0, 0], [1, 2, 3]]),
            raw_r=np.array([[1e-9, 3e-9, 4e-9, -2e-9], [1e9, -1e9, 1, 2], [1, 2, -3, 0.1]]),
            logit_alpha=np.array([40.0, -40, 0]),
        ),
        ("saturated", "extreme", "normalise"),
    )
