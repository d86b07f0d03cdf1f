"""Study 5, training: five knobs of a training against PSNR, bytes and seconds.

They are the iterations, the anchors, the width of the deformation network, the share of anchors
that is rated, and the seed.
"""

from contextlib import nullcontext
from functools import partial
from typing import NamedTuple

import numpy as np

from ...equations import anchor_rate, hash_rate, likelihood, rate_loss
from ...model import Context, split
from ...scenes import load_scene
from ...training import objective
from ...training.presets import Preset
from ..bench import replaced
from ..clock import Times, alternate, can_tell, stated, stretch_of
from ..jobs import in_processes
from .diagram import Axes, Finding, at, select, table, work_precision
from .fits import TEST_VIEWS, judge, reduced, sampled, step_at, train

SHARES = (1.0, 0.25, 0.05)  # of the anchors that an iteration rates; HAC rates 5 %


class SampledRate:
    """The rate of a random share of the anchors, scaled up to all of them.

    It stands for `rate_forward` and `rate_backward` of the objective. Its expectation is the full
    rate with the full gradient. The context and the rendering still take every anchor.
    """

    def __init__(self, share, seed=0):
        self.share, self.rng = share, np.random.default_rng(seed)

    def forward(self, noisy, ctx, grids, mask, design):
        """Eqs. (11), (13), (14), (17) on some rows."""
        A = len(noisy)
        rows = np.sort(self.rng.choice(A, sampled(A, self.share), replace=False))
        chosen = Context(*(a[rows] for a in ctx))
        q = np.repeat(chosen.q, design.widths, axis=1)
        bits, saved_bits = likelihood.forward(noisy[rows], chosen.mu, chosen.sigma, q)
        R_anchor, saved_anchors = anchor_rate.forward(*split(bits, design), mask[rows])
        (R_hash, _, _), saved_grid = hash_rate.forward(grids)
        scaled = R_anchor * noisy.dtype.type(A / len(rows))
        output, saved = rate_loss.forward(scaled, R_hash, noisy.size)
        return output, ((saved_bits, saved_anchors, saved_grid, saved), rows, A)

    def backward(self, saved, L_rate_bar, design, full):
        """`full`, the objective's own backward, on the rows; then scaled and put among zeros."""
        parts, rows, A = saved
        *per_anchor, grids = full(parts, L_rate_bar, design)
        whole = [np.zeros((A, values.shape[1]), values.dtype) for values in per_anchor]
        for zeros, values in zip(whole, per_anchor):
            zeros[rows] = values * values.dtype.type(A / len(rows))
        return *whole, grids


def rated(share, seed=0):
    """A `with` block in which training rates only a share of the anchors in each iteration."""
    if share == 1:
        return nullcontext()
    rate, full = SampledRate(share, seed), objective.rate_backward
    return replaced(
        objective,
        rate_forward=rate.forward,
        rate_backward=lambda saved, bar, design: rate.backward(saved, bar, design, full),
    )


class Run(NamedTuple):
    """One training: which knob has which value, and all that follows from it."""

    method: str
    knob: object
    preset: Preset
    share: float = 1.0
    seed: int = 0


def plan(quick):
    """The preset of the common point, and all runs."""
    base, seeds = (reduced(120), range(2)) if quick else (reduced(950), range(3))
    iterations = (60, 240) if quick else (240, 475, 1900, 3800)
    anchors, widths = ((100,), (32,)) if quick else ((50, 100, 400), (16, 32, 128, 192))
    return base, [
        *(Run("seeds", seed, base, seed=seed) for seed in seeds),
        *(Run("iterations", n, reduced(n)) for n in iterations),
        *(Run("anchors", A, base._replace(anchors=A)) for A in anchors),
        *(Run("deformation width", W, base._replace(deformation=(W, W))) for W in widths),
        *(Run("anchors rated", share, base, share) for share in SHARES[1:]),
    ]


def train_one(run):
    """The row of a run without its time, and the trainer's last state."""
    scene = load_scene("bouncing")
    with rated(run.share):
        fit = train(scene, run.preset, run.seed, rated_share=run.share)
    row = {
        "method": run.method,
        "knob": run.knob,
        "iterations": run.preset.iterations,
        "seed": run.seed,
        "share": run.share,
        **judge(fit.model, scene),
        **fit.work,
    }
    return row, fit.state


def seconds(runs, states):
    """Columns of the processor seconds of every run.

    Steps of all trained models, in every stage, are timed in turn; a stage takes as many of them as
    it has iterations.
    """
    scene, steps = load_scene("bouncing"), {}
    for i, (run, state) in enumerate(zip(runs, states)):
        for stage in range(1, 5):
            step = step_at(scene, run.preset, state, stage)
            steps[i, stage] = partial(rated_step, run.share, step)
    with np.errstate(all="ignore"):
        times, found = alternate(steps, 5), []
    for i, run in enumerate(runs):
        lengths = np.diff([0, *run.preset.stage_ends]) / 1e3
        total = lengths @ [times[i, stage][:3] for stage in range(1, 5)]
        stretch = float(np.median([times[i, stage].stretch for stage in range(1, 5)]))
        found.append(Times(*map(float, total), stretch).columns("seconds"))
    return found


def rated_step(share, step):
    with rated(share):
        step()


def measure(quick, progress, jobs):
    """Rows of every run, with the common point in every line, and that point's iterations."""
    (base, runs), rows, states = plan(quick), [], []
    for row, state in in_processes(train_one, runs, jobs):
        rows.append(row)
        states.append(state)
        progress(f"training: {len(rows)} of {len(runs)} trainings")
    progress("training: times of steps")
    rows = [{**row, **times} for row, times in zip(rows, seconds(runs, states))]
    common = {
        "iterations": base.iterations,
        "anchors": base.anchors,
        "deformation width": base.deformation[0],
        "anchors rated": 1.0,
    }
    middle = at(rows, method="seeds", knob=0)
    rows += [{**middle, "method": method, "knob": knob} for method, knob in common.items()]
    return sorted(rows, key=lambda row: (row["method"], row["knob"])), base.iterations


def run(folder, quick, progress, jobs=1):
    rows, middle = measure(quick, progress, jobs)
    title = f"`tiny` on `bouncing`, all lines meet at {middle} iterations\nreference: {TEST_VIEWS}"
    shown = [{**row, "knob": label(row)} for row in rows]
    for name, x, x_label in (
        ("training", "seconds", "training (processor seconds, median and quartiles)"),
        ("training_bytes", "bytes", "file (bytes)"),
    ):
        axes = Axes(x, "psnr_db", x_label, "PSNR of the test views (dB)", y_scale="linear")
        work_precision(folder / f"{name}.png", shown, axes, title, 3)
    return Finding(
        "training",
        "Training",
        TEST_VIEWS,
        [
            ("training.png", "PSNR against seconds; every line changes one knob."),
            ("training_bytes.png", "PSNR of the same trainings against bytes."),
        ],
        [table(folder, "training", rows)],
        read(rows),
        "processor seconds from steps of all trained models in all stages, timed in turn",
        stretch_of(rows),
    )


def label(row):
    """The text beside a point."""
    texts = {"seeds": "", "anchors rated": f"{100 * row['knob']:g} %"}
    return texts.get(row["method"], f"{row['knob']:g}")


def read(rows):
    """What the numbers say."""
    seeds = [row["psnr_db"] for row in select(rows, method="seeds")]
    changes = []
    for method, unit in (
        ("iterations", "iterations"),
        ("anchors", "anchors"),
        ("deformation width", "units in each deformation layer"),
    ):
        low, *_, high = select(rows, method=method)
        changes.append(
            f"from {low['knob']} to {high['knob']} {unit}: {difference(high, low)}, "
            f"{instead(high, low)}"
        )
    few, *_, every = select(rows, method="anchors rated")
    return (
        f"{len(seeds)} seeds of the common point differ by up to {max(seeds) - min(seeds):.2f} dB, "
        f"which is the scale for the other changes: {'; '.join(changes)}. Rating "
        f"{100 * few['share']:g} % of the anchors instead of all evaluates Eq. (11) "
        f"{few['rated_symbols']:,} instead of {every['rated_symbols']:,} times and changes "
        f"the result by {difference(few, every)}, {instead(few, every)}."
    )


def instead(row, other):
    """The times of two trainings in words."""
    times = stated(row, "seconds"), stated(other, "seconds")
    if can_tell(row, other, "seconds"):
        return f"{times[0]} instead of {times[1]}"
    return f"and we cannot tell whether it takes longer: {times[0]} and {times[1]}"


def difference(row, other):
    """The difference of two results in decibels and bytes."""
    psnr, size = (row[key] - other[key] for key in ("psnr_db", "bytes"))
    return f"{psnr:+.2f} dB and {size:+,} bytes"
