"""Density control of 3DGS: cloning, splitting, pruning, and resets of the opacity.

Kerbl et al. 2023, section 5.2, with the constants of the authors' code in the presets. Statistics
are those of `training.density`, with one child per Gaussian.
"""

import numpy as np

from ...equations.numerics import normalise, sigmoid
from ...splatting.covariance import rotation_matrix

SHRINK = 1.6  # children of a split are smaller by this factor
LARGEST = 0.1  # of the extent: larger Gaussians are pruned once opacities have been reset
RESET_ALPHA = 0.01


def densify(p, rows, gradient, extent, preset, scatter, prune_large):
    """The Gaussians [N] to keep, and new ones as {array name: rows}.

    Where the mean gradient [N] of the projected centre is large, a small Gaussian is cloned in
    place, and a large one is replaced by two, which `scatter` places and shrinks. Of old and new
    ones those are left out that are nearly transparent or, with `prune_large`, very large. No more
    are added than `most` leaves room for, those with the largest gradients.
    """
    room = max(preset.most - len(gradient), 0)
    wanted = np.zeros(len(gradient), bool)
    wanted[np.argsort(-gradient, kind="stable")[:room]] = True
    wanted &= gradient >= preset.gradient_threshold
    large = np.exp(p["log_s"]).max(axis=1) > preset.percent_dense * extent
    clones, parents = np.flatnonzero(wanted & ~large), np.flatnonzero(wanted & large)
    children = {name: np.repeat(p[name][parents], 2, axis=0) for name in rows}
    scatter(children)
    added = {name: np.concatenate([p[name][clones], children[name]]) for name in rows}
    limit = LARGEST * extent if prune_large else np.inf
    keep, lasting = lasts(p, preset, limit), lasts(added, preset, limit)
    keep[parents] = False
    return keep, {name: a[lasting] for name, a in added.items()}


def scatter(children, rng):
    """Move copies of a Gaussian, in place, to points drawn from it, and shrink them."""
    r, _ = normalise(children["raw_r"])
    drawn = rng.normal(size=children["x"].shape) * np.exp(children["log_s"])
    children["x"] += np.einsum("nij,nj->ni", rotation_matrix(r), drawn)
    children["log_s"] -= np.log(SHRINK)


def lasts(p, preset, limit):
    """Which Gaussians are neither nearly transparent nor larger than the limit."""
    visible = sigmoid(p["logit_alpha"]) >= preset.min_opacity
    return visible & (np.exp(p["log_s"]).max(axis=1) <= limit)


def reset_opacity(p, first, second):
    """Lower all opacities, in place, to RESET_ALPHA at most, with zero Adam moments.

    What the pictures need becomes opaque again; the rest is pruned.
    """
    most = np.log(RESET_ALPHA / (1 - RESET_ALPHA))
    p["logit_alpha"][...] = np.minimum(p["logit_alpha"], most)
    first["logit_alpha"][...] = 0
    second["logit_alpha"][...] = 0
