"""Processor times of the hot places on this machine: renderer, training step, coder, file."""

import time
from collections import Counter
from functools import partial

import numpy as np

from ..arithmetic import arithmetic
from ..codec.rans import pop_rows_plainly, push_rows_plainly
from ..codec.streams import decode_gaussian, encode_gaussian
from ..designs import decode, encode
from ..scenes import load_scene
from ..splatting.settings import EXACT, FAST
from ..training.presets import TINY
from ..training.trainer import Trainer
from ..training.watch import equation_codes, watching
from .accuracy.forms import image_and_gradients, in_units, message, splat_scene
from .clock import alternate, disturbance, stretch_of
from .writer import text_table

REPEATS = 5  # turns of everything, and steps that are watched
COLUMNS = {
    "": "{what}",
    "ms": "{ms:.2f}",
    "readable twin, ms": "{twin_ms:.1f}",
    "times as fast": "{ratio:.0f}",
}


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

    def time_calls(event, mark, frame, value):
        if event == "call":
            started.append(time.process_time())
        elif (begin := started.pop()) and not started:
            ms[mark[0]] += 1e3 * (time.process_time() - begin) / REPEATS

    with watching(equation_codes(), time_calls):
        for _ in range(REPEATS):
            step()
    return dict(ms.most_common())


def bench(quick=False):
    """The rows that `python -m p4dgs_ref.lab` prints, and how far the machine was disturbed."""
    n, count, steps = (300, 2000, 20) if quick else (1000, 200_000, 600)
    trainer, splats, (symbols, mu, sigma) = trained(steps), splat_scene(n, 64), message(count)
    units = in_units(mu, sigma)
    model, sent = trainer.model(), (symbols, *units)
    file, coded = encode(model), (encode_gaussian(*sent), *units)
    # A function and its readable twin, if it has one.
    places = {
        f"render {n:,} Gaussians, 64x64, with gradients": [
            partial(image_and_gradients, splats, settings) for settings in (FAST, EXACT)
        ],
        f"encode {count:,} symbols": [
            partial(encode_gaussian, *sent),
            partial(encode_gaussian, *sent, push_rows=push_rows_plainly),
        ],
        f"decode {count:,} symbols": [
            partial(decode_gaussian, *coded),
            partial(decode_gaussian, *coded, pop_rows=pop_rows_plainly),
        ],
        f"encode a file of {len(file):,} bytes": [partial(encode, model)],
        f"decode a file of {len(file):,} bytes": [partial(decode, file)],
        "training step of `tiny`, stage 4": [trainer.step],
    }
    functions = {(what, i): f for what, both in places.items() for i, f in enumerate(both)}
    times, rows = alternate(functions, REPEATS), []
    for what, (_, *twin) in places.items():
        row = {"what": what, "ms": times[what, 0].median}
        if twin:
            row["twin_ms"] = times[what, 1].median
            row["ratio"] = row["twin_ms"] / row["ms"]
        rows.append(row)
    parts = [{"what": f"  {key}", "ms": ms} for key, ms in by_equation(trainer.step).items()]
    stretch = stretch_of([one._asdict() for one in times.values()])
    return {"arithmetic": arithmetic(), "rows": [*rows, *parts], "stretch": stretch}


def to_text(result):
    """The benchmark as text."""
    note = (
        "Below the step are its equations, forward and backward; watching them adds a little to "
        "each. What remains is Adam and what joins the equations."
    )
    return "\n".join(
        [
            *text_table(COLUMNS, result["rows"]),
            note,
            f"{result['arithmetic']}.",
            disturbance(result["stretch"]),
        ]
    ).rstrip()
