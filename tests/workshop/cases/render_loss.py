"""Cases of Eq. (16)."""

import numpy as np

from p4dgs_ref.equations import ssim, window

from . import Case


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
    # by hand: one white pixel against black, where SSIM = C1 C2 / ((w^2 + C1)(w - w^2 + C2)), w
    # the window's centre
    w = window.WINDOW[0, window.RADIUS] ** 2
    D = 1 - ssim.C1 * ssim.C2 / ((w**2 + ssim.C1) * (w - w**2 + ssim.C2))
    yield Case(
        "white_on_black",
        dict(image=np.ones((1, 1, 1)), truth=np.zeros((1, 1, 1)), lambda_ssim=0.25),
        ("single", "zero"),
        expected={"L_render": np.float64(0.75 + 0.25 * D), "D_SSIM": np.float64(D)},
    )
