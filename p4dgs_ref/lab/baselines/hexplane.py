"""4DHexPlane (4DGaussians, Wu et al. 2024): explicit Gaussians, moved by features from six planes.

    features = H1(x, t)                                         `plane_features`
    (delta_x, delta_log_s, delta_raw_r) = H2(features)          `plane_decoder`
    (s_t, r_t, alpha) = D1(log_s + delta_log_s, raw_r + delta_raw_r, logit_alpha)
    x_t = x + delta_x, color = D2(x_t - x_c, sh)
    L_total = L_render + lambda_planes (L_space, L_time, L_one)   H3, `plane_losses`

Training begins with a coarse stage in which nothing moves. The fine stage then starts anew with
Adam and its learning rates. Positions receive a gradient through the planes, too.

The authors prune only models of more than 200,000 Gaussians; here Gaussians are pruned as in 3DGS.
Their file also holds heads and a network for the time that nothing uses; ours does not.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...model import Gaussians, pull
from ...training.parameters import Adam, exponential, random_layers
from . import activations, explicit, plane_decoder, plane_features, plane_losses, trainer


@dataclass(frozen=True)
class Preset(explicit.Preset):
    """Further constants; all values are those of the authors' code for D-NeRF's scenes.

    The rates of x, planes and psi are multiples of the extent of the cameras.
    """

    iterations: int = 23_000
    coarse: int = 3000  # of them; the others are the fine stage
    gaussians: int = 2000
    lambda_ssim: float = 0.0
    nodes: int = 64  # of the first level along x, y and z
    levels: tuple[int, ...] = (1, 2)  # multiples of `nodes`
    time_nodes: int = 100  # along t, at every level; the authors have 75 for two of the scenes
    features: int = 32  # at each node
    hidden: tuple[int, ...] = (64,)  # widths of phi, of which the last is that of the heads
    deformation_gain: float = 1.0  # the last layers of the heads start smaller by this factor
    lambda_planes: tuple[float, ...] = (1e-4, 0.01, 1e-4)  # of L_space, L_time and L_one
    lr_planes: tuple[float, ...] = (1.6e-3, 1.6e-5)
    lr_psi: tuple[float, ...] = (1.6e-4, 1.6e-6)
    grow_until: int = 18_000

    def stage(self, iteration):
        """1 in the coarse stage, then 2."""
        return 1 + (iteration >= self.coarse)


PAPER_SYNTHETIC = Preset()
PAPER_REAL = replace(  # of HyperNeRF's scenes, where the authors take two views an iteration
    PAPER_SYNTHETIC,
    name="paper_real",
    iterations=17_000,
    grow_until=13_000,
    reset_every=10**9,
    levels=(1, 2, 4),
    time_nodes=150,
    features=16,
    hidden=(128,),
    lambda_planes=(2e-4, 1e-3, 1e-4),
    lr_planes=(1.6e-3, 1.6e-4),
    lr_psi=(1.6e-4, 1.6e-5),
)
TINY = replace(
    PAPER_SYNTHETIC,
    **explicit.TINY,
    coarse=400,
    lambda_ssim=0.2,
    nodes=8,
    time_nodes=8,
    features=8,
    deformation_gain=0.01,
    lr_x=(5e-4, 5e-5),
    lr_planes=(0.01, 1e-4),
)
PRESETS = {p.name: p for p in (PAPER_SYNTHETIC, PAPER_REAL, TINY)}


class HexPlane(explicit.Explicit):
    """A model of 4DHexPlane, ready to render or to be saved."""

    preset: Preset

    METHOD = "hexplane"
    FORM = ("sh_degree",)

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

    def predict(self, t, x_c, iteration=None):
        """See `Explicit`; in the coarse stage nothing moves."""
        p, preset = self.parameters, self.preset
        x, log_s, raw_r = p["x"], p["log_s"], p["raw_r"]
        moves = iteration is None or iteration >= preset.coarse
        if moves:
            lo, hi = p["box"]
            features, back_features = pull(plane_features, x, t, lo, hi, p.listed("planes"))
            deltas, back_decoder = pull(plane_decoder, features, *p.network("psi"))
            x, log_s, raw_r = x + deltas[0], log_s + deltas[1], raw_r + deltas[2]
        (s, r, alpha), back_stored = pull(activations, log_s, raw_r, p["logit_alpha"])
        color, back_color = explicit.colors(p, x, x_c, explicit.degree_at(preset, iteration))

        def back(x_bar, s_bar, r_bar, alpha_bar, color_bar):
            gradients, networks = back_color(color_bar), {}
            gradients["x"] += x_bar
            gradients.update(back_stored(s_bar, r_bar, alpha_bar))
            if moves:
                psi = back_decoder(gradients["x"], gradients["log_s"], gradients["raw_r"])
                at, networks["psi"] = back_features(psi["features"]), psi
                gradients["x"] = gradients["x"] + at["x"]
                gradients.update({f"planes.{i}": bar for i, bar in enumerate(at["planes"])})
            return gradients, networks

        return Gaussians(x, s, r, alpha, color, np.arange(len(x))), back

    def regularise(self, gradients, iteration):
        """The terms of H3, of the fine stage."""
        factors = self.preset.lambda_planes
        if iteration < self.preset.coarse:
            return 0.0
        losses, back = pull(plane_losses, self.parameters.listed("planes"))
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


class Trainer(trainer.Trainer):
    """Fits one scene by 4DHexPlane."""

    kind = HexPlane
    RATES = {**trainer.Trainer.RATES, "planes": "lr_planes", "psi": "lr_psi"}

    def step(self):
        """One iteration, as in `Loop`; the first of the fine stage forgets Adam's moments."""
        if self.iteration == self.preset.coarse:
            self.adam = Adam(self.parameters)
        return super().step()

    def rate_of(self, name):
        """The current learning rate; in the coarse stage planes and psi have none."""
        preset, moving = self.preset, name in ("planes", "psi")
        fine = self.iteration >= preset.coarse
        if name == "box" or moving and not fine:
            return 0.0
        now = self.iteration - preset.coarse * fine
        first, last = getattr(preset, self.RATES[name])
        rate = exponential(now, first, last, preset.iterations - preset.coarse)
        return rate * self.extent if moving or name == "x" else rate
