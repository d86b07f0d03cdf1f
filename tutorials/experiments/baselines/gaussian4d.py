"""4DGS (Yang et al. 2023): Gaussians in space and time, without a network.

    R = G1(raw_l, raw_r)                                            `rotation_4d`
    (x_t, Sigma_t, var_t) = G2(x, mu_t, exp(log_s), R, t)           `conditional`
    (alpha_t, weight) = G3(sigmoid(logit_alpha), mu_t, var_t, t)    `marginal`
    color = D2(x_t - x_c, G4(sh, mu_t, t))                          `spherindrical`, `sh_color`

A Gaussian moves along a straight line and fades in and out around mu_t. Those whose weight is at
most MIN_WEIGHT at t are not rendered.

The direction of view is that of the moved Gaussian, x_t - x_c. The authors' kernel takes the mean x
in its forward pass and x_t in its backward pass, which is a mistake.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from p4dgs_ref.equations.numerics import sigmoid, sigmoid_slope
from p4dgs_ref.model import with_backward
from p4dgs_ref.splatting import projection, render

from . import conditional, explicit, marginal, rotation_4d, spherindrical

MIN_WEIGHT = 0.05


@dataclass(frozen=True)
class Preset(explicit.Preset):
    """Without a network, motion takes more Gaussians than in the other methods.

    The rates of x and mu_t are multiples of the extent of the cameras. The authors render up to 24
    views in one iteration, here it is one.
    """

    gaussians: int = 2000
    most: int = 2000
    grow_until: int = 2400
    waves: int = 2  # the highest frequency of the colours in time, in periods per scene
    start_s_t: float = 0.2**0.5  # standard deviation in time before training
    lr_t: tuple = (5e-4, 5e-5)  # of mu_t
    lr_s: tuple = (0.015, 0.0015)


class GaussiansAt(NamedTuple):
    """The Gaussians at one time; the fields are those of `model.Gaussians`, with covariances."""

    x: np.ndarray  # [N, 3]
    Sigma: np.ndarray  # [N, 3, 3]
    alpha: np.ndarray  # [N]
    color: np.ndarray  # [N, 3]
    index: np.ndarray  # [N]  the rows of the stored Gaussians


class Gaussian4D(explicit.Explicit):
    """A model of 4DGS, ready to render or to be saved: 161 numbers a Gaussian.

    The authors save a checkpoint with Adam's moments, three times as large; here it is the
    parameters alone.
    """

    METHOD = "gaussian4d"
    PROPERTIES = {
        "x": "x y z",
        "mu_t": "t",
        "sh_dc": "f_dc_*",
        "sh_rest": "f_rest_*",  # with the waves in time after the harmonics of 3DGS
        "logit_alpha": "opacity",
        "log_s": "scale_*",
        "log_s_t": "scale_t",
        "raw_l": "rot_l_*",
        "raw_r": "rot_r_*",
    }

    @staticmethod
    def initial(preset, rng, points=None):
        """The first Gaussians of 3DGS, at random times in and around those of the scene."""
        arrays = explicit.start(preset, rng, points)
        N, K = len(arrays["x"]), (preset.sh_degree + 1) ** 2
        return {
            **arrays,
            "mu_t": rng.uniform(-0.1, 1.1, N),
            "sh_rest": np.zeros((N, 3, (preset.waves + 1) * K - 1)),
            "log_s_t": np.full((N, 1), np.log(preset.start_s_t)),
            "raw_l": arrays["raw_r"],
        }

    def predict(self, t, x_c, iteration=explicit.AFTER_TRAINING):
        """See `Explicit`; only the Gaussians with a weight above MIN_WEIGHT are returned."""
        p = self.parameters
        s = four_scales(p)
        R, back_R = with_backward(rotation_4d, p["raw_l"], p["raw_r"])
        (x, Sigma, var_t), back_conditional = with_backward(conditional, p["x"], p["mu_t"], s, R, t)
        opacity = sigmoid(p["logit_alpha"])
        (alpha, weight), back_marginal = with_backward(marginal, opacity, p["mu_t"], var_t, t)
        color, back_color = self.colors(x, x_c, t, iteration)
        rows = np.flatnonzero(weight > MIN_WEIGHT)

        def of_all(bar):
            """The cotangent of all Gaussians, zero for those that are not rendered."""
            full = np.zeros((len(weight), *bar.shape[1:]), bar.dtype)
            full[rows] = bar
            return full

        def back(x_bar, Sigma_bar, alpha_bar, color_bar):
            alpha_bar, colors = of_all(alpha_bar), back_color(of_all(color_bar))
            fading = back_marginal(alpha_bar, np.zeros_like(alpha_bar))
            x_bar = of_all(x_bar) + colors.pop("x")
            moving = back_conditional(x_bar, of_all(Sigma_bar), fading["var_t"])
            log_s_bar = moving["s"] * s
            return {
                **colors,
                "x": moving["x"],
                "mu_t": moving["mu_t"] + fading["mu_t"] + colors["mu_t"],
                "logit_alpha": fading["alpha"] * sigmoid_slope(p["logit_alpha"]),
                "log_s": log_s_bar[:, :3],
                "log_s_t": log_s_bar[:, 3:],
                **back_R(moving["R"]),
            }

        return GaussiansAt(x[rows], Sigma[rows], alpha[rows], color[rows], rows), back

    def colors(self, x, x_c, t, iteration):
        """D2 of G4, and back(color_bar), the gradients of x_t, mu_t, sh_dc and sh_rest.

        The waves in time become active one by one once all of space is.
        """
        p, preset = self.parameters, self.preset
        in_time = iteration // preset.sh_every - preset.sh_degree
        waves = min(max(in_time, 0), preset.waves)
        stored = np.concatenate([p["sh_dc"], p["sh_rest"]], axis=2)
        sh = stored.reshape(len(x), 3, preset.waves + 1, -1)[:, :, : waves + 1]
        sh_t, back_sh = with_backward(spherindrical, sh, p["mu_t"], t)
        at_t = {"sh_dc": sh_t[:, :, :1], "sh_rest": sh_t[:, :, 1:]}
        color, back_color = explicit.colors(preset, at_t, x, x_c, iteration)

        def back(color_bar):
            bars = back_color(color_bar)
            series = back_sh(np.concatenate([bars["sh_dc"], bars["sh_rest"]], axis=2))
            active = series["sh"].reshape(len(x), 3, -1)
            sh_bar = np.zeros_like(stored)
            sh_bar[:, :, : active.shape[2]] = active
            return {
                "x": bars["x"],
                "mu_t": series["mu_t"],
                "sh_dc": sh_bar[:, :, :1],
                "sh_rest": sh_bar[:, :, 1:],
            }

        return color, back

    def render_gaussians(self, g, camera, settings, keep=True):
        """See `Explicit`."""
        looks = camera, self.background, settings, self.occlusion, keep
        x, Sigma = g.x.astype(float), g.Sigma.astype(float)
        splats, saved_splats = projection.forward(x, Sigma, **render.pinhole(camera, settings))
        output, (compositor, saved) = render.composite(splats, g.alpha, g.color, *looks)

        def back(image_bar):
            bars = compositor.backward(saved, image_bar)
            of_conic = {"mean2d_bar": bars["mean2d"], "conic_bar": bars.pop("conic")}
            return {**projection.backward(saved_splats, **of_conic), **bars}

        return output, back


def four_scales(p):
    """The standard deviations [N, 4] along the axes of space and time."""
    return np.exp(np.concatenate([p["log_s"], p["log_s_t"]], axis=1))


class Trainer(explicit.Trainer):
    """Fits one scene by 4DGS."""

    kind = Gaussian4D
    RATES = {
        **explicit.Trainer.RATES,
        "mu_t": "lr_t",
        "log_s_t": "lr_s",
        "raw_l": "lr_r",
    }
    PER_EXTENT = ("x", "mu_t")

    def scatter(self, children):
        """Move children to points drawn from their parent in space and time, and shrink them."""
        R, _ = rotation_4d.forward(children["raw_l"], children["raw_r"])
        s = four_scales(children)
        drawn = np.einsum("nij,nj->ni", R, s * self.rng.normal(size=s.shape))
        children["x"] += drawn[:, :3]
        children["mu_t"] += drawn[:, 3]
        children["log_s"] -= np.log(explicit.SHRINK)
        children["log_s_t"] -= np.log(explicit.SHRINK)
