"""Where a scene spends its bits: every Gaussian in a colour for the cost of its anchor."""

import numpy as np

from ..splatting import render
from ..splatting.settings import FAST


def heat_colors(bits, limits, name):
    """Colours (A, 3) of matplotlib's map `name`; values outside the limits take the end colours."""
    from matplotlib import colormaps

    low, high = limits
    return colormaps[name]((bits - low) / max(high - low, 1e-9))[:, :3]


def heat_image(model, bits, camera, t, limits, name):
    """The model at time t over white, (H, W, 3), coloured by the bits (A,) of the anchors."""
    g = model.gaussians(t, camera)
    color = heat_colors(bits, limits, name)[g.index // model.design.k]
    occlusion = "occlusion" in model.design.effects
    (image, *_), _ = render.forward(
        g.x, g.s, g.r, g.alpha, color, camera, np.ones(3), FAST, occlusion
    )
    return image
