"""Cases of SSIM."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(23)
    truth = rng.random((13, 6, 3))
    image = np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0, 1)
    same = {"ssim": np.float64(1), "image_bar": np.zeros_like(truth)}
    return [
        Case("ordinary", dict(image=image, truth=truth)),
        Case("identical", dict(image=truth, truth=truth), ("zero",), smooth=False, expected=same),
        Case(
            "black", dict(image=0 * truth, truth=0 * truth), ("zero",), smooth=False, expected=same
        ),
        Case("one_pixel", dict(image=image[:1, :1], truth=truth[:1, :1]), ("single",)),
        Case(
            "wider_than_a_block",
            dict(image=rng.random((2, 70, 1)), truth=rng.random((2, 70, 1))),
            ("single",),
        ),
        # flat and bright: E[x^2] - mu^2 in float32 would be rounding errors as large as C2 / 10^4
        Case(
            "flat",
            dict(image=np.full((20, 17, 1), 0.9), truth=np.full((20, 17, 1), 0.75)),
            ("single",),
        ),
    ]
