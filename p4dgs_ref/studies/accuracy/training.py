"""Study 5, training: five knobs of a training against PSNR, bytes and seconds.

They are the iterations, the anchors, the width of the deformation network, the share of anchors
that is rated, and the seed.
"""

from contextlib import nullcontext

import numpy as np

from ...equations import anchor_rate, hash_rate, likelihood, rate_loss
from ...model import Context, split
from ...scenes import load_scene
from ...training import objective
from .diagram import Axes, Finding, at, select, table, work_precision
from .fits import TEST_VIEWS, judge, reduced, sampled, train
from .timing import replaced

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
    rate, full = SampledRate(share, seed), objective.rate_backward
    return replaced(
        objective,
        rate_forward=rate.forward,
        rate_backward=lambda saved, bar, design: rate.backward(saved, bar, design, full),
    )


def plan(quick):
    """The preset of the common point, and [(method, knob, preset, share, seed)] of all runs."""
    base, seeds = (reduced(120), range(2)) if quick else (reduced(950), range(3))
    iterations = (60, 240) if quick else (240, 475, 1900, 3800)
    anchors, widths = ((100,), (32,)) if quick else ((50, 100, 400), (16, 32, 128, 192))
    return base, [
        *(("seeds", seed, base, 1.0, seed) for seed in seeds),
        *(("iterations", n, reduced(n), 1.0, 0) for n in iterations),
        *(("anchors", A, base._replace(anchors=A), 1.0, 0) for A in anchors),
        *(("deformation width", W, base._replace(deformation=(W, W)), 1.0, 0) for W in widths),
        *(("anchors rated", share, base, share, 0) for share in SHARES[1:]),
    ]


def measure(quick, progress):
    """Rows of every run, with the common point in every line, and that point's iterations."""
    scene, rows = load_scene("bouncing"), []
    base, runs = plan(quick)
    for method, knob, preset, share, seed in runs:
        progress(f"training: {method} {knob}")
        with rated(share) if share < 1 else nullcontext():
            fit = train(scene, preset, seed, rated_share=share)
        rows.append(
            {
                "method": method,
                "knob": knob,
                "iterations": preset.iterations,
                "seed": seed,
                "share": share,
                "seconds": fit.seconds,
                **judge(fit.model, scene),
                **fit.work,
            }
        )
    common = {
        "iterations": base.iterations,
        "anchors": base.anchors,
        "deformation width": base.deformation[0],
        "anchors rated": 1.0,
    }
    middle = at(rows, method="seeds", knob=0)
    rows += [{**middle, "method": method, "knob": knob} for method, knob in common.items()]
    return sorted(rows, key=lambda row: (row["method"], row["knob"])), base.iterations


def run(folder, quick, progress):
    rows, middle = measure(quick, progress)
    title = f"`tiny` on `bouncing`, all lines meet at {middle} iterations\nreference: {TEST_VIEWS}"
    shown = [{**row, "knob": label(row)} for row in rows]
    for name, x, x_label in (
        ("training", "seconds", "training (processor seconds)"),
        ("training_bytes", "bytes", "file (bytes)"),
    ):
        axes = Axes(x, "psnr_db", x_label, "PSNR of the test views (dB)", y_scale="linear")
        work_precision(folder / f"{name}.png", shown, axes, title)
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
        "processor seconds of one training each, without the coder and the test views",
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
            f"{high['seconds'] / low['seconds']:.2g} times the seconds"
        )
    few, *_, every = select(rows, method="anchors rated")
    return (
        f"{len(seeds)} seeds of the common point differ by up to {max(seeds) - min(seeds):.2f} dB, "
        f"which is the scale for the other changes: {'; '.join(changes)}. Rating "
        f"{100 * few['share']:g} % of the anchors instead of all evaluates Eq. (11) "
        f"{few['rated_symbols']:,} instead of {every['rated_symbols']:,} times, takes "
        f"{few['seconds']:.3g} s instead of {every['seconds']:.3g} s and changes the result by "
        f"{difference(few, every)}."
    )


def difference(row, other):
    """The difference of two results in decibels and bytes."""
    psnr, size = (row[key] - other[key] for key in ("psnr_db", "bytes"))
    return f"{psnr:+.2f} dB and {size:+,} bytes"
