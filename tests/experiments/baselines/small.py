"""The three methods, small enough for tests: presets, random parameters, models."""

from dataclasses import replace

import numpy as np

from p4dgs_ref.training.parameters import Parameters
from tutorials.experiments.baselines import d3dgs, gaussian4d, hexplane

MODULES = {"d3dgs": d3dgs, "hexplane": hexplane, "gaussian4d": gaussian4d}
SHARED = dict(gaussians=40, iterations=30, sh_every=10, grow_from=5, grow_every=10, grow_until=25)
SMALL = {
    "d3dgs": replace(
        d3dgs.SMALL,
        **SHARED,
        deformation=(9, 8, 7),
        skip=True,
        time_net=(6, 5),
        deformation_gain=1.0,
        L_x=1,
        L_t=2,
        warm_up=10,
    ),
    "hexplane": replace(
        hexplane.Preset(),
        **SHARED,
        warm_up=10,
        nodes=3,
        time_nodes=4,
        features=2,
        hidden=(5, 6),
        deformation_gain=1.0,
    ),
    "gaussian4d": replace(
        gaussian4d.Preset(),
        **{**SHARED, "iterations": 60, "grow_until": 45},
        most=50,
    ),
}
# Arrays that are drawn anew as mean + size * normal numbers, so that every array matters.
EVERY = {"sh_dc": (0, 1), "sh_rest": (0, 0.3), "logit_alpha": (0, 1), "raw_r": (0, 1)}
DRAWN = {
    "d3dgs": EVERY,
    "hexplane": EVERY,
    "gaussian4d": {
        **EVERY,
        **dict.fromkeys(("raw_l", "raw_r"), ([1, 0, 0, 0], 0.4)),
        "log_s": (-1.5, 0.3),
        "log_s_t": (-1, 0.3),
    },
}


def random_parameters(method, seed=0, N=9, dtype=np.float64):
    """Parameters in which every array matters.

    D3DGS: psi_d does not read E(x), because no gradient flows from there into x. 4DHexPlane: the
    box leaves some Gaussians outside. 4DGS: the last Gaussian is long gone.
    """
    rng = np.random.default_rng(seed)
    p = Parameters(
        MODULES[method].Trainer.kind.initial(replace(SMALL[method], gaussians=N), rng), dtype
    )
    for name, (mean, size) in DRAWN[method].items():
        p[name][...] = mean + size * rng.normal(size=p[name].shape)
    if method == "d3dgs":
        width = 3 * (1 + 2 * SMALL[method].L_x)
        p["psi_d.W0"][:width] = p["psi_d.W2"][:width] = 0
    elif method == "hexplane":
        p["box"][...] *= 0.9  # no point is exactly on a face, where the slope jumps
        for plane in p.arrays_of("planes"):
            plane[...] = rng.normal(size=plane.shape) + 1
    else:
        p["mu_t"][-1] = 9
    return p
