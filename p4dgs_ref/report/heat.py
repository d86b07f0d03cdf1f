"""Where a scene spends its bits: every Gaussian in a colour for the cost of its anchor."""

import numpy as np

from ..splatting import render
from ..splatting.settings import FAST


def heat_image(model, bits, camera, t, limits, name):
    """The model at time t over white, (H, W, 3), coloured by the bits (A,) of the anchors.

    The colours are those of matplotlib's map `name`; bits outside the limits take its end colours.
    """
    from matplotlib import colormaps

    low, high = limits
    colors = colormaps[name]((bits - low) / max(high - low, 1e-9))[:, :3]
    g = model.gaussians(t, camera)
    color = colors[g.index // model.design.k]
    occlusion = "occlusion" in model.design.effects
    (image, *_), _ = render.forward(
        g.x, g.s, g.r, g.alpha, color, camera, np.ones(3), FAST, occlusion
    )
    return image
