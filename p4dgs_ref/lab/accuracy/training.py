"""Study 5, training: seven knobs of a training against PSNR, bytes and seconds.

They are the iterations, the anchors, the width of the deformation network, the share of anchors
that is rated, the weight of the rate, the precision, and the seed.
"""

from contextlib import nullcontext
from functools import partial
from typing import NamedTuple

import numpy as np

from ...equations import anchor_rate, hash_rate, likelihood, rate_loss
from ...equations.numerics import in_precision_of
from ...model import Context, split
from ...report.jobs import in_processes
from ...scenes import load_scene
from ...training import objective
from ...training.adam import Adam
from ...training.parameters import Parameters
from ...training.presets import Preset
from ..bench import replaced
from ..clock import Times, alternate, can_tell, stated, stretch_of
from .diagram import Axes, Finding, at, select, table, unfold, work_precision
from .fits import TEST_VIEWS, judge, reduced, sampled, step_at, train

SHARES = (1.0, 0.25, 0.05)  # of the anchors that an iteration rates; HAC rates 5 %


class SampledRate:
    """The rate of a random share of the anchors, scaled up to all of them.

    It stands for `rate_forward` and `rate_backward` of the objective. Its expectation is the full
    rate with the full gradient. The context and the rendering still take every anchor.
    """

    def __init__(self, share, seed=0):
        self.share, self.rng = share, np.random.default_rng(seed)

    def forward(self, noisy, ctx, grids, mask, design, R_networks=0.0):
        """Eqs. (11), (13), (14), (17) on some rows."""
        A = len(noisy)
        rows = np.sort(self.rng.choice(A, sampled(A, self.share), replace=False))
        chosen = Context(*(a[rows] for a in ctx))
        q = np.repeat(chosen.q, design.widths, axis=1)
        bits, saved_bits = likelihood.forward(noisy[rows], chosen.mu, chosen.sigma, q)
        R_anchor, saved_anchors = anchor_rate.forward(*split(bits, design), mask[rows])
        (R_hash, _, _), saved_grid = hash_rate.forward(grids)
        scaled = R_anchor * noisy.dtype.type(A / len(rows))
        R_rest = R_hash + in_precision_of(R_hash, R_networks)
        output, saved = rate_loss.forward(scaled, R_rest, noisy.size)
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
    prepare: object = None  # what `fits.train` does before the first step


def plan(quick):
    """The preset of the common point, and all runs."""
    base, seeds = (reduced(120), range(2)) if quick else (reduced(950), range(3))
    iterations = (60, 240) if quick else (240, 475, 1900, 3800)
    anchors, widths = ((100,), (32,)) if quick else ((50, 100, 400), (16, 32, 128, 192))
    weights = (1e-4, 1e-2) if quick else (0.0, 1e-4, 3e-4, 3e-3, 1e-2)
    return base, [
        *(Run("seeds", seed, base, seed=seed) for seed in seeds),
        *(Run("iterations", n, reduced(n)) for n in iterations),
        *(Run("anchors", A, base._replace(anchors=A)) for A in anchors),
        *(Run("deformation width", W, base._replace(deformation=(W, W))) for W in widths),
        *(Run("anchors rated", share, base, share) for share in SHARES[1:]),
        *(Run("λ_rate", value, base._replace(lambda_rate=value)) for value in weights),
        Run("precision", "float64", base, prepare=in_float64),
    ]


def in_float64(trainer):
    """Let a trainer compute in double precision."""
    trainer.adopt(Parameters(trainer.parameters.arrays, float))
    trainer.adam = Adam(trainer.parameters)
    trainer.settings = trainer.settings._replace(dtype="float64")


def train_one(run):
    """The row of a run, without its time."""
    scene = load_scene("bouncing")
    with rated(run.share):
        fit = train(scene, run.preset, run.seed, run.prepare, run.share)
    return {
        "method": run.method,
        "knob": run.knob,
        "iterations": run.preset.iterations,
        "seed": run.seed,
        "share": run.share,
        **judge(fit.model, scene),
        **fit.work,
    }


def seconds(runs):
    """Columns of the processor seconds of every run.

    Steps of all runs in all stages are timed in turn, at their first parameters; a stage takes as
    many of them as it has iterations.
    """
    scene, stages, found = load_scene("bouncing"), range(1, 5), []
    with np.errstate(all="ignore"):
        steps = {
            (run, stage): step_at(scene, run.preset, stage, run.prepare, partial(rated, run.share))
            for run in runs
            for stage in stages
        }
        times = alternate(steps, 5)
    for run in runs:
        lengths = np.diff([0, *run.preset.stage_ends])
        measured = np.array([times[run, stage] for stage in stages])
        *ms, _ = (lengths @ measured).tolist()
        found.append(Times(*ms, measured[:, 3].mean()).columns("seconds", 1e-3))
    return found


def measure(quick, progress, jobs):
    """Rows of every run, with the common point in every line, and that point's iterations."""
    (base, runs), rows = plan(quick), []
    for row in in_processes(train_one, runs, jobs):
        rows.append(row)
        progress(f"training: {len(rows)} of {len(runs)} trainings")
    progress("training: times of steps")
    rows = [{**row, **times} for row, times in zip(rows, seconds(runs))]
    common = {
        "iterations": base.iterations,
        "anchors": base.anchors,
        "deformation width": base.deformation[0],
        "anchors rated": 1.0,
        "λ_rate": base.lambda_rate,
        "precision": "float32",
    }
    middle = at(rows, method="seeds", knob=0)
    rows += [{**middle, "method": method, "knob": knob} for method, knob in common.items()]
    return sorted(rows, key=lambda row: (row["method"], row["knob"])), base.iterations


def run(folder, quick, progress, jobs=1):
    rows, middle = measure(quick, progress, jobs)
    title = f"`tiny` on `bouncing`, all lines meet at {middle} iterations\nreference: {TEST_VIEWS}"
    shown = [{**row, "knob": label(row)} for row in rows if row["method"] != "λ_rate"]
    for name, x, x_label in (
        ("training", "seconds", "training (processor seconds, median and quartiles)"),
        ("training_bytes", "bytes", "file (bytes)"),
    ):
        axes = Axes(x, "psnr_db", x_label, "PSNR of the test views (dB)", y_scale="linear")
        work_precision(folder / f"{name}.png", shown, axes, title, 3)
    draw_rate(folder / "training_rate.png", select(rows, method="λ_rate"))
    return Finding(
        "training",
        "Training",
        TEST_VIEWS,
        [
            ("training.png", "PSNR against seconds; every line changes one knob."),
            ("training_bytes.png", "PSNR of the same trainings against bytes."),
            ("training_rate.png", "λ_rate: PSNR against the coded bytes, estimated and real."),
        ],
        [table(folder, "training", rows)],
        read(rows),
        "processor seconds from steps of all runs in all stages, timed in turn at the start",
        stretch_of(rows),
    )


def label(row):
    """The text beside a point."""
    if row["method"] in ("seeds", "precision"):
        return row["knob"] if row["method"] == "precision" else ""
    return f"{100 * row['knob']:g} %" if row["method"] == "anchors rated" else f"{row['knob']:g}"


def draw_rate(path, rows):
    """PSNR over the bytes of attributes and grid: those of the loss and those of the file."""
    kinds = {"estimated by the loss": "estimated_bytes", "in the file": "coded_bytes"}
    shown = [{**row, "knob": f"{row['knob']:g}"} for row in unfold(rows, kinds)]
    label = "attributes and hash grid (bytes)"
    axes = Axes("value", "psnr_db", label, "PSNR of the test views (dB)", "linear", "linear")
    title = f"λ_rate (labelled), one training each\nreference: {TEST_VIEWS}"
    work_precision(path, shown, axes, title)


def read(rows):
    """What the numbers say."""
    seeds = [row["psnr_db"] for row in select(rows, method="seeds")]
    spread = max(seeds) - min(seeds)
    changes = []
    for method, unit in (
        ("iterations", "iterations"),
        ("anchors", "anchors"),
        ("deformation width", "units in each deformation layer"),
    ):
        low, *_, high = select(rows, method=method)
        changes.append(
            f"from {low['knob']} to {high['knob']} {unit}: {difference(high, low, spread)}, "
            f"{instead(high, low)}"
        )
    few, *_, every = select(rows, method="anchors rated")
    cheap, *_, dear = select(rows, method="λ_rate")
    single, double = select(rows, method="precision")
    return (
        f"{len(seeds)} seeds of the common point differ by up to {spread:.2f} dB, "
        f"which is the scale for the other changes: {'; '.join(changes)}. Rating "
        f"{100 * few['share']:g} % of the anchors instead of all evaluates Eq. (11) "
        f"{few['rated_symbols']:,} instead of {every['rated_symbols']:,} times and changes "
        f"the result by {difference(few, every, spread)}, {instead(few, every)}. Training in "
        f"float64 instead of float32 changes it by {difference(double, single, spread)}, "
        f"{instead(double, single)}. From λ_rate {cheap['knob']:g} to {dear['knob']:g}, the coded "
        f"bytes go from {cheap['coded_bytes']:,} to {dear['coded_bytes']:,} (the loss estimates "
        f"{cheap['estimated_bytes']:,} and {dear['estimated_bytes']:,}) and PSNR changes by "
        f"{dear['psnr_db'] - cheap['psnr_db']:+.2f} dB."
    )


def instead(row, other):
    """The times of two trainings in words."""
    times = stated(row, "seconds"), stated(other, "seconds")
    if can_tell(row, other, "seconds"):
        return f"{times[0]} instead of {times[1]}"
    return f"and we cannot tell whether it takes longer: {times[0]} and {times[1]}"


def difference(row, other, spread):
    """The difference of two results in decibels and bytes; `spread` is that of seeds alone."""
    psnr, size = (row[key] - other[key] for key in ("psnr_db", "bytes"))
    hidden = " (we cannot tell: seeds differ by more)" if abs(psnr) < spread else ""
    return f"{psnr:+.2f} dB{hidden} and {size:+,} bytes"
