"""Processor times of the hot places on this machine: renderer, training step, coder, file."""

import time
from collections import Counter

import numpy as np

from ..codec.file import decode, encode
from ..codec.gaussian_table import MU_BITS, SIGMA_BITS
from ..codec.rans import pop_rows_plainly, push_rows_plainly
from ..codec.streams import decode_gaussian, encode_gaussian
from ..scenes import load_scene
from ..splatting import compositing, fast
from ..splatting.settings import FAST
from ..training.presets import TINY
from ..training.trainer import Trainer
from ..training.watch import equation_codes, watching
from .clock import alternate, disturbance, stretch_of
from .random_inputs import cov2d_of, random_splats
from .writer import table

REPEATS = 5  # turns of everything, and steps that are watched
COLUMNS = {
    "": "{what}",
    "ms": "{ms:.2f}",
    "readable twin, ms": "{twin_ms:.1f}",
    "times as fast": "{ratio:.0f}",
}


def renderers(n, size):
    """The fast renderer and its exact twin, forward and backward, for n random splats."""
    rng = np.random.default_rng(0)
    splats, image_bar = random_splats(rng, n, size, size), rng.normal(size=(size, size, 3))
    cov2d, frame = cov2d_of(splats["conic"]), dict(height=size, width=size, background=np.ones(3))

    def render_fast():
        _, saved = fast.forward(**splats, cov2d=cov2d, **frame, settings=FAST)
        fast.backward(saved, image_bar)

    def render_exactly():
        _, saved = compositing.forward(**splats, **frame)
        compositing.backward(saved, image_bar)

    return render_fast, render_exactly


def coders(n):
    """(encoder, readable twin) and (decoder, twin) of n symbols, each with its own Gaussian."""
    rng = np.random.default_rng(0)
    sigma, mu = np.exp(rng.uniform(np.log(0.15), np.log(8), n)), 3 * rng.normal(size=n)
    symbols = np.rint(mu + sigma * rng.normal(size=n)).astype(np.int64)
    units = [np.rint(mu * 2.0**MU_BITS), np.rint(np.log2(sigma) * 2.0**SIGMA_BITS)]
    units = [values.astype(np.int64) for values in units]
    data = encode_gaussian(symbols, *units)
    return (
        (
            lambda: encode_gaussian(symbols, *units),
            lambda: encode_gaussian(symbols, *units, push_rows=push_rows_plainly),
        ),
        (
            lambda: decode_gaussian(data, *units),
            lambda: decode_gaussian(data, *units, pop_rows=pop_rows_plainly),
        ),
    )


def trained(steps):
    """A trainer of the demo's scene after some steps, then at the beginning of stage 4."""
    trainer = Trainer(load_scene("bouncing"), TINY)
    with np.errstate(all="ignore"):
        while trainer.iteration < steps:
            trainer.step()
        trainer.iteration = TINY.stage_ends[2]
        trainer.step()
    return trainer


def by_equation(step):
    """{equation: ms} of one step; an equation that runs inside another one counts with it."""
    ms, started = Counter(), []

    def see(event, mark, frame, value):
        if event == "call":
            started.append(time.process_time())
        elif (begin := started.pop()) and not started:
            ms[mark[0]] += 1e3 * (time.process_time() - begin) / REPEATS

    with watching(equation_codes(), see):
        for _ in range(REPEATS):
            step()
    return dict(ms.most_common())


def bench(quick=False):
    """The rows that the command `bench` prints, and how far the machine was disturbed."""
    n, symbols, steps = (300, 2000, 20) if quick else (1000, 200_000, 600)
    trainer = trained(steps)
    model = trainer.model()
    data, (encoders, decoders) = encode(model), coders(symbols)
    places = {
        f"render {n:,} Gaussians, 64x64, with gradients": renderers(n, 64),
        f"encode {symbols:,} symbols": encoders,
        f"decode {symbols:,} symbols": decoders,
        f"encode a file of {len(data):,} bytes": (lambda: encode(model), None),
        f"decode a file of {len(data):,} bytes": (lambda: decode(data), None),
        "training step of `tiny`, stage 4": (trainer.step, None),
    }
    functions = {(what, i): f for what, both in places.items() for i, f in enumerate(both) if f}
    times, rows = alternate(functions, REPEATS), []
    for what, (_, twin) in places.items():
        row = {"what": what, "ms": times[what, 0].median}
        if twin:
            row["twin_ms"] = times[what, 1].median
            row["ratio"] = row["twin_ms"] / row["ms"]
        rows.append(row)
    parts = [{"what": f"  {key}", "ms": ms} for key, ms in by_equation(trainer.step).items()]
    stretch = stretch_of([one._asdict() for one in times.values()])
    return {"rows": [*rows, *parts], "stretch": stretch}


def describe(result):
    """The benchmark as text."""
    note = (
        "Below the step are its equations, forward and backward; watching them adds a little to "
        "each. What remains is Adam and what joins the equations."
    )
    return "\n".join(
        [*table(COLUMNS, result["rows"]), note, disturbance(result["stretch"])]
    ).rstrip()
