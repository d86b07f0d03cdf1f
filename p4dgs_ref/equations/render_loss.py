r"""Eq. (16): how far the rendered image is from the true one.

.. math:: L_{render} = (1 - \lambda_{SSIM}) L_1 + \lambda_{SSIM} (1 - \mathrm{SSIM})
"""

from typing import NamedTuple

import numpy as np

from . import ssim, window
from .equation import Case, declare


class Out(NamedTuple):
    L_render: np.ndarray  # scalar
    L1: np.ndarray  # scalar
    D_SSIM: np.ndarray  # scalar


class Res(NamedTuple):
    sign: np.ndarray  # (H, W, C) of image - truth
    lambda_ssim: float
    ssim: ssim.Res


def forward(image, truth, lambda_ssim, truth_moments=None):
    """Weigh absolute difference against structure.

    Shapes     image, truth (H, W, C), lambda_ssim scalar -> L_render, L1, D_SSIM scalars
    Units      intensities of range 1; losses dimensionless; truth_moments: `ssim.moments(truth)`, if at hand
    Domain     all reals; one pixel or more; lambda_ssim a Python float so that it promotes nothing
    Raises     nothing
    Gradient   image; truth and lambda_ssim are data; 0 for L1 where image = truth
    Choice     Q13: D_SSIM = 1 - SSIM, not halved
    Reference  P-4DGS Eq. (16)
    """
    difference = image - truth
    L1 = image.dtype.type(np.abs(difference).mean(dtype=np.float64))
    D_SSIM, res = ssim.dissimilarity(image, truth, truth_moments)
    D_SSIM = image.dtype.type(D_SSIM)
    return Out((1 - lambda_ssim) * L1 + lambda_ssim * D_SSIM, L1, D_SSIM), Res(
        np.sign(difference), lambda_ssim, res
    )


def backward(res, L_render_bar=None, L1_bar=None, D_SSIM_bar=None):
    L_render_bar, L1_bar, D_SSIM_bar = (
        0.0 if bar is None else bar for bar in (L_render_bar, L1_bar, D_SSIM_bar)
    )
    L1_bar = float(L1_bar + (1 - res.lambda_ssim) * L_render_bar)
    D_SSIM_bar = float(D_SSIM_bar + res.lambda_ssim * L_render_bar)
    return {
        "image": L1_bar / res.sign.size * res.sign + ssim.backward(res.ssim, -D_SSIM_bar)["image"]
    }


def cases():
    rng = np.random.default_rng(21)
    truth = rng.random((13, 6, 3))
    # no pixel nearer to the kink of L1 than the steps of a difference quotient
    image = truth + rng.uniform(0.05, 0.3, size=truth.shape) * rng.choice([-1, 1], size=truth.shape)
    yield Case("ordinary", dict(image=image, truth=truth, lambda_ssim=0.2))
    yield Case(
        "one_pixel", dict(image=image[:1, :1], truth=truth[:1, :1], lambda_ssim=0.2), ("single",)
    )
    yield Case(
        "no_structure",
        dict(image=image, truth=truth, lambda_ssim=0.0),
        ("zero",),
        expected={"L_render": np.abs(image - truth).mean()},
    )
    yield Case(
        "identical",
        dict(image=truth, truth=truth, lambda_ssim=0.2),
        ("kink", "zero"),
        smooth=False,
        expected={
            "L_render": np.float64(0),
            "L1": np.float64(0),
            "D_SSIM": np.float64(0),
            "image_bar": 0 * truth,
        },
    )
    # by hand: one white pixel against black, where SSIM = C1 C2 / ((w^2 + C1)(w - w^2 + C2)), w the window's centre
    w = window.WINDOW[0, window.RADIUS] ** 2
    D = 1 - ssim.C1 * ssim.C2 / ((w**2 + ssim.C1) * (w - w**2 + ssim.C2))
    yield Case(
        "white_on_black",
        dict(image=np.ones((1, 1, 1)), truth=np.zeros((1, 1, 1)), lambda_ssim=0.25),
        ("single", "zero"),
        expected={"L_render": np.float64(0.75 + 0.25 * D), "D_SSIM": np.float64(D)},
    )


render_loss = declare(
    "render_loss",
    "16",
    "L_render = (1 - lambda_ssim) L1 + lambda_ssim (1 - SSIM)",
    {"image": "H W C", "truth": "H W C", "lambda_ssim": "", "L_render": "", "L1": "", "D_SSIM": ""},
    ("image",),
    forward,
    backward,
    cases,
)
