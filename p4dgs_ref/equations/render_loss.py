"""Eq. (16): how far the rendered image is from the true one.

    L_render = (1 - lambda_ssim) * L1 + lambda_ssim * D_SSIM
    L1       = mean |image - truth|
    D_SSIM   = 1 - SSIM(image, truth)

P-4DGS, section 3.3 (training objective). D_SSIM is not halved (Q13).
"""

import numpy as np

from . import ssim


def forward(
    image,  # [H, W, C]  rendered image, intensities of range 1
    truth,  # [H, W, C]  true image
    lambda_ssim,  # []  weight of D_SSIM
):
    """Return L_render, L1 and D_SSIM [] and what `backward` needs."""
    difference = image - truth
    precision = image.dtype.type
    L1 = precision(np.abs(difference).mean(dtype=np.float64))
    D_SSIM, saved_ssim = ssim.dissimilarity(image, truth)
    D_SSIM = precision(D_SSIM)
    L_render = precision(1 - lambda_ssim) * L1 + precision(lambda_ssim) * D_SSIM
    return (L_render, L1, D_SSIM), (np.sign(difference), lambda_ssim, saved_ssim)


def backward(saved, L_render_bar, L1_bar=0.0, D_SSIM_bar=0.0):
    """Return the gradient of the image; that of L1 is 0 where image and truth are equal."""
    slope, lambda_ssim, saved_ssim = saved
    L1_bar = float(L1_bar + (1 - lambda_ssim) * L_render_bar)
    D_SSIM_bar = float(D_SSIM_bar + lambda_ssim * L_render_bar)
    from_ssim = ssim.backward(saved_ssim, -D_SSIM_bar)["image"]
    return {"image": L1_bar / slope.size * slope + from_ssim}
