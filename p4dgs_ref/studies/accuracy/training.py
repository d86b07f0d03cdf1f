"""Study 5, training: iterations, anchors, deformation width and the share of rated anchors against PSNR, bytes, seconds."""

import numpy as np

from ...equations import anchor_rate, hash_rate, likelihood, rate_loss
from ...model import Context, split
from ...scenes import load_scene
from ...training import objective
from .diagram import Axes, Finding, at, figure, finish, legend, lines, table
from .fits import judge, reduced, sampled, train
from .timing import replaced

SHARES = (1.0, 0.25, 0.05)  # of anchors that an iteration rates; HAC rates 5 %


class SampledRate:
    """The rate of a random share of the anchors, scaled up to all of them: the stand-ins of `objective`'s two functions.

    The expectation over draws is the full rate and the full gradient; context and rendering still take every anchor.
    """

    def __init__(self, share, seed=0):
        self.share, self.rng = share, np.random.default_rng(seed)

    def forward(self, noisy, ctx, grids, mask, design):
        """Eqs. (11), (13), (14), (17) as `objective.rate_forward`, on some rows."""
        A = len(noisy)
        rows = np.sort(self.rng.choice(A, sampled(A, self.share), replace=False))
        chosen = Context(*(a[rows] for a in ctx))
        bits, res_bits = likelihood.forward(
            noisy[rows], chosen.mu, chosen.sigma, np.repeat(chosen.q, design.widths, axis=1)
        )
        f, s, l, O = split(bits.bits, design)
        anchors, res_a = anchor_rate.forward(f, O, l, s, mask[rows])
        grid, res_h = hash_rate.forward(grids)
        out, res = rate_loss.forward(
            anchors.R_anchor * noisy.dtype.type(A / len(rows)), grid.R_hash, noisy.size
        )
        return out, ((res_bits, res_a, res_h, res), rows, A)

    def backward(self, res, L_rate_bar, design, full):
        """`full` is objective's own backward: on the rows, then scaled and put back among zeros."""
        parts, rows, A = res
        *per_anchor, grids = full(parts, L_rate_bar, design)
        spread = []
        for values in per_anchor:
            whole = np.zeros((A, values.shape[1]), values.dtype)
            whole[rows] = values * values.dtype.type(A / len(rows))
            spread.append(whole)
        return *spread, grids


def rated(share, seed=0):
    """The context in which training rates only a share of the anchors in each iteration."""
    rate, full = SampledRate(share, seed), objective.rate_backward
    return replaced(
        objective,
        rate_forward=rate.forward,
        rate_backward=lambda res, bar, design: rate.backward(res, bar, design, full),
    )


def plan(quick):
    """[(method, knob, preset, share, seed)]: the middle of all lines is the same point, with several seeds."""
    middle = 120 if quick else 950
    base, seeds = reduced(middle), range(2 if quick else 3)
    iterations = (60, 240) if quick else (240, 475, 1900, 3800)
    anchors, widths = ((100,), (32,)) if quick else ((50, 100, 400), (16, 32, 128, 192))
    runs = [("seeds", seed, base, 1.0, seed) for seed in seeds]
    runs += [("iterations", n, reduced(n), 1.0, 0) for n in iterations]
    runs += [("anchors", A, base._replace(anchors=A), 1.0, 0) for A in anchors]
    runs += [("deformation width", W, base._replace(deformation=(W, W)), 1.0, 0) for W in widths]
    runs += [("anchors rated", share, base, share, 0) for share in SHARES[1:]]
    return base, runs


def measure(quick, progress):
    """Rows of every run, and the middle point repeated in every line: (rows, iterations of the middle)."""
    scene, rows = load_scene("bouncing"), []
    base, runs = plan(quick)
    for method, knob, preset, share, seed in runs:
        progress(f"training: {method} {knob}")
        if share < 1:
            with rated(share):
                fit = train(scene, preset, seed, rated_share=share)
        else:
            fit = train(scene, preset, seed)
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
    middle = at(rows, method="seeds", knob=0)
    rows += [
        {**middle, "method": method, "knob": knob}
        for method, knob in (
            ("iterations", base.iterations),
            ("anchors", base.anchors),
            ("deformation width", base.deformation[0]),
            ("anchors rated", 1.0),
        )
    ]
    return sorted(rows, key=lambda row: (row["method"], row["knob"])), base.iterations


def run(folder, quick, progress):
    rows, middle = measure(quick, progress)
    files = [table(folder, "training", rows)]
    title = f"`tiny` on `bouncing`, all lines meet at {middle} iterations; reference: the test views, from the decoded file"
    for name, x, label in (
        ("training", "seconds", "training (processor seconds)"),
        ("training_bytes", "bytes", "file (bytes)"),
    ):
        fig, (ax,) = figure()
        shown = [
            {
                **row,
                "knob": ""
                if row["method"] == "seeds"
                else f"{row['knob']:g}"
                if row["method"] != "anchors rated"
                else f"{100 * row['knob']:g} %",
            }
            for row in rows
        ]
        lines(ax, shown, Axes(x, "psnr_db", label, "PSNR of the test views (dB)", "log", "linear"))
        legend(ax)
        finish(fig, folder / f"{name}.png", title.replace("; ", "\n"))
    figures = [
        ("training.png", "PSNR against seconds; every line changes one thing."),
        ("training_bytes.png", "The same trainings, PSNR against bytes."),
    ]
    return Finding(
        "training",
        "Training",
        "the test views of `bouncing`, from the decoded file",
        figures,
        files,
        read(rows),
        "processor seconds of one training each (the coder's and the test views' left out)",
    )


def read(rows):
    """What the numbers say."""

    def ends(method):
        line = sorted((row for row in rows if row["method"] == method), key=lambda row: row["knob"])
        return line[0], line[-1]

    seeds = [row["psnr_db"] for row in rows if row["method"] == "seeds"]
    sentences = []
    for method, unit in (
        ("iterations", "iterations"),
        ("anchors", "anchors"),
        ("deformation width", "wide deformation layers"),
    ):
        low, high = ends(method)
        sentences.append(
            f"from {low['knob']} to {high['knob']} {unit}: {high['psnr_db'] - low['psnr_db']:+.2f} dB, "
            f"{high['bytes'] - low['bytes']:+,} bytes, {high['seconds'] / low['seconds']:.2g} times the seconds"
        )
    few, all_ = ends("anchors rated")
    return (
        f"{len(seeds)} seeds of the common point spread over {max(seeds) - min(seeds):.2f} dB, the yardstick for what follows. "
        + "; ".join(sentences).replace("from", "From", 1)
        + f". Rating {100 * few['share']:g} % of the anchors instead of all "
        f"evaluates Eq. (11) {few['rated_symbols']:,} instead of {all_['rated_symbols']:,} times, takes "
        f"{few['seconds']:.3g} s instead of {all_['seconds']:.3g} s and moves the result by "
        f"{few['psnr_db'] - all_['psnr_db']:+.2f} dB and {few['bytes'] - all_['bytes']:+,} bytes."
    )
