"""Processor times of the hot places on this machine: renderer, training step, entropy coder."""

import tracemalloc
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np

from .. import model
from ..codec.context import coding_context
from ..codec.file import attribute_columns
from ..codec.gaussian_table import MU_BITS, SIGMA_BITS
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
from ..oracle.precision import cast
from ..report.inspect import float_context
from ..scenes import load_scene
from ..splatting import compositing, covariance, fast, projection
from ..splatting.settings import FAST
from ..training import objective
from ..training.adam import Adam
from ..training.presets import TINY
from ..training.trainer import Trainer
from .clock import alternate, clocked, clocks, disturbance
from .random_inputs import cov2d_of, random_splats

# The modules whose forward and backward make up each part of a training step.
MODULES = {
    "deformation": (deformation, deformed),
    "projection": (covariance, projection),
    "compositing": (fast,),
    "loss": (render_loss, total_loss),
    "rate": (noise, likelihood, anchor_rate, hash_rate, rate_loss),
    "prediction": (
        model.view,
        model.opacity,
        model.color,
        model.rotation,
        model.scale,
        model.offsets,
        model.masking,
    ),
}
PARTS = {
    **{
        part: [(module, name) for module in modules for name in ("forward", "backward")]
        for part, modules in MODULES.items()
    },
    "optimiser": [(Adam, "step")],
}
PARTS["rate"] += [(objective, "context"), (objective, "context_backward")]


@contextmanager
def replaced(owner, **members):
    """Replace members of a module or class for the time of a `with` block."""
    kept = {name: getattr(owner, name) for name in members}
    try:
        for name, member in members.items():
            setattr(owner, name, member)
        yield
    finally:
        for name, member in kept.items():
            setattr(owner, name, member)


def part_by_part(trainer, measured):
    """One step that measures every call of every part: {part: [amount of each call]}.

    `measured(function, *args, **kwargs)` returns the result of the function and an amount.
    """
    amounts = {part: [] for part in PARTS}

    def watched(part, function):
        def run(*args, **kwargs):
            result, amount = measured(function, *args, **kwargs)
            amounts[part].append(amount)
            return result

        return run

    with ExitStack() as stack:
        for part, places in PARTS.items():
            for owner, name in places:
                wrapped = watched(part, getattr(owner, name))
                stack.enter_context(replaced(owner, **{name: wrapped}))
        _, whole = measured(trainer.step)
    return {**amounts, "whole step": [whole]}


def step_times(trainer):
    """Seconds [2] of both clocks for every part in all its calls of one step, and for the step."""
    return {part: sum(calls, np.zeros(2)) for part, calls in part_by_part(trainer, clocked).items()}


def medians(functions, repeats):
    """Median milliseconds of processor time of each function, {name: ms}; called in turn."""
    return {name: times.median for name, times in alternate(functions, repeats).items()}


def memory_of(function):
    """Megabytes (10^6) of arrays alive at the worst moment of one call, as tracemalloc counts."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def splat_scene(n, size, background=(1.0, 1.0, 1.0), **spread):
    """Inputs of both renderers: splats, their covariances, the frame, a white-noise cotangent."""
    splats = random_splats(np.random.default_rng(0), n, size, size, **spread)
    frame = dict(background=np.array(background), height=size, width=size)
    image_bar = np.random.default_rng(1).normal(size=(size, size, 3))
    return splats, cov2d_of(splats["conic"]), frame, image_bar


def run_fast(scene, settings):
    """The fast renderer, forward and backward: image, gradients, and what forward saved."""
    splats, cov2d, frame, image_bar = scene
    (image, _), saved = fast.forward(**splats, cov2d=cov2d, **frame, settings=settings)
    return image, fast.backward(saved, image_bar), saved


def run_exact(scene, dtype="float64"):
    """The exact twin in one precision, forward and backward: image and gradients."""
    splats, _, frame, image_bar = scene
    (image, _), saved = compositing.forward(**cast({**splats, **frame}, dtype))
    return image, compositing.backward(saved, image_bar.astype(dtype))


def relative_error(found, truth):
    """The distance of an array from the truth, relative to the length of the truth."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def bench_renderer(n, size, repeats=9):
    """The fast renderer against the exact twin: times, errors, counted pairs, peak memory."""
    scene = splat_scene(n, size)
    image, gradients, (_, _, _, _, lists, *_) = run_fast(scene, FAST)
    exact, exact_gradients = run_exact(scene)
    errors = {name: relative_error(a, exact_gradients[name]) for name, a in gradients.items()}
    # Three times are enough for the median of the slow twin.
    runs = {"exact": lambda: run_exact(scene)}
    runs |= {i: lambda: run_fast(scene, FAST) for i in range(repeats)}
    ms = medians(runs, 3)
    fast_ms = float(np.median([ms[i] for i in range(repeats)]))
    return {
        "gaussians": n,
        "size": size,
        "fast_ms": fast_ms,
        "exact_ms": ms["exact"],
        "ratio": ms["exact"] / fast_ms,
        "image_error_max": float(np.abs(image - exact).max()),
        "gradient_error_max": max(errors.values()),
        "gradient_errors": errors,
        "pairs": len(lists.row),
        "pixel_pairs": len(lists.row) * FAST.tile**2,
        "exact_pixel_pairs": n * size * size,
        "memory_mb": memory_of(lambda: run_fast(scene, FAST)),
    }


def step_parts(scene, preset, warm, repeats):
    """Milliseconds of each part of a stage-4 training step, after `warm` untimed steps."""
    trainer = Trainer(scene, preset)
    for _ in range(warm):
        trainer.step()
    trainer.iteration = max(trainer.iteration, preset.stage_ends[2])
    trainer.step()
    steps = [step_times(trainer) for _ in range(repeats)]
    ms = {part: float(np.mean([1e3 * step[part][0] for step in steps])) for part in steps[0]}
    whole = ms.pop("whole step")
    return {**ms, "everything else": whole - sum(ms.values()), "whole step": whole}


def random_message(n, seed=0):
    """n symbols, each with its own mean and deviation in steps: three arrays (n,)."""
    rng = np.random.default_rng(seed)
    sigma = np.exp(rng.uniform(np.log(0.15), np.log(8), n))
    mu = 3 * rng.normal(size=n)
    return np.rint(mu + sigma * rng.normal(size=n)).astype(np.int64), mu, sigma


def in_units(mu, sigma):
    """Means and deviations in steps as the integers of the codec."""
    mu_units, log_sigma = np.rint(mu * 2.0**MU_BITS), np.rint(np.log2(sigma) * 2.0**SIGMA_BITS)
    return mu_units.astype(np.int64), log_sigma.astype(np.int64)


def quantised_tiny(anchors, gain=1.0):
    """A quantised model of the preset `tiny`, untrained, with attributes drawn from its own prior.

    The deviations are about two steps; `gain` scales their dependence on the position.
    """
    trainer = Trainer(load_scene("bouncing"), TINY._replace(anchors=anchors))
    design = trainer.design
    last = trainer.parameters[f"psi_p.b{len(TINY.context)}"]
    last[layout(design.widths)[1]] = np.log(2 * np.repeat(design.Q_0, design.widths))
    trainer.networks["psi_p"][0][-1][...] *= gain
    drawn = trainer.model()
    prior = float_context(drawn)
    values = prior.mu + prior.sigma * np.random.default_rng(0).normal(size=prior.mu.shape)
    f, s, l, O = model.split(values, design)
    return quantise(replace(drawn, anchors=drawn.anchors._replace(f_a=f, s_a=s, l_a=l, O_a=O)))


def bench_coder(n):
    """Milliseconds of the vectorised coder and of its readable twin, which writes the same bytes.

    Every symbol has its own Gaussian. The times include the evaluation of the integer model.
    """
    symbols, mu, sigma = random_message(n)
    units = in_units(mu, sigma)
    bits, _ = likelihood.forward(symbols.astype(float), mu, sigma, np.ones(n))
    data = encode_gaussian(symbols, *units)
    runs = {
        "encode": lambda: encode_gaussian(symbols, *units),
        "decode": lambda: decode_gaussian(data, *units),
        "encode_plainly": lambda: encode_gaussian(symbols, *units, push_rows=push_rows_plainly),
        "decode_plainly": lambda: decode_gaussian(data, *units, pop_rows=pop_rows_plainly),
    }
    ms = medians(runs, 5)
    return {
        "symbols": n,
        **{f"{name}_ms": value for name, value in ms.items()},
        "bytes": len(data),
        "over_entropy_percent": 100 * (8 * len(data) / bits.sum() - 1),
    }


def bench_sections(symbols):
    """Milliseconds for the attribute sections of a whole model, with its integer context."""
    q = quantised_tiny(symbols // (TINY.d + 6 + 3 * TINY.k))
    design = q.model.design

    def sections(ctx):
        """(symbols, mu_units, sigma_units) of each section."""
        arrays = q.symbols, ctx.mu_units, ctx.sigma_units
        return [[a[:, c].ravel() for a in arrays] for _, c in attribute_columns(design)]

    def computed():
        return sections(coding_context(design, q.model.networks, q.model.grids, q.positions))

    streams = [encode_gaussian(*section) for section in sections(q.context)]
    runs = {
        "encode": lambda: [encode_gaussian(*section) for section in computed()],
        "decode": lambda: [
            decode_gaussian(data, *units) for data, (_, *units) in zip(streams, computed())
        ],
    }
    ms = medians(runs, 5)
    return {
        "symbols": q.symbols.size,
        "bits_per_symbol": 8 * sum(map(len, streams)) / q.symbols.size,
        "encode_ms": ms["encode"],
        "decode_ms": ms["decode"],
    }


def bench(quick=False):
    """Everything that the command `bench` prints."""
    sizes = [(300, 64)] if quick else [(1000, 64), (5000, 128)]
    warm, repeats = (320, 15) if quick else (TINY.stage_ends[1] + 300, 60)
    start = clocks()
    found = {
        "renderer": [bench_renderer(n, size, 3 if quick else 9) for n, size in sizes],
        "step_ms": step_parts(load_scene("bouncing"), TINY, warm, repeats),
        "coder": [bench_coder(n) for n in ([2000] if quick else [20_000, 200_000])],
        "sections": bench_sections(2000 if quick else 200_000),
    }
    processor, wall = clocks() - start
    return {**found, "stretch": wall / processor}


def describe(result):
    """The benchmark as text."""
    lines = ["renderer, forward and backward: fast (float32) against the exact twin (float64)"]
    for r in result["renderer"]:
        lines.append(
            f"  {r['size']}x{r['size']}, {r['gaussians']} Gaussians: {r['fast_ms']:.1f} ms against "
            f"{r['exact_ms']:.0f} ms, {r['ratio']:.0f} times as fast; image error "
            f"{r['image_error_max']:.1e}, gradient error {r['gradient_error_max']:.1e}; "
            f"{r['pixel_pairs']:,} of {r['exact_pixel_pairs']:,} Gaussian-pixel pairs; "
            f"{r['memory_mb']:.0f} MB"
        )
    lines.append("one training step of the demo, stage 4")
    lines += [f"  {part:16} {ms:6.2f} ms" for part, ms in result["step_ms"].items()]
    lines.append("entropy coder, every symbol with its own Gaussian")
    for r in result["coder"]:
        lines.append(
            f"  {r['symbols']:,} symbols, {r['over_entropy_percent']:+.3f} % more than the entropy"
        )
        lines += [
            f"    {speed(what, r)}; readable twin {r[f'{what}_plainly_ms']:6.1f} ms"
            for what in ("encode", "decode")
        ]
    r = result["sections"]
    lines.append(
        f"all attribute sections of a model, with the integer context: {r['symbols']:,} symbols, "
        f"{r['bits_per_symbol']:.1f} bits each"
    )
    lines += [f"    {speed(what, r)}" for what in ("encode", "decode")]
    return "\n".join([*lines, disturbance(result["stretch"])]).rstrip()


def speed(what, row):
    """The time and the symbols per second of encoding or decoding."""
    ms = row[f"{what}_ms"]
    return f"{what} {ms:6.1f} ms ({row['symbols'] / ms / 1e3:.2f} M symbols/s)"
