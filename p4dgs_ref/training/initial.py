"""The first parameters: random anchors, default networks, a hash grid with random signs."""

import numpy as np
from scipy.spatial import KDTree

from .. import effects as fx
from ..model import Design
from .parameters import Parameters, random_layers


def design_of(preset, effects):
    """Return the Design that a preset and the effects of a scene ask for."""
    grid = [("xyz", res) for res in preset.grid_3d]
    grid += [(axes, res) for axes in ("xy", "xz", "yz") for res in preset.grid_2d]
    return Design(  # first the fields that have the same names in both
        **{name: a for name, a in vars(preset).items() if name in Design.__annotations__},
        grid=tuple(grid),
        table=(preset.table_3d, preset.table_2d),
        Q_0=(preset.Q_f, preset.Q_s, preset.Q_l, preset.Q_O),
        effects=tuple(effects),
    )


def neighbour_distance(points):
    """Return the root mean square distance [A] of each point to its three nearest neighbours.

    3DGS starts its scales from this distance.
    """
    if len(points) < 2:
        return np.full(len(points), 0.1)
    distance, _ = KDTree(points).query(points, k=min(4, len(points)))
    return np.sqrt(np.maximum((distance[:, 1:] ** 2).mean(axis=1), 1e-7))


def starting_points(points, count, extent, rng):
    """Return the points [A, 3] to start from, or `count` random ones in [-extent, extent]^3."""
    if points is None:
        points = rng.uniform(-extent, extent, (count, 3))
    points = np.asarray(points, float)
    if points.shape[1:] != (3,) or not len(points) or not np.isfinite(points).all():
        raise ValueError(
            f"points: expected finite numbers of shape [A, 3], A at least 1, got an array of "
            f"shape {list(points.shape)}"
        )
    return points


def lattice_nodes(points, voxel):
    """Return the nodes [A, 3] of the lattice that are nearest to points, each of them once."""
    return np.unique(np.round(points / voxel), axis=0) * voxel


def initial_parameters(preset, design, rng, points=None):
    """Return the Parameters of a model before training; `points` [A, 3] replace the random ones.

    The arrays of a network are "psi_alpha.W0" and so on, those of the hash grid "grid.0" and so on.
    """
    points = starting_points(points, preset.anchors, preset.extent, rng)
    x_a = lattice_nodes(points, preset.voxel)
    A = len(x_a)
    log_spacing = np.repeat(np.log(neighbour_distance(x_a))[:, None], 3, axis=1)
    arrays = {
        "x_a": x_a,
        "f_a": rng.normal(size=(A, design.d)) * preset.feature_std,
        "log_s": log_spacing,
        "log_l": log_spacing,
        "O_a": np.zeros((A, design.k, 3)),
    }
    for name, shapes in design.layers().items():
        arrays |= random_layers(rng, name, shapes)
    arrays[f"psi_alpha.b{len(design.hidden)}"] += preset.opacity_bias
    if preset.upright:
        arrays[f"psi_r.b{len(design.hidden)}"] += np.tile([1.0, 0, 0, 0], design.k)
    if fx.moves(design.effects):
        trunk = len(design.deformation)
        for i in range(trunk, trunk + 3):
            arrays[f"psi_d.W{i}"] *= preset.deformation_gain
            arrays[f"psi_d.b{i}"] *= preset.deformation_gain
    arrays |= {  # HAC: random signs with a gradient
        f"grid.{i}": rng.uniform(-1e-4, 1e-4, shape) for i, shape in enumerate(design.levels())
    }
    return Parameters(arrays)
