"""D3DGS (Yang et al. 2024): explicit Gaussians and a network that moves each of them.

    (s, r, alpha) = D1(log_s, raw_r, logit_alpha)               `activations`
    (delta_x, delta_s, delta_r) = psi_d(E(x), psi_t(E(t)))      D3, `deformation_d3dgs`
    x_t = x + delta_x, s_t = s + delta_s, r_t = r + delta_r     Eq. (6)
    color = D2(x_t - x_c, sh)                                   `sh_color`

No gradient flows from E(x) back into x. The authors leave r_t at the length that the sum has, and
their renderer takes it for a unit quaternion, so that a turn also shears the Gaussian. That is a
mistake; Eq. (6) normalises.
"""

from dataclasses import dataclass

import numpy as np

from p4dgs_ref.equations import deformed
from p4dgs_ref.model import Gaussians, with_backward
from p4dgs_ref.training.parameters import random_layers

from . import activations, deformation_d3dgs, explicit
from .deformation_d3dgs import deformation_layers

HEADS = (3, 3, 4)  # of psi_d: delta_x, delta_s, delta_r


@dataclass(frozen=True)
class Preset(explicit.Preset):
    """The authors' network, which has eight layers of 256 and one for the time."""

    warm_up: int = 200
    deformation: tuple = (256,) * 8
    time_net: tuple = (256, 30)
    skip: bool = True
    L_x: int = 4
    L_t: int = 4
    deformation_gain: float = 0.01  # the heads of psi_d start smaller by this factor
    lr_x: tuple = (0.002, 2e-4)
    lr_d: tuple = (6e-4, 3e-5)


# The network of the paper's preset `tiny`: two layers of 64, no time net, no skip.
SMALL = Preset(deformation=(64, 64), time_net=(), skip=False, lr_d=(0.002, 1e-4))


def random_networks(preset, heads, rng):
    """The first arrays of psi_d with heads of these widths and of psi_t, as PyTorch starts them."""
    layers = deformation_layers(
        preset.L_x, preset.L_t, preset.deformation, heads, preset.time_net, preset.skip
    )
    arrays = {}
    for name, shapes in layers.items():
        arrays |= random_layers(rng, name, shapes)
    trunk = len(preset.deformation)
    for i in range(trunk, trunk + len(heads)):
        arrays[f"psi_d.W{i}"] *= preset.deformation_gain
        arrays[f"psi_d.b{i}"] *= preset.deformation_gain
    return arrays


class D3DGS(explicit.Explicit):
    """A model of D3DGS, ready to render or to be saved."""

    METHOD = "d3dgs"

    @staticmethod
    def initial(preset, rng, points=None):
        """The first arrays: the Gaussians of 3DGS, and networks as PyTorch starts them."""
        gaussians = explicit.start(preset, rng, points)
        return {**gaussians, **random_networks(preset, HEADS, rng)}

    def predict(self, t, x_c, iteration=explicit.AFTER_TRAINING):
        """See `Explicit`; before `warm_up` nothing moves."""
        p, preset = self.parameters, self.preset
        moves = iteration >= preset.warm_up
        (s, r, alpha), back_stored = with_backward(
            activations, p["log_s"], p["raw_r"], p["logit_alpha"]
        )
        x = p["x"]
        if moves:
            layers = *p.network("psi_d"), *p.network("psi_t")
            deltas, back_psi = with_backward(
                deformation_d3dgs, x, t, *layers, preset.L_x, preset.L_t
            )
            (x, s, r), back_deformed = with_backward(deformed, x, s, r, *deltas)
        color, back_color = explicit.colors(preset, p, x, x_c, iteration)

        def back(x_bar, s_bar, r_bar, alpha_bar, color_bar):
            colors, networks = back_color(color_bar), {}
            x_bar = x_bar + colors.pop("x")
            if moves:
                at_t = back_deformed(x_bar, s_bar, r_bar)
                s_bar, r_bar = at_t["s"], at_t["r"]
                deltas_bar = [at_t[f"delta_{name}"] for name in "xsr"]
                psi = back_psi(*deltas_bar)
                networks = {
                    **explicit.of_network("psi_d", psi["weights"], psi["biases"]),
                    **explicit.of_network("psi_t", psi["time_weights"], psi["time_biases"]),
                }
            return {"x": x_bar, **back_stored(s_bar, r_bar, alpha_bar), **colors, **networks}

        return Gaussians(x, s, r, alpha, color, np.arange(len(x))), back


class Trainer(explicit.Trainer):
    """Fits one scene by D3DGS."""

    kind = D3DGS
    RATES = {**explicit.Trainer.RATES, "psi_d": "lr_d", "psi_t": "lr_d"}
