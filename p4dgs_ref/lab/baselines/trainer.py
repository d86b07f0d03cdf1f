"""The training of a baseline in the loop of ours: its loss, learning rates and density control.

Density control is that of 3DGS (Kerbl et al. 2023, section 5.2): cloning, splitting, pruning, and
resets of the opacity, with the constants of the authors' code in the presets. Statistics are those
of `training.density`, with one child per Gaussian.
"""

import numpy as np

from ...equations import render_loss
from ...equations.numerics import normalise, sigmoid
from ...model import pull
from ...splatting.covariance import rotation_matrix
from ...splatting.settings import FAST
from ...training.density import Statistics
from ...training.loop import Loop
from ...training.objective import Losses, Seen
from ...training.parameters import Parameters, exponential
from ...training.watch import NotFinite, first_bad

SHRINK = 1.6  # children of a split are smaller by this factor
LARGEST = 0.1  # of the extent: larger Gaussians are pruned once opacities have been reset
RESET_ALPHA = 0.01


class Trainer(Loop):
    """Fits one scene by the method `kind`, a subclass of Explicit."""

    UNIT = "stored"
    kind: type
    # The field of the preset with the rate of an array, or of all arrays of a network.
    RATES = {
        "x": "lr_x",
        "sh_dc": "lr_sh_dc",
        "sh_rest": "lr_sh_rest",
        "logit_alpha": "lr_alpha",
        "log_s": "lr_s",
        "raw_r": "lr_r",
    }

    def __init__(self, scene, preset, seed=0, settings=FAST, points=None):
        super().__init__(scene, preset, seed, settings)
        points = scene.points if points is None else points
        self.start(Parameters(self.kind.initial(preset, self.rng, points)))
        self.extent = extent_of(scene.train, self.parameters["x"])
        self.statistics = Statistics.empty(self.primitives, 1)

    @property
    def primitives(self):
        """The number of Gaussians."""
        return len(self.parameters["x"])

    def around(self, parameters):
        """The model of some parameters, which it does not copy."""
        occlusion = "occlusion" in self.scene.effects
        return self.kind(parameters, self.preset, self.scene.background, occlusion)

    def model(self):
        """The model as it is now."""
        return self.around(Parameters(self.parameters.arrays))

    def time_of(self, view):
        """The time at which the Gaussians are rendered for a view."""
        return view.time

    def rate_of(self, name):
        """The current learning rate of a name of RATES."""
        first, last = getattr(self.preset, self.RATES[name])
        return exponential(self.iteration, first, last, self.preset.iterations)

    def gradients_of(self, view):
        """The Losses of a view, what was Seen, and the gradients of parameters and of mean2d.

        Raises NotFinite with the first array and index that is NaN or infinite.
        """
        preset, p = self.preset, self.parameters
        model, gradients = self.around(p), p.zeros()
        x_c = view.camera.center.astype(p.vector.dtype)
        g, back_predict = model.predict(self.time_of(view), x_c, self.iteration)
        (image, _, visible), back_draw = model.draw(g, view.camera, self.settings)
        truth = view.image.astype(image.dtype)
        moments = self.moments_of(view)
        losses, back_loss = pull(render_loss, image, truth, preset.lambda_ssim, moments)
        bars = back_draw(back_loss(1.0)["image"])
        gaussians_bar = [bars[name].astype(p.vector.dtype) for name in g._fields[:-1]]
        arrays, networks = back_predict(*gaussians_bar)
        for name, gradient in arrays.items():
            gradients[name][...] = gradient
        for name, network_gradients in networks.items():
            gradients.fill(name, network_gradients)
        L_render, L1, D_SSIM = (float(loss) for loss in losses)
        L_total = L_render + model.regularise(gradients, self.iteration)
        if not np.isfinite(L_total) or not np.isfinite(gradients.vector).all():
            bad = first_bad({"L_total": L_total, **gradients.arrays})
            raise NotFinite(f"iteration {self.iteration}: loss or gradient of {bad}")
        alpha = np.zeros((self.primitives, 1))
        alpha[g.index, 0] = g.alpha
        losses = Losses(L_total, L_render, L1, D_SSIM, 0.0, 0.0)
        return losses, Seen(alpha, g.index, visible, image), gradients, bars["mean2d"]

    def scatter(self, children):
        """Move copies {array name: rows} of a Gaussian to points drawn from it, and shrink them."""
        r, _ = normalise(children["raw_r"])
        drawn = self.rng.normal(size=children["x"].shape) * np.exp(children["log_s"])
        children["x"] += np.einsum("nij,nj->ni", rotation_matrix(r), drawn)
        children["log_s"] -= np.log(SHRINK)

    def adjust(self):
        """Clone, split and prune; reset the opacities every `reset_every` iterations."""
        preset, now, p = self.preset, self.iteration, self.parameters
        if not preset.grow_from < now < preset.grow_until:
            return
        gradient = (self.statistics.gradient / np.maximum(self.statistics.seen, 1))[:, 0]
        rows, late = self.around(p).rows, now > preset.reset_every
        keep, added = densify(p, rows, gradient, self.extent, preset, self.scatter, late)
        if keep.any() or len(added["x"]):
            self.change_rows(rows, keep, added)
        if now % preset.reset_every == 0:
            reset_opacity(self.parameters, self.adam.first, self.adam.second)
        self.statistics = Statistics.empty(self.primitives, 1)


def extent_of(views, x):
    """The size of a scene as 3DGS measures it: how far its cameras are from their mean, and 10 %.

    Cameras that stand still in one place have none; then the first points give it. The authors'
    code would split every Gaussian and prune it as too large.
    """
    centers = np.array([view.camera.center for view in views])
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    if spread < 1e-6:
        spread = np.linalg.norm(x - x.mean(axis=0), axis=1).max()
    return 1.1 * float(spread)


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
