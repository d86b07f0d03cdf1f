"""4DHexPlane (4DGaussians, Wu et al. 2024): explicit Gaussians, moved by features from six planes.

    features = H1(x, t)                                         `plane_features`
    (delta_x, delta_log_s, delta_raw_r) = H2(features)          `plane_decoder`
    (s_t, r_t, alpha) = D1(log_s + delta_log_s, raw_r + delta_raw_r, logit_alpha)
    x_t = x + delta_x, color = D2(x_t - x_c, sh)
    L_total = L_render + lambda_planes (L_space, L_time, L_one)   H3, `plane_losses`

Training begins with a coarse stage in which nothing moves. The fine stage then starts again with
Adam and its learning rates. Positions receive a gradient through the planes, too.

The authors prune only models of more than 200,000 Gaussians; here Gaussians are pruned as in 3DGS.
Their file also holds heads and a network for the time that nothing uses; ours does not.
"""

from dataclasses import dataclass

import numpy as np

from p4dgs_ref.model import Gaussians, with_backward
from p4dgs_ref.training.parameters import Adam, random_layers

from . import activations, explicit, plane_decoder, plane_features, plane_losses


@dataclass(frozen=True)
class Preset(explicit.Preset):
    """The rates of x, planes and psi are multiples of the extent of the cameras."""

    warm_up: int = 400  # the iterations of the coarse stage; the others are the fine stage
    nodes: int = 8  # of the first level along x, y and z
    levels: tuple = (1, 2)  # multiples of `nodes`
    time_nodes: int = 8  # along t, at every level
    features: int = 8  # at each node
    hidden: tuple = (64,)  # widths of phi, of which the last is that of the heads
    deformation_gain: float = 0.01  # the last layers of the heads start smaller by this factor
    lambda_planes: tuple = (1e-4, 0.01, 1e-4)  # of L_space, L_time and L_one
    lr_planes: tuple = (0.01, 1e-4)
    lr_psi: tuple = (1.6e-4, 1.6e-6)


class HexPlane(explicit.Explicit):
    """A model of 4DHexPlane, ready to render or to be saved."""

    METHOD = "hexplane"

    @staticmethod
    def initial(preset, rng, points=None):
        """The first arrays: the Gaussians of 3DGS, their box, planes and networks.

        Planes in space are uniform in [0.1, 0.5], those in time 1, so that nothing depends on time.
        """
        arrays = explicit.start(preset, rng, points)
        x = arrays["x"]
        arrays["box"] = np.stack([x.min(axis=0), x.max(axis=0)])
        F, T = preset.features, preset.time_nodes
        for level, multiple in enumerate(preset.levels):
            n = preset.nodes * multiple
            for i in range(6):
                plane = rng.uniform(0.1, 0.5, (n, n, F)) if i < 3 else np.ones((n, T, F))
                arrays[f"planes.{6 * level + i}"] = plane
        inputs = F * len(preset.levels)
        return {**arrays, **first_network(rng, inputs, preset.hidden, preset.deformation_gain)}

    def predict(self, t, x_c, iteration=explicit.AFTER_TRAINING):
        """See `Explicit`; in the coarse stage nothing moves."""
        p, preset = self.parameters, self.preset
        x, log_s, raw_r = p["x"], p["log_s"], p["raw_r"]
        moves = iteration >= preset.warm_up
        if moves:
            lo, hi = p["box"]
            features, back_features = with_backward(
                plane_features, x, t, lo, hi, p.arrays_of("planes")
            )
            deltas, back_decoder = with_backward(plane_decoder, features, *p.network("psi"))
            x, log_s, raw_r = x + deltas[0], log_s + deltas[1], raw_r + deltas[2]
        (s, r, alpha), back_stored = with_backward(activations, log_s, raw_r, p["logit_alpha"])
        color, back_color = explicit.colors(preset, p, x, x_c, iteration)

        def back(x_bar, s_bar, r_bar, alpha_bar, color_bar):
            gradients = {**back_color(color_bar), **back_stored(s_bar, r_bar, alpha_bar)}
            gradients["x"] += x_bar
            if moves:
                psi = back_decoder(gradients["x"], gradients["log_s"], gradients["raw_r"])
                gradients |= explicit.of_network("psi", psi["weights"], psi["biases"])
                at = back_features(psi["features"])
                gradients["x"] = gradients["x"] + at["x"]
                gradients |= {f"planes.{i}": bar for i, bar in enumerate(at["planes"])}
            return gradients

        return Gaussians(x, s, r, alpha, color, np.arange(len(x))), back

    def regularise(self, gradients, iteration):
        """The terms of H3, of the fine stage."""
        factors = self.preset.lambda_planes
        if iteration < self.preset.warm_up:
            return 0.0
        losses, back = with_backward(plane_losses, self.parameters.arrays_of("planes"))
        for i, bar in enumerate(back(*factors)["planes"]):
            gradients[f"planes.{i}"][...] += bar
        return float(np.dot(factors, losses))


def first_network(rng, inputs, hidden, gain):
    """The first arrays of psi: weights as Glorot and Bengio draw them, biases as PyTorch does."""
    W, layers = hidden[-1], [*zip((inputs, *hidden), hidden)]
    for head in plane_decoder.HEADS:
        layers += [(W, W), (W, head)]
    arrays = random_layers(rng, "psi", layers)
    for i, (rows, columns) in enumerate(layers):
        arrays[f"psi.W{i}"] *= np.sqrt(6 * rows / (rows + columns))
    for i in range(len(hidden) + 1, len(layers), 2):
        arrays[f"psi.W{i}"] *= gain
        arrays[f"psi.b{i}"] *= gain
    return arrays


class Trainer(explicit.Trainer):
    """Fits one scene by 4DHexPlane."""

    kind = HexPlane
    RATES = {**explicit.Trainer.RATES, "planes": "lr_planes", "psi": "lr_psi"}
    PER_EXTENT = ("x", "planes", "psi")

    def step(self):
        """One iteration; the first of the fine stage forgets Adam's moments."""
        if self.iteration == self.preset.warm_up:
            self.adam = Adam(self.parameters)
        return super().step()

    def schedule(self):
        """Return the rates; all start again with the fine stage and decay over its length."""
        coarse = self.preset.warm_up
        began = coarse if self.iteration >= coarse else 0
        return self.iteration - began, self.preset.iterations - coarse
