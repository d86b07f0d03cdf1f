"""Cases of Eq. (9)."""

import numpy as np

from p4dgs_ref.equations.grid_nodes import locate

from . import Case


def surrogate(x_a, lo, hi, grids, resolutions):
    """The smooth function whose gradient `hash_grid.backward` returns at these grids.

    Its signs are those of `grids`, and they move by the change of the clipped parameters.
    """
    located = locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids])
    base = [np.where(grid >= 0, 1, -1) - np.clip(grid, -1, 1) for grid in grids]

    def smooth(grids, **_):
        signs = [start + np.clip(grid, -1, 1) for start, grid in zip(base, grids)]
        return (located @ np.concatenate(signs)).reshape(len(x_a), len(grids) * grids[0].shape[1])

    return smooth


def cases():
    rng = np.random.default_rng(14)
    box = dict(lo=np.array([-1.0, 0, 2]), hi=np.array([1.0, 3, 2.5]))
    x_a = rng.uniform(box["lo"], box["hi"], size=(7, 3))
    levels = dict(resolutions=(("xyz", 3), ("xy", 5), ("xz", 5), ("yz", 5)))
    dense, hashed = (
        [rng.uniform(-0.9, 0.9, size=(T, 2)) for T in tables]
        for tables in ((27,) + 3 * (25,), (11,) * 4)
    )
    yield Case("ordinary", dict(x_a=x_a, **box, grids=dense, **levels))
    yield Case("hashed", dict(x_a=x_a, **box, grids=hashed, **levels))
    lattice = box["lo"] + (box["hi"] - box["lo"]) * np.array(
        [[0, 0, 0], [0.5, 1, 0.5], [1, 1, 1], [1.5, -2, 0.5]]
    )
    yield Case(
        "nodes_faces_outside",
        dict(x_a=lattice, **box, grids=dense, **levels),
        ("clamped", "outside"),
    )
    yield Case(
        "no_extent",
        dict(x_a=x_a, lo=box["lo"], hi=box["hi"] * [1, 0, 1], grids=dense, **levels),
        ("zero",),
    )
    yield Case("no_anchor", dict(x_a=x_a[:0], **box, grids=dense, **levels), ("empty",))
    spare = np.random.default_rng(15)
    roomy = [spare.uniform(-0.9, 0.9, size=(T, 1)) for T in (11, 13)]
    yield Case(
        "rows_to_spare",
        dict(x_a=x_a[:3], **box, grids=roomy, resolutions=(("xyz", 2), ("xz", 3))),
        ("single",),
    )
    # by hand: weights 3/8 1/8 3/8 1/8; zero of either sign is +1; gradients end beyond +-1, not on
    # it
    yield Case(
        "by_hand",
        dict(
            x_a=np.array([[0.25, 0.5, 9]]),
            lo=np.zeros(3),
            hi=np.array([1.0, 1, 0]),
            resolutions=(("xy", 2),),
            grids=[np.array([[0.0, -0.0], [-1, 1], [2, -2], [-1.5, 0.5]])],
        ),
        ("kink", "zero", "clamped"),
        smooth=False,
        cotangents={"h_bar": np.array([[8.0, -8]])},
        expected={
            "h": np.array([[0.5, 0.25]]),
            "grids_bar": [np.array([[3.0, -3], [1, -1], [0, 0], [0, -1]])],
        },
    )
