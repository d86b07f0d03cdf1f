"""Needles across a small picture: Gaussians far longer than thick, and the truth in decimals."""

from functools import cache

import numpy as np

from p4dgs_ref.splatting.camera import look_at
from tests.workshop.flat import described
from tests.workshop.sixty_digits import gradient, to_float, value

CAMERA = look_at((0.3, -4, 0.8), (0.02, 0, -0.03), 20.0, 17.0, 16, 12)
# Of the longest scale to the thinnest. Beside the square of the longest, doubles lose the square
# of the thinnest from 1e8 on.
RATIOS = (1e8, 1e13)


def needle(ratio):
    """The inputs of the renderer and a cotangent of the image: one needle, oblique to all axes."""
    r = np.array([[0.9, 0.2, -0.35, 0.4]])
    gaussians = dict(
        x=np.array([[0.05, 0.1, -0.08]]),
        s=np.array([[ratio**0.5, 3 * ratio**-0.5, ratio**-0.5]]),
        r=r / np.linalg.norm(r),
        alpha=np.array([0.8]),
        color=np.array([[0.9, 0.2, 0.4]]),
        background=np.array([0.1, 0.3, 0.6]),
    )
    image_bar = np.random.default_rng(4).normal(size=(CAMERA.height, CAMERA.width, 3))
    return gaussians, image_bar


@cache
def truth(ratio):
    """The image and the gradients of x, s and r, of 50 digits, rounded."""
    gaussians, image_bar = needle(ratio)
    inputs = dict(
        gaussians,
        **described(CAMERA),
        height=CAMERA.height,
        width=CAMERA.width,
        alpha_max=0.99,
    )
    image = value("render", inputs)["image"]
    bars = gradient("render", inputs, {"image_bar": image_bar})
    return to_float(image), {name: to_float(bar) for name, bar in bars.items()}
