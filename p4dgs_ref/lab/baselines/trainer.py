"""The training of a baseline in the loop of ours: its loss, learning rates and density control."""

import numpy as np

from ...equations import render_loss
from ...splatting.settings import FAST
from ...training.adam import exponential
from ...training.density import Statistics
from ...training.loop import Loop
from ...training.objective import Losses, Seen
from ...training.parameters import Parameters
from ...training.watch import NotFinite, first_bad
from . import density


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
        g, saved_model = model.predict(self.time_of(view), x_c, self.iteration)
        (image, _, visible), saved_render = model.draw(g, view.camera, self.settings)
        truth = view.image.astype(image.dtype)
        losses, saved_loss = render_loss.forward(
            image, truth, preset.lambda_ssim, self.moments_of(view)
        )
        image_bar = render_loss.backward(saved_loss, 1.0)["image"]
        bars = model.draw_backward(saved_render, image_bar)
        gaussians_bar = [bars[name].astype(p.vector.dtype) for name in g._fields[:-1]]
        arrays, networks = model.predict_backward(saved_model, *gaussians_bar)
        for name, gradient in arrays.items():
            gradients[name][...] = gradient
        for name, network_gradients in networks.items():
            gradients.fill(name, network_gradients)
        L_render, L1, D_SSIM = (float(loss) for loss in losses)
        L_total = L_render + model.regularise(gradients, self.iteration)
        if not np.isfinite(L_total) or not np.isfinite(gradients.vector).all():
            bad = first_bad({"L_total": L_total, **gradients.arrays})
            raise NotFinite(self.iteration, f"loss or gradient of {bad}")
        alpha = np.zeros((self.primitives, 1))
        alpha[g.index, 0] = g.alpha
        losses = Losses(L_total, L_render, L1, D_SSIM, 0.0, 0.0)
        return losses, Seen(alpha, g.index, visible, image), gradients, bars["mean2d"]

    def scatter(self, children):
        """Place and shrink the children {array name: rows} of Gaussians that are split."""
        density.scatter(children, self.rng)

    def adjust(self):
        """Clone, split and prune; reset the opacities every `reset_every` iterations."""
        preset, now, p = self.preset, self.iteration, self.parameters
        if not preset.grow_from < now < preset.grow_until:
            return
        gradient = (self.statistics.gradient / np.maximum(self.statistics.seen, 1))[:, 0]
        rows, late = self.around(p).rows, now > preset.reset_every
        keep, added = density.densify(p, rows, gradient, self.extent, preset, self.scatter, late)
        if keep.any() or len(added["x"]):
            self.change_rows(rows, keep, added)
        if now % preset.reset_every == 0:
            density.reset_opacity(self.parameters, self.adam.first, self.adam.second)
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
