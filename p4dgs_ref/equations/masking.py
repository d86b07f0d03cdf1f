"""Which Gaussians are rendered: those that are opaque enough.

    keep child i of anchor a if mask and alpha_ai >= tau_alpha

P-4DGS, section 3.2, after Eq. (4). The paper excludes alpha < tau_alpha, so a Gaussian exactly on
the threshold is kept (Scaffold-GS drops it).
"""

import numpy as np


def forward(
    x,  # [A, k, 3]  centres
    s,  # [A, k, 3]  standard deviations
    r,  # [A, k, 4]  quaternions
    alpha,  # [A, k]  opacities
    color,  # [A, k, 3]  colours
    mask,  # [A, k]  bool, False for a child that is masked for good (Q15)
    tau_alpha,  # []  threshold
):
    """Gather the N children that are kept into one flat list of Gaussians.

    Return alpha [N], x [N, 3], color [N, 3], s [N, 3], r [N, 4], index [N], in the order of the
    published vectors, and what `backward` needs. index is a k + j for child j of anchor a, in
    ascending order.
    """
    index = np.flatnonzero(mask & (alpha >= tau_alpha))
    kept = [a.reshape(alpha.size, a.shape[2]).take(index, axis=0) for a in (x, color, s, r)]
    return (alpha.reshape(-1)[index], *kept, index), (index, alpha.shape)


def backward(saved, alpha_bar, x_bar, color_bar, s_bar, r_bar):
    """Return the gradients of x, s, r, alpha and color: zero for the Gaussians that were dropped.

    Whether a Gaussian is kept is a step function of alpha and passes no gradient. The cotangents
    come in the order of the outputs, as in every equation.
    """
    return {
        "x": scatter(saved, x_bar),
        "s": scatter(saved, s_bar),
        "r": scatter(saved, r_bar),
        "alpha": scatter(saved, alpha_bar),
        "color": scatter(saved, color_bar),
    }


def scatter(saved, kept_bar):
    """Put the gradients of kept Gaussians [N, ...] back where `forward` found them: [A, k, ...]."""
    index, (A, k) = saved
    width = kept_bar.shape[1:]
    full_bar = np.zeros((A * k, *width), dtype=kept_bar.dtype)
    full_bar[index] = kept_bar  # no index occurs twice
    return full_bar.reshape(A, k, *width)
