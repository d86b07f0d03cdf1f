"""Cases of G3."""

import numpy as np

from tests.golden.cases import Case

LOG_2 = np.log(2)


def cases():
    rng = np.random.default_rng(33)
    inputs = dict(
        alpha=rng.uniform(size=5),
        mu_t=rng.uniform(size=5),
        var_t=rng.uniform(0.01, 0.3, 5),
        t=0.37,
    )
    yield Case("ordinary", inputs)
    none = {name: a[:0] for name, a in inputs.items() if name != "t"}
    yield Case("no_gaussians", {**none, "t": 0.5}, ("empty",))
    yield Case(
        "by_hand",
        dict(alpha=np.array([0.8]), mu_t=np.array([-0.5]), var_t=np.array([0.5 / LOG_2]), t=0.5),
        ("single",),
        cotangents={"alpha_t_bar": np.array([1.0]), "weight_bar": np.array([0.2])},
        expected={
            "alpha_t": np.array([0.4]),
            "weight": np.array([0.5]),
            "alpha_bar": np.array([0.5]),
            "mu_t_bar": np.array([LOG_2]),
            "var_t_bar": np.array([LOG_2**2]),
        },
    )
    yield Case(
        "at_its_mean",
        {**inputs, "mu_t": np.full(5, 0.37)},
        ("zero",),
        cotangents={"alpha_t_bar": np.arange(1.0, 6)},
        expected={
            "alpha_t": inputs["alpha"],
            "alpha_bar": np.arange(1.0, 6),
            "mu_t_bar": np.zeros(5),
            "var_t_bar": np.zeros(5),
        },
    )
    faint = np.array([0.04, 0.015, 1e-3, 1e-9])
    yield Case(
        "faint",
        dict(alpha=inputs["alpha"][:4], mu_t=np.zeros(4), var_t=-0.5 / np.log(faint), t=1.0),
        ("tail",),
        cotangents={"alpha_t_bar": np.arange(1.0, 5)},
        expected={"weight": faint, "alpha_bar": np.arange(1.0, 5) * faint},
    )
    yield Case(
        "flashes",
        {**inputs, "var_t": np.full(5, 1e-24)},
        ("extreme", "zero"),
        cotangents={"alpha_t_bar": np.arange(1.0, 6), "weight_bar": np.arange(5.0)},
        expected={name: np.zeros(5) for name in ("alpha_t", "weight", "mu_t_bar", "var_t_bar")},
    )
    yield Case(
        "lasting",
        {**inputs, "var_t": np.full(5, 1e14)},
        ("extreme",),
        expected={"alpha_t": inputs["alpha"], "weight": np.ones(5)},
    )
