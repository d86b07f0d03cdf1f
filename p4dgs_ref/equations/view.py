"""Eq. (2): how far every anchor is from the camera, and in which direction the camera sees it.

    delta_vc = |x_a - x_c|        d_vc = (x_a - x_c) / delta_vc

P-4DGS, section 3.2 (spatial prediction). The anchor position is the canonical one, not that of a
deformed Gaussian (Q22). An anchor exactly at the camera has distance, direction and gradient 0.
"""

import numpy as np

from .numerics import length, perpendicular


def forward(
    x_a,  # [A, 3]  anchor positions (scene units)
    x_c,  # [3]  camera position (scene units), converted to the precision of x_a
):
    """Return delta_vc [A, 1], the unit vectors d_vc [A, 3] and what `backward` needs."""
    v = x_a - np.asarray(x_c, dtype=x_a.dtype)
    delta_vc = length(v)
    d_vc = v / nonzero(delta_vc)
    return (delta_vc, d_vc), (delta_vc, d_vc)


def backward(saved, delta_vc_bar, d_vc_bar):
    """Return the gradient of x_a; the camera is data."""
    delta_vc, d_vc = saved
    # The direction changes only where the anchor moves perpendicular to it, and less from far away.
    turning = perpendicular(d_vc, d_vc_bar) / nonzero(delta_vc)
    return {"x_a": d_vc * delta_vc_bar + turning}


def nonzero(delta_vc):
    """Return the distances, with 1 in place of 0, so that 0 / distance is 0."""
    return np.where(delta_vc > 0, delta_vc, 1)
