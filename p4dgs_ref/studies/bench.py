"""How long the hot places take on this machine: renderer, parts of a training step, entropy coder."""

import time
import tracemalloc
from dataclasses import replace

import numpy as np

from .. import model
from ..codec.context import coding_context
from ..codec.file import attribute_columns
from ..codec.gaussian_table import MU_BITS, SIGMA_BITS
from ..codec.inspect import float_context
from ..codec.quantise import quantise
from ..codec.rans import pop_rows_plainly, push_rows_plainly
from ..codec.streams import decode_gaussian, encode_gaussian
from ..equations import (
    anchor_rate,
    deformation,
    deformed,
    hash_rate,
    likelihood,
    noise,
    rate_loss,
    render_loss,
    total_loss,
)
from ..equations.prior import layout
from ..model import split
from ..scenes import load_scene
from ..splatting import compositing, covariance, fast, projection
from ..splatting.settings import FAST
from ..training import objective
from ..training.adam import Adam
from ..training.presets import TINY
from ..training.trainer import Trainer

# Which functions make up which part of a step; prediction and rate are counted without what they call from others.
PAIR = ("forward", "backward")
PARTS = {
    "deformation": [(m, name) for m in (deformation, deformed) for name in PAIR],
    "projection": [(m, name) for m in (covariance, projection) for name in PAIR],
    "compositing": [(fast, name) for name in PAIR],
    "loss": [(m, name) for m in (render_loss, total_loss) for name in PAIR],
    "rate": [
        (m, name) for m in (noise, likelihood, anchor_rate, hash_rate, rate_loss) for name in PAIR
    ]
    + [(objective, "context"), (objective, "context_backward")],
    "prediction": [
        (m, name)
        for m in (
            model.view,
            model.opacity,
            model.color,
            model.rotation,
            model.scale,
            model.offsets,
            model.masking,
        )
        for name in PAIR
    ],
    "optimiser": [(Adam, "step")],
}


def alternate(functions, repeats):
    """Median milliseconds of each function, called in turn so that noise hits all alike: {name: ms}."""
    times = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: float(np.median(values)) for name, values in times.items()}


def splat_inputs(n, size, seed=0):
    """Random splats of 1.5 to 4 pixels in a square image, for both renderers."""
    splats = compositing.random_splats(np.random.default_rng(seed), n, size, size)
    a, b, c = splats["conic"].T
    cov2d = np.stack([c, -b, a], axis=1) / (a * c - b * b)[:, None]
    return splats, cov2d, dict(background=np.ones(3), height=size, width=size)


def bench_renderer(n, size, repeats=9):
    """Fast renderer against the dense exact twin: times, errors, counted pairs, peak memory of one call."""
    splats, cov2d, frame = splat_inputs(n, size)
    image_bar = np.random.default_rng(1).normal(size=(size, size, 3))

    def run_fast():
        out, res = fast.forward(**splats, cov2d=cov2d, **frame, settings=FAST)
        return out, fast.backward(res, image_bar), res

    def run_exact():
        out, res = compositing.forward(**splats, **frame)
        return out, compositing.backward(res, image_bar)

    out, bars, res = run_fast()
    exact, exact_bars = run_exact()
    errors = {
        name: float(
            np.linalg.norm(bars[name] - exact_bars[name]) / np.linalg.norm(exact_bars[name])
        )
        for name in bars
    }
    times = {"fast": [], "exact": []}
    for i in range(repeats):  # alternating; the slow one three times is enough for its median
        times["fast"].append(alternate({"fast": run_fast}, 3)["fast"])
        if i % max(repeats // 3, 1) == 0:
            times["exact"].append(alternate({"exact": run_exact}, 1)["exact"])
    ms = {name: float(np.median(values)) for name, values in times.items()}
    return {
        "gaussians": n,
        "size": size,
        "fast_ms": ms["fast"],
        "exact_ms": ms["exact"],
        "ratio": ms["exact"] / ms["fast"],
        "image_error_max": float(np.abs(out.image - exact.image).max()),
        "gradient_error_max": max(errors.values()),
        "gradient_errors": errors,
        "pairs": len(res.lists.row),
        "pixel_pairs": len(res.lists.row) * FAST.tile**2,
        "exact_pixel_pairs": n * size * size,
        "memory_mb": memory_of(run_fast),
    }


def memory_of(function):
    """Megabytes (10^6) of arrays alive at the worst moment of one call, as tracemalloc counts NumPy's buffers."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def step_parts(scene, preset, warm, repeats):
    """Milliseconds of every part of a stage-4 training step, after `warm` untimed steps from stage 1 on: {part: ms}.

    The functions of the pipelines are wrapped by a clock for the time of the measurement and put back afterwards.
    """
    trainer = Trainer(scene, preset)
    for _ in range(warm):
        trainer.step()
    trainer.iteration = max(trainer.iteration, preset.stage_ends[2])
    trainer.step()
    spent = dict.fromkeys(PARTS, 0.0)

    def timed(part, function):
        def run(*args, **kwargs):
            start = time.perf_counter()
            result = function(*args, **kwargs)
            spent[part] += time.perf_counter() - start
            return result

        return run

    kept = [
        (owner, name, getattr(owner, name)) for places in PARTS.values() for owner, name in places
    ]
    for part, places in PARTS.items():
        for owner, name in places:
            setattr(owner, name, timed(part, getattr(owner, name)))
    try:
        start = time.perf_counter()
        for _ in range(repeats):
            trainer.step()
        total = time.perf_counter() - start
    finally:
        for owner, name, function in kept:
            setattr(owner, name, function)
    ms = {part: 1e3 * seconds / repeats for part, seconds in spent.items()}
    return {
        **ms,
        "everything else": 1e3 * total / repeats - sum(ms.values()),
        "whole step": 1e3 * total / repeats,
    }


def bench_coder(n):
    """Milliseconds of the vectorised coder and of its readable per-symbol twin, which writes the same bytes.

    Every symbol has its own Gaussian; the evaluation of the integer model is included.
    """
    rng = np.random.default_rng(0)
    sigma = np.exp(rng.uniform(np.log(0.15), np.log(8), n))
    mu = rng.normal(size=n) * 3
    symbols = np.rint(mu + sigma * rng.normal(size=n)).astype(np.int64)
    units = (
        np.rint(mu * 2.0**MU_BITS).astype(np.int64),
        np.rint(np.log2(sigma) * 2.0**SIGMA_BITS).astype(np.int64),
    )
    bits = likelihood.forward(symbols.astype(float), mu, sigma, np.ones(n))[0].bits.sum()
    data = encode_gaussian(symbols, *units)
    ms = alternate(
        {
            "encode": lambda: encode_gaussian(symbols, *units),
            "decode": lambda: decode_gaussian(data, *units),
            "encode_plainly": lambda: encode_gaussian(symbols, *units, push_rows=push_rows_plainly),
            "decode_plainly": lambda: decode_gaussian(data, *units, pop_rows=pop_rows_plainly),
        },
        5,
    )
    return {
        "symbols": n,
        **{f"{name}_ms": value for name, value in ms.items()},
        "bytes": len(data),
        "over_entropy_percent": 100 * (8 * len(data) / bits - 1),
    }


def bench_sections(scene, symbols):
    """Milliseconds for the attribute sections of a whole model, its integer context included: encode and decode.

    A `tiny` model with random networks whose sigma is about two steps; the attributes are drawn from its prior.
    """
    trainer = Trainer(scene, TINY._replace(anchors=symbols // (TINY.d + 6 + 3 * TINY.k)))
    last, design, rng = (
        trainer.parameters[f"psi_p.b{len(TINY.context)}"],
        trainer.design,
        np.random.default_rng(0),
    )
    last[layout(design.widths)[1]] = np.log(2 * np.repeat(design.Q_0, design.widths))
    drawn = trainer.model()
    prior = float_context(drawn)
    f, s, l, O = split(prior.mu + prior.sigma * rng.normal(size=prior.mu.shape), design)
    q = quantise(replace(drawn, anchors=drawn.anchors._replace(f_a=f, s_a=s, l_a=l, O_a=O)))
    inputs = (design, q.model.networks, q.model.grids, q.positions)

    def parts(ctx):
        return [
            (ctx.mu_units[:, c].ravel(), ctx.sigma_units[:, c].ravel(), q.symbols[:, c].ravel())
            for _, c in attribute_columns(design)
        ]

    streams = [encode_gaussian(k, mu, sigma) for mu, sigma, k in parts(q.context)]
    ms = alternate(
        {
            "encode": lambda: [
                encode_gaussian(k, mu, sigma) for mu, sigma, k in parts(coding_context(*inputs))
            ],
            "decode": lambda: [
                decode_gaussian(data, mu, sigma)
                for data, (mu, sigma, _) in zip(streams, parts(coding_context(*inputs)))
            ],
        },
        5,
    )
    return {
        "symbols": q.symbols.size,
        "bits_per_symbol": 8 * sum(map(len, streams)) / q.symbols.size,
        "encode_ms": ms["encode"],
        "decode_ms": ms["decode"],
    }


def bench(quick=False):
    """Everything the command `bench` prints."""
    sizes = [(300, 64)] if quick else [(1000, 64), (5000, 128)]
    scene = load_scene("bouncing")
    warm, repeats = (320, 15) if quick else (TINY.stage_ends[1] + 300, 60)
    return {
        "renderer": [bench_renderer(n, size, 3 if quick else 9) for n, size in sizes],
        "step_ms": step_parts(scene, TINY, warm, repeats),
        "coder": [bench_coder(n) for n in ([2000] if quick else [20_000, 200_000])],
        "sections": bench_sections(scene, 2000 if quick else 200_000),
    }


def describe(result):
    """The benchmark as text."""
    lines = [
        "renderer, forward + backward: fast (float32) against the dense exact twin (float64), alternating"
    ]
    for r in result["renderer"]:
        lines.append(
            f"  {r['size']}x{r['size']}, {r['gaussians']} Gaussians: {r['fast_ms']:.1f} ms against {r['exact_ms']:.0f} ms, "
            f"{r['ratio']:.0f} times; image error {r['image_error_max']:.1e}, gradient error {r['gradient_error_max']:.1e}; "
            f"{r['pixel_pairs']:,} of {r['exact_pixel_pairs']:,} Gaussian-pixel pairs; {r['memory_mb']:.0f} MB"
        )
    lines.append("one training step of the demo, stage 4")
    lines += [f"  {part:16} {ms:6.2f} ms" for part, ms in result["step_ms"].items()]
    lines.append("entropy coder, every symbol with its own Gaussian")
    for r in result["coder"]:
        lines.append(
            f"  {r['symbols']:,} symbols, {r['over_entropy_percent']:+.3f} % over the entropy"
        )
        for what in ("encode", "decode"):
            fast, plain = r[f"{what}_ms"], r[f"{what}_plainly_ms"]
            lines.append(
                f"    {what} {fast:6.1f} ms ({r['symbols'] / fast / 1e3:.2f} M symbols/s); "
                f"readable twin {plain:6.1f} ms"
            )
    r = result["sections"]
    lines.append(
        f"all attribute sections of a model, integer context included: {r['symbols']:,} symbols, "
        f"{r['bits_per_symbol']:.1f} bits each"
    )
    lines += [
        f"    {what} {r[f'{what}_ms']:6.1f} ms ({r['symbols'] / r[f'{what}_ms'] / 1e3:.2f} M symbols/s)"
        for what in ("encode", "decode")
    ]
    return "\n".join(lines)
