"""Where a scene spends its bits: every Gaussian in the colour of what its anchor costs in the file."""

import numpy as np

from ..splatting import render
from ..splatting.settings import FAST


def heat_colors(bits, limits, name):
    """Colours (A, 3) of matplotlib's map `name`; values outside the limits take the colours of its ends."""
    from matplotlib import colormaps

    low, high = limits
    return colormaps[name]((bits - low) / max(high - low, 1e-9))[:, :3]


def heat_image(model, bits, camera, t, limits, name):
    """The model at time t with colour replaced by cost: bits (A,) -> image (H, W, 3) over white."""
    g = model.gaussians(t, camera)
    color = heat_colors(bits, limits, name)[g.index // model.design.k]
    return render.forward(
        g.x, g.s, g.r, g.alpha, color, camera, np.ones(3), FAST, "occlusion" in model.design.effects
    )[0].image
