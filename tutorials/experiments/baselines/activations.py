"""D1: from the stored numbers of an explicit Gaussian to its scale, rotation and opacity.

    s = exp(log_s)        r = raw_r / |raw_r|        alpha = sigmoid(logit_alpha)

Kerbl et al. 2023 (3DGS), whose Gaussians D3DGS and 4DHexPlane deform. The quaternion is normalised
as in Eq. (3), so that a zero one has a finite slope.
"""

import numpy as np

from p4dgs_ref.equations.numerics import normalise, normalise_backward, sigmoid, sigmoid_slope


def forward(
    log_s,  # [N, 3]  logarithms of the standard deviations (scene units)
    raw_r,  # [N, 4]  quaternions (w, x, y, z) of any length
    logit_alpha,  # [N]  logits of the opacities
):
    """Return s [N, 3], unit quaternions r [N, 4], alpha [N] and what `backward` needs."""
    s = np.exp(log_s)
    r, norm = normalise(raw_r)
    return (s, r, sigmoid(logit_alpha)), (s, r, norm, logit_alpha)


def backward(saved, s_bar, r_bar, alpha_bar):
    """Gradients of log_s, raw_r and logit_alpha."""
    s, r, norm, logit_alpha = saved
    return {
        "log_s": s_bar * s,
        "raw_r": normalise_backward(r, norm, r_bar),
        "logit_alpha": alpha_bar * sigmoid_slope(logit_alpha),
    }
