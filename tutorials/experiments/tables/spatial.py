"""Anchors that D3DGS's network moves: the row "+ spatial prediction" of the paper's Table 3.

    canonical Gaussians                    of anchors, as in the paper: `predict` without a time
    (delta_x, delta_s, delta_r) =          psi_d of eight layers with a skip, and psi_t for the time
        psi_d(E(x), psi_t(E(t)))           (`deformation_d3dgs`); heads as the scene's effects say
    x_t, s_t, r_t                          Eq. (6)

There is no noise and no rate. Without the skip, psi_d of eight layers hardly trains.
"""

from dataclasses import dataclass

from p4dgs_ref import effects as fx
from p4dgs_ref.equations import deformed, render_loss
from p4dgs_ref.model import Anchors, Gaussians, Model, predict, split, with_backward
from p4dgs_ref.splatting import render
from p4dgs_ref.training import objective, trainer
from p4dgs_ref.training.parameters import Adam, Parameters

from ..baselines import d3dgs, deformation_d3dgs


def move(design, networks, g, t):
    """Gaussians at time t, and back(x_bar, s_bar, r_bar), as `model.move` has it."""
    layers = *networks["psi_d"], *networks["psi_t"]
    deltas, back_psi = with_backward(deformation_d3dgs, g.x, t, *layers, design.L_x, design.L_t)
    (x, s, r), back_deformed = with_backward(deformed, g.x, g.s, g.r, *deltas)

    def back(x_bar, s_bar, r_bar):
        bars = back_deformed(x_bar, s_bar, r_bar)
        psi = back_psi(*(bars[f"delta_{name}"] for name in "xsr"))
        psi_t = {"weights": psi["time_weights"], "biases": psi["time_biases"]}
        return bars["x"], bars["s"], bars["r"], {"psi_d": psi, "psi_t": psi_t}

    return g._replace(x=x, s=s, r=r), back


@dataclass(frozen=True, eq=False)
class MovedAnchors(Model):
    """A Model whose psi_d has a skip, with psi_t among its networks."""

    def gaussians(self, t, camera) -> Gaussians:
        """The Gaussians at time t in [0, 1] for this camera."""
        return move(self.design, self.networks, super().gaussians(None, camera), t)[0]


class Trainer(trainer.Trainer):
    """Fits one scene; the presets' learning rate of psi_d is also that of psi_t."""

    def __init__(self, scene, preset, seed=0):
        super().__init__(scene, preset, seed)
        networks = d3dgs.random_networks(d3dgs.Preset(), fx.heads(scene.effects), self.rng)
        self.adopt(Parameters({**self.parameters.arrays, **networks}))
        self.adam = Adam(self.parameters)

    def adopt(self, parameters):
        """Take over parameters, and find psi_t in them once it is there."""
        super().adopt(parameters)
        if "psi_t.W0" in parameters.arrays:
            self.networks["psi_t"] = parameters.network("psi_t")

    def learning_rate(self, name):
        """The current learning rate of a name."""
        return super().learning_rate("psi_d" if name == "psi_t" else name)

    def gradients_of(self, view):
        """The Losses and the Rendered of a view, and the gradients of parameters and of mean2d."""
        p, design, scene = self.parameters, self.design, self.scene
        values = objective.linear_values(p)
        anchors = Anchors(p["x_a"], *split(values, design), self.mask)
        x_c = view.camera.center.astype(values.dtype)
        g, alpha, back_predict = predict(design, self.networks, anchors, x_c)
        back_move = None
        if self.stage > 2:
            g, back_move = move(design, self.networks, g, view.time)
        looks = view.camera, scene.background, self.settings, "occlusion" in design.effects
        (image, _, visible), back_render = with_backward(render, *g[:5], *looks)
        truth = view.image.astype(image.dtype)
        losses, back_loss = with_backward(render_loss, image, truth, self.preset.lambda_ssim)

        gradients, splats = p.zeros(), back_render(back_loss(1.0)["image"])
        x_bar, s_bar, r_bar, *others = (splats[name].astype(values.dtype) for name in g._fields[:5])
        moving = {}
        if back_move:
            x_bar, s_bar, r_bar, moving = back_move(x_bar, s_bar, r_bar)
        attributes, predicting = back_predict(x_bar, s_bar, r_bar, *others)
        gradients["x_a"][...] = attributes["x_a"]
        gradients["f_a"][...] = attributes["f_a"]
        gradients["log_s"][...] = attributes["s_a"] * anchors.s_a  # the slope of exp
        gradients["log_l"][...] = attributes["l_a"] * anchors.l_a
        gradients["O_a"][...] = attributes["O_a"]
        for name, network_bar in {**moving, **predicting}.items():
            gradients.fill(name, network_bar)
        L_render, L1, D_SSIM = map(float, losses)
        return (
            objective.Losses(L_render, L_render, L1, D_SSIM, 0.0, 0.0),
            objective.Rendered(alpha, g.index, visible, image),
            gradients,
            splats["mean2d"],
        )

    def model(self):
        """The model as it is now."""
        p = Parameters(self.parameters.arrays, float)
        psi = {name: p.network(name) for name in ("psi_d", "psi_t")}
        model = vars(super().model())
        return MovedAnchors(**{**model, "networks": {**model["networks"], **psi}})
