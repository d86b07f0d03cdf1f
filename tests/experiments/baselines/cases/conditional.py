"""Cases of G2."""

import numpy as np

from p4dgs_ref.lab.baselines import rotation_4d
from tests.golden.cases import Case


def cases():
    rng = np.random.default_rng(32)
    R, _ = rotation_4d.forward(rng.normal(size=(5, 4)), rng.normal(size=(5, 4)))
    inputs = dict(
        x=rng.normal(size=(5, 3)),
        mu_t=rng.uniform(size=5),
        s=rng.uniform(0.1, 1, (5, 4)),
        R=R,
        t=0.37,
    )
    yield Case("ordinary", inputs)
    none = {name: a[:0] for name, a in inputs.items() if name != "t"}
    yield Case("no_gaussians", {**none, "t": 0.5}, ("empty",))
    two = {name: a[:2] for name, a in inputs.items() if name != "t"}
    two["t"] = inputs["t"]
    yield Case(
        "at_its_mean",
        {**two, "mu_t": np.full(2, 0.37)},
        ("zero",),
        expected={"x_t": two["x"]},
    )
    # Turned by the angle of the triangle 3, 4, 5 in the plane of x and t.
    turned = np.array([[[0.6, 0, 0, 0.8], [0, 1, 0, 0], [0, 0, 1, 0], [-0.8, 0, 0, 0.6]]])
    by_hand = dict(
        x=np.array([[1.0, 2, 3]]),
        mu_t=np.array([0.5]),
        s=np.array([[1.0, 3, 5, 2]]),
        R=turned,
        t=2.58,
    )
    yield Case(
        "by_hand",  # A_xx = 2.92, b_x = 1.44, var_t = 2.08
        by_hand,
        ("single",),
        cotangents={"x_t_bar": np.array([[1.0, 10, 100]])},
        expected={
            "x_t": np.array([[2.44, 2, 3]]),
            "Sigma_t": np.diag([4 / 2.08, 9, 25])[None],
            "var_t": np.array([2.08]),
            "x_bar": np.array([[1.0, 10, 100]]),
            "mu_t_bar": np.array([-1.44 / 2.08]),
        },
    )
    # 48 = 0.6 * 0.8 * 100: space and time are not coupled where the first and last scales agree.
    yield Case(
        "round_in_the_plane",
        {**by_hand, "s": np.array([[10.0, 3, 5, 10]])},
        ("single", "zero"),
        expected={"x_t": by_hand["x"], "Sigma_t": np.diag([100.0, 9, 25])[None]},
    )
    for name, factors in (
        ("needles", [1e-5, 1e-4, 1, 1]),
        ("flashes", [1, 1, 1, 1e-8]),
        ("lasting", [1, 1, 1, 1e8]),
    ):
        yield Case(name, {**two, "s": two["s"] * factors}, ("extreme",))
    yield Case(
        "nearly_at_rest",  # its axis of time is turned by so little that float32 cannot tell
        {**by_hand, "R": np.eye(4)[None] + 1e-9 * (turned - np.eye(4))},
        ("single", "zero"),
    )
    yield Case(
        "no_extent",  # a point: the variance of time is its floor
        {**by_hand, "s": np.zeros((1, 4))},
        ("zero", "single"),
        smooth=False,
        cotangents={"x_t_bar": np.array([[1.0, 10, 100]])},
        expected={
            "x_t": by_hand["x"],
            "Sigma_t": np.zeros((1, 3, 3)),
            "var_t": np.array([1e-24]),
            "x_bar": np.array([[1.0, 10, 100]]),
            "mu_t_bar": np.zeros(1),
            "R_bar": np.zeros((1, 4, 4)),
        },
    )
    yield Case(
        "no_rotation",
        {**by_hand, "R": np.zeros((1, 4, 4))},
        ("zero", "single"),
        smooth=False,
        cotangents={
            "x_t_bar": np.array([[1.0, 10, 100]]),
            "Sigma_t_bar": np.arange(9.0).reshape(1, 3, 3),
            "var_t_bar": np.ones(1),
        },
        expected={
            "x_t": by_hand["x"],
            "Sigma_t": np.zeros((1, 3, 3)),
            "var_t": np.array([1e-24]),
            "x_bar": np.array([[1.0, 10, 100]]),
            "mu_t_bar": np.zeros(1),
            "R_bar": np.zeros((1, 4, 4)),
        },
    )
