"""Cases of Eq. (6)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(11)
    x, s, r = rng.normal(size=(5, 3)), rng.lognormal(size=(5, 3)), rng.normal(size=(5, 4))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    deltas = dict(
        delta_x=rng.normal(size=(5, 3)),
        delta_s=rng.normal(size=(5, 3)),
        delta_r=rng.normal(size=(5, 4)),
    )
    yield Case("ordinary", dict(x=x, s=s, r=r, **deltas))
    yield Case("no_rows", {n: a[:0] for n, a in dict(x=x, s=s, r=r, **deltas).items()}, ("empty",))
    for name in deltas:
        yield Case(
            "no_" + name, {**dict(x=x, s=s, r=r, **deltas), name: deltas[name][:, :0]}, ("off",)
        )
    yield Case(
        "static",
        dict(x=x, s=s, r=r, **{n: a[:, :0] for n, a in deltas.items()}),
        ("off",),
        expected={"x_t": x, "s_t": s, "r_t": r},
    )
    yield Case(
        "inside_out",
        dict(x=x, s=s, r=r, **{**deltas, "delta_s": -2 * s}),
        ("negative",),
        expected={"s_t": -s},
    )
    # r + delta_r is (1, 2, 2, 4), of length 5, in the first case below and zero in the second,
    # where the slope is 1 / EPSILON.
    one = dict(
        x=np.zeros((1, 3)),
        s=np.ones((1, 3)),
        r=np.array([[1.0, 0, 0, 0]]),
        delta_x=np.ones((1, 3)),
        delta_s=-np.ones((1, 3)),
    )
    moved = {"x_t": np.ones((1, 3)), "s_t": np.zeros((1, 3))}
    yield Case(
        "by_hand",
        {**one, "delta_r": np.array([[0.0, 2, 2, 4]])},
        ("normalise", "single"),
        cotangents={"r_t_bar": np.array([[50.0, 0, 0, 0]]), "s_t_bar": np.array([[2.0, -3, 5]])},
        expected={
            **moved,
            "r_t": np.array([[0.2, 0.4, 0.4, 0.8]]),
            "s_bar": np.array([[2.0, -3, 5]]),
            "delta_r_bar": np.array([[9.6, -0.8, -0.8, -1.6]]),
            "x_bar": np.zeros((1, 3)),
        },
    )
    yield Case(
        "unmade_rotation",
        {**one, "delta_r": np.array([[-1.0, 0, 0, 0]])},
        ("normalise", "zero"),
        smooth=False,
        cotangents={"r_t_bar": np.array([[3.0, -5, 7, 11]])},
        expected={
            **moved,
            "r_t": np.zeros((1, 4)),
            "delta_r_bar": np.array([[3e12, -5e12, 7e12, 11e12]]),
        },
    )
