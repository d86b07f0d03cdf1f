"""A function in cheaper forms: what `p4dgs-ref accuracy` times, and how wrong each form is.

Each function below returns {choice: (run, loss)}: `run()` computes one form and is timed,
`loss(result)` says by how much its result is wrong. The first choice is the reference.
"""

from functools import partial

import numpy as np
from numpy.linalg import norm
from scipy.special import roots_legendre

from ...equations import likelihood
from ...splatting import compositing, fast, loop
from ...splatting.settings import EXACT, FAST, KERNEL
from ..random_inputs import cov2d_of, random_splats
from . import formulas

GREY_LEVELS = 255
# Limits of distances and of widths in sigmas: the declared domain of Eq. (11).
DOMAIN = (1e-2, 1e3), (1e-12, 1e6)
WRONG = 0.1  # relative error of the bits from which on they count as wrong
CODED_NUMBERS = 200 * 34  # of 200 anchors in the preset `tiny`


# --- rendering -----------------------------------------------------------------------------------
def splat_scene(n=1000, side=64):
    """Return n random splats and the frame of an image, as arguments of the fast renderer."""
    splats = random_splats(np.random.default_rng(0), n, side, side)
    frame = dict(background=np.array([0.9, 0.5, 0.2]), height=side, width=side)
    return {**splats, **frame, "cov2d": cov2d_of(splats["conic"])}


def exact_image(scene):
    """Return the image with every splat at every pixel."""
    (image, _), _ = compositing.forward(**{k: a for k, a in scene.items() if k != "cov2d"})
    return image


def image_of(renderer, scene, settings):
    """Return the image that `loop` or `fast` draws."""
    (image, _), _ = renderer.forward(**scene, settings=settings)
    return image


def renderer():
    """Return the loop over splats, its exact twin, the fast renderer, and it as 3DGS's kernel."""
    scene = splat_scene()
    draw = {
        "loop": partial(image_of, loop, scene, EXACT),
        "exact": partial(exact_image, scene),
        "fast": partial(image_of, fast, scene, FAST),
        "3DGS's kernel": partial(image_of, fast, scene, KERNEL),
    }
    truth = draw["loop"]()

    def loss(image):
        return GREY_LEVELS * np.abs(image - truth).max()

    return {choice: (run, loss) for choice, run in draw.items()}


def precision():
    """Return the gradients of the fast renderer, forward and backward, in either precision."""
    scene = splat_scene()
    image_bar = np.random.default_rng(1).normal(size=(scene["height"], scene["width"], 3))

    def gradients(dtype):
        _, saved = fast.forward(**scene, settings=FAST._replace(dtype=dtype))
        return fast.backward(saved, image_bar)

    truth = gradients("float64")

    def loss(gradients):
        return max(norm(gradients[name] - a) / norm(a) for name, a in truth.items())

    return {dtype: (partial(gradients, dtype), loss) for dtype in ("float64", "float32")}


# --- bits ----------------------------------------------------------------------------------------
def bins(limits=DOMAIN, n=20_000):
    """Return n random distances and widths in float32, on both sides of the mean: 2n bins."""
    rng = np.random.default_rng(0)
    drawn = (np.exp(rng.uniform(np.log(low), np.log(high), n)) for low, high in limits)
    z, w = (a.astype(np.float32).astype(float) for a in drawn)
    return np.append(z, -z), np.append(w, w)


def eq_11():
    """Return formulas of Eq. (11) on both sides of the mean, and the share in % that is wrong."""
    z, w = bins()
    inputs = formulas.inputs(z, w, "float64")
    bits = -formulas.truth(z, w)[0] / np.log(2)

    def loss(result):
        error = np.abs(result[0][0] - bits) / np.maximum(bits, formulas.SMALLEST_BITS)
        return 100 * np.mean(~(error <= WRONG))

    shown = "ours", "as printed", "mirrored", "table, 256 per σ"
    return {name: (partial(formulas.FORMULAS[name], **inputs), loss) for name in shown}


def noise_draws():
    """Return the rate by some draws of the noise; the loss is against its mean, in % of the bits.

    The loss is the standard error of the sum of all bits.
    """
    rng = np.random.default_rng(0)
    sigma = np.exp(rng.uniform(np.log(0.15), np.log(8), CODED_NUMBERS))
    mu = 3 * rng.normal(size=CODED_NUMBERS)
    symbols = np.rint(mu + sigma * rng.normal(size=CODED_NUMBERS))

    def price(u):
        return likelihood.forward(symbols + u, mu, sigma, np.ones(CODED_NUMBERS))[0]

    def run(draws):
        rng = np.random.default_rng(1)
        return sum(price(rng.random(CODED_NUMBERS) - 0.5) for _ in range(draws)) / draws

    nodes, weights = roots_legendre(32)
    truth = weights / 2 @ np.array([price(node / 2) for node in nodes])

    def loss(bits):
        return 100 * norm(bits - truth) / truth.sum()

    choices = {"64 draws": 64, "8 draws": 8, "1 draw": 1}
    return {name: (partial(run, draws), loss) for name, draws in choices.items()}
