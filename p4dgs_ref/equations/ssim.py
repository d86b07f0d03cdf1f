"""SSIM: the structural similarity of two images, as 3DGS measures it.

    SSIM = mean of  (2 mu_x mu_y + C1) (2 cov_xy + C2)
                    ---------------------------------------------
                    (mu_x**2 + mu_y**2 + C1) (var_x + var_y + C2)

Wang et al. 2004; P-4DGS uses it in Eq. (16). The local means mu, variances var and covariance cov
are averages over an 11 x 11 Gaussian window with zeros around the image (Q13).

Computed as the mean of (1 - luminance) (1 - structure), with e = x - y and

    luminance = mu_e**2 / (mu_x**2 + mu_y**2 + C1)        structure = var_e / (var_x + var_y + C2)

Each numerator of the formula above is its denominator minus mu_e**2 or var_e. In this form equal
images have an SSIM of exactly 1, nearly equal images keep the digits of 1 - SSIM, and the digits
that E[x**2] - mu**2 loses in flat regions affect only the denominators.
"""

import numpy as np

from .window import blur, to_rows

C1, C2 = 0.01**2, 0.03**2


def forward(
    image,  # [H, W, C]  image to judge, intensities of range 1
    truth,  # [H, W, C]  image to compare with
):
    """Return ssim [], which is 1 for identical images, and what `backward` needs."""
    D_SSIM, saved = dissimilarity(image, truth)
    return image.dtype.type(1 - D_SSIM), saved


def backward(saved, ssim_bar):
    """Return the gradient of the image, smooth everywhere; 0 where the images are equal."""
    x, e, mu_x, mu_e, luminance, structure, D1, D2, dtype = saved
    # In the forward SSIM = mean of (1 - luminance) (1 - structure), so the gradient of each of the
    # two is minus the other one's factor.
    share = ssim_bar / x.size
    # In the forward structure = (square_e - mu_e**2) / D2, so square_e gets 1 / D2, and square_x,
    # which is a term of D2 alone, gets -structure / D2.
    square_e_bar = -share * (1 - luminance) / D2
    square_x_bar = -structure * square_e_bar
    # In the forward mu_x = mu_y + mu_e, so both grow alike: luminance by 2 (mu_e - luminance mu_x)
    # / D1 per unit, structure by 2 (structure mu_x - mu_e) / D2.
    luminance_bar = -share * (1 - structure)
    mu_bar = 2 * luminance_bar * (mu_e - luminance * mu_x) / D1
    mu_bar += 2 * square_e_bar * (structure * mu_x - mu_e)
    # In the forward all three are windows of e, e**2 and x**2, and a window is its own adjoint.
    blurred = blur(np.stack([mu_bar, square_e_bar, square_x_bar], axis=1)).swapaxes(0, 1)
    image_bar = blurred[0] + 2 * (e * blurred[1] + x * blurred[2])
    return {"image": image_bar.transpose(0, 2, 1).astype(dtype, order="C")}


def dissimilarity(image, truth):
    """Return 1 - SSIM in float64 and what `backward` needs."""
    y = to_rows(truth)
    mu_y, square_y = blur(np.stack([y, y * y], axis=1)).swapaxes(0, 1)
    x = to_rows(image)
    e = x - y
    mu_e, square_e, square_x = blur(np.stack([e, e * e, x * x], axis=1)).swapaxes(0, 1)
    mu_x = mu_y + mu_e
    D1 = mu_x * mu_x + mu_y * mu_y + C1
    D2 = square_x - mu_x * mu_x + (square_y - mu_y * mu_y) + C2
    luminance = mu_e * mu_e / D1
    structure = (square_e - mu_e * mu_e) / D2
    D_SSIM = np.mean(luminance + structure - luminance * structure)
    return D_SSIM, (x, e, mu_x, mu_e, luminance, structure, D1, D2, image.dtype)
