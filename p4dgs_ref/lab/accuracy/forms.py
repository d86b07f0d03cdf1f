"""Functions in cheaper forms: what `p4dgs-ref accuracy` times, and how wrong each form is.

Each function below takes a trained model and views, and returns {choice: (run, loss)}: `run()`
computes one form on what the model draws or codes and is timed, `loss(result)` says by how much its
result is wrong. The first choice is the reference.
"""

from functools import partial

import numpy as np
from numpy.linalg import norm
from scipy.special import roots_legendre

from ...equations import likelihood
from ...model import join
from ...report.inspect import float_context
from ...splatting import compositing, fast, loop, render
from ...splatting.settings import EXACT, FAST, KERNEL
from . import formulas

GREY_LEVELS = 255
# Limits of distances and of widths in sigmas: the declared domain of Eq. (11).
DOMAIN = (1e-2, 1e3), (1e-12, 1e6)
WRONG = 0.1  # bits with a larger relative error count as wrong


# --- rendering -----------------------------------------------------------------------------------
def splats_in(model, view):
    """Return the splats of a model in a view, as arguments of the fast renderer."""
    camera, g = view.camera, model.gaussians(view.time, view.camera)
    names = "mean2d", "cov2d", "conic", "depth", "visible"
    splats = dict(zip(names, render.project(g.x, g.s, g.r, camera, EXACT)[0]))
    frame = dict(background=model.background, height=camera.height, width=camera.width)
    return {**splats, "alpha": g.alpha, "color": g.color, **frame}


def exact_image(scene):
    """Return the image with every splat at every pixel."""
    (image, _), _ = compositing.forward(**{k: a for k, a in scene.items() if k != "cov2d"})
    return image


def image_of(renderer, settings, scene):
    """Return the image that `loop` or `fast` draws."""
    (image, _), _ = renderer.forward(**scene, settings=settings)
    return image


def renderer(model, views):
    """Return the loop over splats, its exact twin, the fast renderer, and that as 3DGS's kernel."""
    frames = [splats_in(model, view) for view in views]
    draw = {
        "loop": partial(image_of, loop, EXACT),
        "exact": exact_image,
        "fast": partial(image_of, fast, FAST),
        "3DGS's kernel": partial(image_of, fast, KERNEL),
    }

    def images(choice):
        return np.array([draw[choice](frame) for frame in frames])

    truth = images("loop")

    def loss(drawn):
        return GREY_LEVELS * np.abs(drawn - truth).max()

    return {choice: (partial(images, choice), loss) for choice in draw}


def precision(model, views):
    """Return the gradients of the fast renderer, forward and backward, in either precision."""
    scene = splats_in(model, views[0])
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


def coded(model):
    """Return the coded numbers of a model, and mu, sigma and q of each."""
    ctx = float_context(model)
    return join(model.anchors), ctx.mu, ctx.sigma, np.repeat(ctx.q, model.design.widths, axis=1)


def eq_11(model, views):
    """Return formulas of Eq. (11) on the model's bins, and the share of random bins that is wrong.

    Nearly all bins of a model are within 3 sigma of the mean, where every formula is right. So a
    formula is timed on these, and judged in % of the random bins of its whole domain.
    """
    values, mu, sigma, q = coded(model)
    u = np.random.default_rng(0).random(q.shape) - 0.5
    usual = dict(f_noisy=values + u * q, mu=mu, sigma=sigma, q=q)
    z, w = bins()
    inputs = formulas.inputs(z, w, "float64")
    bits = -formulas.truth(z, w)[0] / np.log(2)

    def share_wrong(formula):
        error = np.abs(formula(**inputs)[0][0] - bits) / np.maximum(bits, formulas.SMALLEST_BITS)
        return 100 * np.mean(~(error <= WRONG))

    choices = {}
    for name in ("ours", "as printed", "p at least 1e-30"):
        formula = formulas.FORMULAS[name]
        choices[name] = partial(formula, **usual), lambda _, formula=formula: share_wrong(formula)
    return choices


def noise_draws(model, views):
    """Return the rate from some draws of the noise, to be compared with its mean over the noise.

    The loss is the standard error of the sum of all bits, in % of it.
    """
    values, mu, sigma, q = coded(model)

    def price(u):
        return likelihood.forward(values + u * q, mu, sigma, q)[0]

    def run(draws):
        rng = np.random.default_rng(1)
        return sum(price(rng.random(q.shape) - 0.5) for _ in range(draws)) / draws

    nodes, weights = roots_legendre(32)
    truth = sum(weight / 2 * price(node / 2) for weight, node in zip(weights, nodes))

    def loss(bits):
        return 100 * norm(bits - truth) / truth.sum()

    choices = {"64 draws": 64, "8 draws": 8, "1 draw": 1}
    return {name: (partial(run, draws), loss) for name, draws in choices.items()}
