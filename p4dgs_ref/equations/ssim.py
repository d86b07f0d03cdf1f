r"""Support: structural similarity of two images, as 3DGS measures it.

.. math:: \mathrm{SSIM} = \operatorname{mean}\frac{(2\mu_x\mu_y + C_1)(2\sigma_{xy} + C_2)}
                                               {(\mu_x^2 + \mu_y^2 + C_1)(\sigma_x^2 + \sigma_y^2 + C_2)}
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare
from .window import blur, moments, to_rows

C1, C2 = 0.01**2, 0.03**2


class Out(NamedTuple):
    ssim: np.ndarray  # scalar


class Res(NamedTuple):
    x: np.ndarray  # (H, C, W) float64, and so the others
    e: np.ndarray  # x - y
    mu_x: np.ndarray
    mu_e: np.ndarray
    luminance: np.ndarray  # mu_e^2 / D1, what differing means take away
    structure: np.ndarray  # var_e / D2, what differing structure takes away
    D1: np.ndarray  # the two denominators
    D2: np.ndarray
    dtype: np.dtype


def forward(image, truth, truth_moments=None):
    """Compare two images.

    Shapes     image, truth (H, W, C) -> ssim scalar; truth_moments: `moments(truth)`, if at hand
    Units      intensities of range 1; ssim: 1 for identical images, below elsewhere
    Domain     all reals, meant for [0, 1]; one pixel or more
    Raises     nothing
    Gradient   image; truth is data; smooth everywhere, exactly 0 where the images are equal
    Choice     Q13: 11 x 11 Gaussian of sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2
    Reference  Wang et al. 2004; P-4DGS Eq. (16)
    """
    D_SSIM, res = dissimilarity(image, truth, truth_moments)
    return Out(image.dtype.type(1 - D_SSIM)), res


def dissimilarity(image, truth, truth_moments=None):
    """1 - SSIM in float64 and `forward`'s residual: of images that are nearly equal, 1 - ssim would lose all digits."""
    y, mu_y, var_y = moments(truth) if truth_moments is None else truth_moments
    x = to_rows(image)
    e = x - y
    # With e = x - y each numerator is its denominator less a moment of e: mu_e^2 and the variance of e.  The
    # digits that E[x^2] - mu^2 loses where an image is flat are thus lost only from what divides.
    mu_e, square_e, square_x = blur(np.stack([e, e * e, x * x], axis=1)).swapaxes(0, 1)
    mu_x = mu_y + mu_e
    D1, D2 = mu_x * mu_x + mu_y * mu_y + C1, square_x - mu_x * mu_x + var_y + C2
    luminance, structure = mu_e * mu_e / D1, (square_e - mu_e * mu_e) / D2
    D_SSIM = np.mean(luminance + structure - luminance * structure)
    return D_SSIM, Res(x, e, mu_x, mu_e, luminance, structure, D1, D2, image.dtype)


def backward(res, ssim_bar):
    x, e, mu_x, mu_e, luminance, structure, D1, D2, dtype = res
    share = ssim_bar / x.size
    square_e_bar = -share * (1 - luminance) / D2
    square_x_bar = -structure * square_e_bar  # x^2 occurs in the denominator alone
    # Through mu_e and mu_x, which move together: d luminance = 2 (mu_e - luminance mu_x) / D1 per unit, and of the
    # variances' -mu^2 in the other factor, d structure = 2 (structure mu_x - mu_e) / D2.
    mu_bar = -2 * share * (1 - structure) * (mu_e - luminance * mu_x) / D1 + 2 * square_e_bar * (
        structure * mu_x - mu_e
    )
    blurred = blur(np.stack([mu_bar, square_e_bar, square_x_bar], axis=1)).swapaxes(0, 1)
    image_bar = blurred[0] + 2 * (e * blurred[1] + x * blurred[2])
    return {"image": image_bar.transpose(0, 2, 1).astype(dtype, order="C")}


def cases():
    rng = np.random.default_rng(23)
    truth = rng.random((13, 6, 3))
    image = np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0, 1)
    yield Case("ordinary", dict(image=image, truth=truth))
    same = {"ssim": np.float64(1), "image_bar": np.zeros_like(truth)}
    yield Case("identical", dict(image=truth, truth=truth), ("zero",), smooth=False, expected=same)
    yield Case(
        "black", dict(image=0 * truth, truth=0 * truth), ("zero",), smooth=False, expected=same
    )
    yield Case("one_pixel", dict(image=image[:1, :1], truth=truth[:1, :1]), ("single",))
    yield Case(
        "wider_than_a_block",
        dict(image=rng.random((2, 70, 1)), truth=rng.random((2, 70, 1))),
        ("single",),
    )
    # flat and bright: E[x^2] - mu^2 in float32 would be rounding errors as large as C2 / 10^4
    yield Case(
        "flat", dict(image=np.full((20, 17, 1), 0.9), truth=np.full((20, 17, 1), 0.75)), ("single",)
    )


ssim = declare(
    "ssim",
    "",
    "mean (2 mu_x mu_y + C1)(2 sigma_xy + C2) / ((mu_x^2 + mu_y^2 + C1)(sigma_x^2 + sigma_y^2 + C2))",
    {"image": "H W C", "truth": "H W C", "ssim": ""},
    ("image",),
    forward,
    backward,
    cases,
)
