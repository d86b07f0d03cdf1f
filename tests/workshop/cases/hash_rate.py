"""Cases of Eq. (14)."""

import numpy as np

from p4dgs_ref.equations.hash_rate import entropy

from . import Case


def surrogate(grids):
    """The smooth function whose gradient `hash_rate.backward` returns at these grids.

    Its signs are those of `grids`, and they move by the change of the clipped parameters.
    """
    base = [np.where(grid >= 0, 1, -1) - np.clip(grid, -1, 1) for grid in grids]

    def smooth(grids):
        signs = [start + np.clip(grid, -1, 1) for start, grid in zip(base, grids)]
        n = sum(level.size for level in signs)
        n_pos = sum((1 + level).sum() / 2 for level in signs)
        return np.asarray(entropy(n_pos, n - n_pos)), np.asarray(0), np.asarray(0)

    return smooth


def cases():
    rng = np.random.default_rng(19)
    grids = [rng.uniform(-0.9, 0.9, size=(7, 2)), rng.uniform(-0.3, 0.9, size=(5, 2))]
    yield Case("ordinary", dict(grids=grids))
    for name, sign in (("all_positive", 1), ("all_negative", -1)):
        yield Case(
            name,
            dict(grids=[sign * np.abs(g) for g in grids]),
            ("zero",),
            smooth=False,
            cotangents={"R_hash_bar": np.float64(3.0)},
            expected={"R_hash": np.float64(0), "grids_bar": [np.zeros((7, 2)), np.zeros((5, 2))]},
        )
    yield Case(
        "one_positive", dict(grids=[np.array([[0.5, -0.25, -0.5, -0.75]])]), ("single", "negative")
    )
    yield Case(
        "no_entries", dict(grids=[np.zeros((0, 2))]), ("empty",), expected={"R_hash": np.float64(0)}
    )
    # by hand: 0, -0, 1, 1.5 and one of -2 ... : six of eight positive; beyond +-1 nothing comes
    # back
    row = np.array([[0.0, -0.0, 1.0, 1.5, 0.3, 0.7, -1.0, -2.0]])
    bits = 8 * (2 - 0.75 * np.log2(3))
    yield Case(
        "by_hand",
        dict(grids=[row]),
        ("kink", "single"),
        smooth=False,
        cotangents={"R_hash_bar": np.float64(2.0)},
        expected={
            "R_hash": np.float64(bits),
            "n_pos": np.int64(6),
            "n_neg": np.int64(2),
            "grids_bar": [-np.log2(3) * np.array([[1, 1, 1, 0, 1, 1, 1, 0.0]])],
        },
    )
