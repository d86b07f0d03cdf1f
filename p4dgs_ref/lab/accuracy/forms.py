"""Cheaper forms of a function beside its true value: what the harness of formulas measures.

Each function below returns {(line, value): (run, judge)}. `run()` computes one form and is timed;
`judge(result)` returns the columns of its errors. The values of a knob go from the reference to
cheaper ones. The page's table shows the first line.
"""

import zlib
from functools import partial

import numpy as np
from numpy.linalg import norm
from scipy.special import roots_legendre

from ...codec.gaussian_table import MU_BITS, SIGMA_BITS
from ...codec.streams import decode_gaussian, encode_gaussian
from ...equations import likelihood
from ...oracle.compare import cast
from ...splatting import fast
from ...splatting.settings import EXACT, FAST, KERNEL
from ...splatting.table import EQUATIONS
from ..random_inputs import cov2d_of, random_anchor_network, random_splats
from . import formulas

CUTS = {"1e-9": 1e-9, "1e-6": 1e-6, "5e-5": 5e-5, "1e-3": 1e-3, "1/255": 1 / 255, "1e-2": 1e-2}
PER_ANCHOR = 34  # coded numbers of an anchor in the preset `tiny`
LANES = "lanes chosen"  # by the encoder


def gradient_errors(truth, gradient):
    """The largest error of the arrays of a gradient, each relative to the length of its array."""
    return {"error": float(max(norm(gradient[n] - a) / norm(a) for n, a in truth.items()))}


# --- rendering -----------------------------------------------------------------------------------
def splat_scene(n, side, **spread):
    """Splats, their covariances, the frame of an image, and a white-noise cotangent."""
    splats = random_splats(np.random.default_rng(0), n, side, side, **spread)
    frame = dict(background=np.array([0.9, 0.5, 0.2]), height=side, width=side)
    image_bar = np.random.default_rng(1).normal(size=(side, side, 3))
    return splats, cov2d_of(splats["conic"]), frame, image_bar


def picture(scene, settings):
    """The image, its pullback, and how many pairs of a Gaussian and a pixel were evaluated."""
    splats, cov2d, frame, _ = scene
    if settings.footprint == "all":
        inputs = cast({**splats, **frame}, settings.dtype)
        outputs, pullback = EQUATIONS["compositing"].vjp(**inputs)
        pairs = frame["height"] * frame["width"] * int(splats["visible"].sum())
        return outputs["image"], lambda bar: pullback(image_bar=bar.astype(settings.dtype)), pairs
    (image, _), saved = fast.forward(**splats, cov2d=cov2d, **frame, settings=settings)
    return image, partial(fast.backward, saved), sum(A.size for _, _, A, *_ in saved[0])


def image_and_gradients(scene, settings):
    """The image, its gradients, and the number of pairs."""
    image, pullback, pairs = picture(scene, settings)
    return image, pullback(scene[-1]), pairs


def image_errors(truth, result):
    """Errors of an image against that of the exact renderer."""
    gap = result[0].astype(float) - truth[0]
    return {
        "error": float(np.abs(gap).max()),
        "rms_error": float(np.sqrt((gap**2).mean())),
        "pairs": result[2],
    }


def errors_with_gradients(truth, result):
    """Errors of an image and of its gradients against those of the exact renderer."""
    of_gradients = gradient_errors(truth[1], result[1])["error"]
    return {**image_errors(truth, result), "gradient_error": of_gradients}


def rendered(choices, scene, run=image_and_gradients, judge=errors_with_gradients):
    """Forms of the renderer, {(line, value): Settings}, for one scene."""
    judge = partial(judge, run(scene, EXACT))
    return {key: (partial(run, scene, settings), judge) for key, settings in choices.items()}


def renderer(quick):
    """The three named settings, on small splats: a frame, and a frame with its gradients."""
    scene = splat_scene(*((300, 48) if quick else (1000, 64)))
    frames, both = (
        {(line, s.name): s for s in (EXACT, FAST, KERNEL)} for line in ("a frame", "with gradients")
    )
    return rendered(frames, scene, picture, image_errors) | rendered(both, scene)


def cut(quick):
    """Where a Gaussian ends, in both precisions."""
    scene = splat_scene(*((300, 48) if quick else (1000, 64)))
    choices = {
        (dtype, name): FAST._replace(cut=cut, dtype=dtype)
        for dtype in ("float32", "float64")
        for name, cut in CUTS.items()
    }
    return rendered(choices, scene)


def stop(quick):
    """Where a ray ends, behind large opaque splats, with small and with large tiles."""
    scene = splat_scene(*((150, 48) if quick else (350, 64)), sigma=(4.0, 12.0), alpha=(0.5, 0.98))
    choices = {
        (f"tiles of {tile} pixels", name): FAST._replace(tile=tile, stop=stop)
        for tile in (8, 16)
        for name, stop in {"0": 0.0, "1e-4": 1e-4, "1e-2": 1e-2}.items()
    }
    return rendered(choices, scene)


# --- gradients -----------------------------------------------------------------------------------
def precision(quick):
    """Three equations, forward and backward, in float64 and float32."""
    rng, n = np.random.default_rng(0), 1 if quick else 4
    splats, _, frame, _ = splat_scene(30 * n, 24)
    sigma = rng.lognormal(size=(200 * n, PER_ANCHOR))
    noise = rng.normal(size=sigma.shape)
    inputs_of = {
        "compositing": {**splats, **frame},
        "likelihood": dict(f_noisy=sigma * noise, mu=0 * sigma, sigma=sigma, q=0.5 * sigma),
        "opacity": random_anchor_network(rng, A=500 * n, d=16, k=4, hidden=(32, 32)),
    }
    forms = {}
    for key, inputs in inputs_of.items():
        outputs = EQUATIONS[key](**inputs)
        bars = {f"{name}_bar": rng.normal(size=np.shape(a)) for name, a in outputs.items()}
        runs = {
            dtype: partial(gradients_of, key, cast(inputs, dtype), cast(bars, dtype))
            for dtype in ("float64", "float32")
        }
        judge = partial(gradient_errors, runs["float64"]())
        forms |= {(key, dtype): (run, judge) for dtype, run in runs.items()}
    return forms


def gradients_of(key, inputs, bars):
    """The arrays of an equation's gradient, {name: array}; those of lists are left out."""
    _, pullback = EQUATIONS[key].vjp(**inputs)
    return {name: a for name, a in pullback(**bars).items() if isinstance(a, np.ndarray)}


# --- Eq. (11) ------------------------------------------------------------------------------------
# Limits of distances and widths in sigmas: the declared domain, and the values of a trained model.
DOMAIN = (1e-2, 1e3), (1e-12, 1e6)
USUAL = (1e-2, 3), (1e-2, 10)


def bins(limits, n):
    """n random distances and widths, numbers that float32 can hold."""
    rng = np.random.default_rng(0)
    drawn = (np.exp(rng.uniform(np.log(low), np.log(high), n)) for low, high in limits)
    return [a.astype(np.float32).astype(float) for a in drawn]


def priced(choices, quick, dtype="float64"):
    """Forms of Eq. (11), {(line, value): (formula, limits)}, in one precision."""
    forms = {}
    for key, (formula, limits) in choices.items():
        z, w = bins(limits, 2000 if quick else 20_000)
        run = partial(formula, **formulas.inputs(z, w, dtype))
        forms[key] = run, partial(bin_errors, formula, z, w, dtype)
    return forms


def bin_errors(formula, z, w, dtype, result):
    """The largest errors of bits and slopes over some bins; infinite where one is not finite."""
    bits, slopes = (
        float(a.max()) if np.isfinite(a).all() else np.inf
        for a in formulas.errors(formula, z, w, dtype)
    )
    failed = float(np.mean(~np.isfinite(result[0])))
    return {
        "bits_error": bits,
        "slopes_error": slopes,
        "failed_share": failed,
        "symbols": len(z),
    }


def likelihood_formula(quick):
    """Formulas of Eq. (11) over the declared domain, and over the values of a trained model."""
    order = ("stable", "log domain", formulas.TABLE, "HAC, floor 1e-6", "tail-symmetric", "literal")
    lines = {"the declared domain": DOMAIN, "up to 3 σ, bins of 0.01 to 10 σ": USUAL}
    forms = {}
    for line, limits in lines.items():
        for dtype in ("float64", "float32"):
            names = {(f"{line}, {dtype}", name): formulas.FORMULAS[name] for name in order}
            choices = {key: (formula, limits) for key, formula in names.items()}
            forms |= priced(choices, quick, dtype)
    return forms


def likelihood_table(quick):
    """Eq. (11) from tables of the normal distribution, entries per sigma."""
    tables = {("", f"{n}"): (formulas.lookup_table(n), USUAL) for n in formulas.TABLES[::-1]}
    return priced({("", "stable"): (likelihood.forward, USUAL), **tables}, quick)


def message(n):
    """n symbols with their means and deviations in steps."""
    rng = np.random.default_rng(0)
    sigma, mu = np.exp(rng.uniform(np.log(0.15), np.log(8), n)), 3 * rng.normal(size=n)
    return np.rint(mu + sigma * rng.normal(size=n)).astype(np.int64), mu, sigma


def noise_draws(_quick):
    """Bits of noisy symbols, averaged over some draws, against their mean over all noise."""
    symbols, mu, sigma = message(200 * PER_ANCHOR)

    def price(u):
        return likelihood.forward(symbols + u, mu, sigma, np.ones(len(mu)))[0]

    def run(draws):
        rng = np.random.default_rng(1)
        return sum(price(rng.uniform(-0.5, 0.5, len(mu))) for _ in range(draws)) / draws

    nodes, weights = roots_legendre(32)
    truth = weights / 2 @ np.array([price(node / 2) for node in nodes])

    def judge(bits):
        """The standard error of the rate, the sum of all bits, relative to the rate."""
        return {"error": float(norm(bits - truth) / truth.sum())}

    return {("", f"{n}"): (partial(run, n), judge) for n in (64, 16, 4, 1)}


# --- the entropy coder ---------------------------------------------------------------------------
def in_units(mu, sigma):
    """Means and deviations as the integers of the coder."""
    scaled = mu * 2.0**MU_BITS, np.log2(sigma) * 2.0**SIGMA_BITS
    return [np.rint(values).astype(np.int64) for values in scaled]


def coder(_quick):
    """Encoding and decoding the symbols of 2,000 anchors, and the bytes above their entropy.

    zlib, which knows no Gaussians, has the same symbols as integers of 16 bits.
    """
    symbols, mu, sigma = message(2000 * PER_ANCHOR)
    entropy = likelihood.forward(symbols.astype(float), mu, sigma, np.ones(len(mu)))[0].sum() / 8
    units, plain = in_units(mu, sigma), symbols.astype("<i2").tobytes()
    encoders = {
        name: partial(encode_gaussian, symbols, *units, lanes=lanes)
        for name, lanes in {"1 lane": 1, "8 lanes": 8, LANES: None, "64 lanes": 64}.items()
    }
    encoders["zlib"] = partial(zlib.compress, plain, 9)
    streams = {name: encode() for name, encode in encoders.items()}
    decoders = {name: partial(decode_gaussian, data, *units) for name, data in streams.items()}
    decoders["zlib"] = partial(zlib.decompress, streams["zlib"])

    def judge(name, _result):
        above = len(streams[name]) - entropy
        return {"error": above / entropy, "above_bytes": above, "entropy_bytes": entropy}

    return {
        (line, name): (run, partial(judge, name))
        for line, runs in {"encode": encoders, "decode": decoders}.items()
        for name, run in runs.items()
    }
