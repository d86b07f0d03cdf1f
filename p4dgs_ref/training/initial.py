"""The first parameters: random anchors on a lattice, networks at their default, a hash grid without opinion."""

import numpy as np
from scipy.spatial import cKDTree

from .. import effects as fx
from ..model import Design
from .parameters import Parameters, random_layers


def design_of(preset, effects):
    """The Design that a preset and a scene's effects ask for."""
    grid = [("xyz", res) for res in preset.grid_3d]
    grid += [(plane, res) for plane in ("xy", "xz", "yz") for res in preset.grid_2d]
    return Design(
        preset.d,
        preset.k,
        preset.hidden,
        preset.deformation,
        preset.L_x,
        preset.L_t,
        preset.context,
        tuple(grid),
        (preset.table_3d, preset.table_2d),
        preset.F,
        (preset.Q_f, preset.Q_s, preset.Q_l, preset.Q_O),
        preset.tau_alpha,
        tuple(effects),
    )


def neighbour_distance(points):
    """Root mean square distance to the three nearest neighbours (A, 3) -> (A,), as 3DGS starts its scales."""
    if len(points) < 2:
        return np.full(len(points), 0.1)
    count = min(4, len(points))
    distance, _ = cKDTree(points).query(points, k=count)
    return np.sqrt(np.maximum((distance[:, 1:] ** 2).mean(axis=1), 1e-7))


def initial_parameters(preset, design, rng, points=None):
    """Parameters of a model before training; `points` (A, 3) replaces the random cloud.

    Names: x_a, f_a, log_s, log_l, O_a, the networks' "psi_*.W0" ..., and "grid.0" ...
    """
    if points is None:
        points = rng.uniform(-preset.extent, preset.extent, (preset.anchors, 3))
    x_a = (
        np.unique(np.round(points / preset.voxel), axis=0) * preset.voxel
    )  # anchors sit on the lattice's nodes
    A = len(x_a)
    log_reach = np.repeat(np.log(neighbour_distance(x_a))[:, None], 3, axis=1)
    arrays = {
        "x_a": x_a,
        "f_a": rng.normal(size=(A, design.d)) * preset.feature_std,
        "log_s": log_reach,
        "log_l": log_reach,
        "O_a": np.zeros((A, design.k, 3)),
    }
    for name, shapes in design.layers().items():
        arrays.update(random_layers(rng, name, shapes))
    arrays[f"psi_alpha.b{len(design.hidden)}"] += preset.opacity_bias
    if preset.upright:
        arrays[f"psi_r.b{len(design.hidden)}"] += np.tile([1.0, 0, 0, 0], design.k)
    if fx.moves(design.effects):
        trunk = len(design.deformation)
        for i in range(trunk, trunk + 3):
            arrays[f"psi_d.W{i}"] *= preset.deformation_gain
            arrays[f"psi_d.b{i}"] *= preset.deformation_gain
    for i, shape in enumerate(design.levels()):
        arrays[f"grid.{i}"] = rng.uniform(
            -1e-4, 1e-4, shape
        )  # HAC's start: signs at random, gradients alive
    return Parameters(arrays)
