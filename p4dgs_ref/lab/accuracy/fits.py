"""Short trainings for the studies: `tiny` with shorter stages, with its work counted."""

from contextlib import nullcontext
from typing import NamedTuple

import numpy as np

from ...codec.file import decode, encode
from ...model import ANCHOR_NETWORKS, CONTEXT_NETWORKS
from ...report.evaluate import evaluate
from ...report.inspect import components, ledger
from ...training.presets import TINY
from ...training.trainer import Trainer

ATTRIBUTES = ("features", "scales", "offset_scales", "offsets")  # sections of the file
TEST_VIEWS = "the test views of `bouncing`, rendered from the decoded file"


class Fit(NamedTuple):
    model: object
    work: dict  # counted over all iterations: multiply_adds, rated_symbols


def reduced(iterations, **changes):
    """`tiny` for that many iterations: everything counted in iterations shrinks alike."""
    share = iterations / TINY.iterations
    ends = tuple(round(share * end) for end in TINY.stage_ends[:3])
    shorter = dict(
        stage_ends=(*ends, iterations),
        decay_from=round(share * TINY.decay_from),
        mask_from=ends[2],
        grow_from=round(share * TINY.grow_from),
        grow_every=max(20, round(share * TINY.grow_every)),
        grow_until=round(share * TINY.grow_until),
    )
    return TINY._replace(**{**shorter, **changes})


def multiply_adds(design, names, rows):
    """Multiply-adds of some networks for that many rows, forward and both products backward."""
    layers = design.layers()
    return 3 * rows * sum(I * J for name in names if name in layers for I, J in layers[name])


def train(scene, preset, seed=0, prepare=None, rated_share=1.0):
    """Train without pictures or checkpoints; `prepare(trainer)` may change it before it starts."""
    trainer, work = Trainer(scene, preset, seed), dict(multiply_adds=0, rated_symbols=0)
    if prepare:
        prepare(trainer)

    def count(trainer, losses, seen, view, ms):
        A, stage, design = len(seen.alpha), preset.stage(trainer.iteration - 1), trainer.design
        work["multiply_adds"] += multiply_adds(design, ANCHOR_NETWORKS, A)
        if stage >= 3:
            work["multiply_adds"] += multiply_adds(design, ("psi_d",), len(seen.index))
        if stage == 4:
            work["multiply_adds"] += multiply_adds(design, CONTEXT_NETWORKS, A)
            work["rated_symbols"] += sampled(A, rated_share) * sum(design.widths)

    with np.errstate(all="ignore"):  # the trainer itself looks for overflows
        model = trainer.run(count)
    return Fit(model, work)


def step_at(scene, preset, stage, prepare=None, inside=nullcontext):
    """A function that does the first step of a stage again and again, `inside()` a context."""
    trainer = Trainer(scene, preset._replace(grow_every=10**9))  # the anchors stay as they are
    if prepare:
        prepare(trainer)

    def step():
        trainer.iteration = (0, *preset.stage_ends)[stage - 1]
        with inside():
            trainer.step()

    return step


def sampled(A, share):
    """How many of A anchors a share of them is: at least one."""
    return max(1, round(share * A))


def judge(model, scene):
    """The model's file, decoded again, on the test views: bytes, bytes by kind, decibels."""
    data = encode(model)
    metrics, sizes = evaluate(decode(data), scene)[0], components(data)
    coded = [row for row in ledger(data) if row["name"] in (*ATTRIBUTES, "hash_grid")]
    return {
        "psnr_db": metrics["psnr_db"],
        "bytes": len(data),
        "attribute_bytes": sum(sizes[name] for name in ATTRIBUTES),
        "grid_bytes": sizes["hash_grid"],
        "coded_bytes": sum(row["bytes"] for row in coded),
        "estimated_bytes": round(sum(row["estimate_bytes"] for row in coded)),
        "network_bytes": sum(n for name, n in sizes.items() if name.endswith(("mlp", "mlps"))),
        "anchors": metrics["anchors"],
    }
