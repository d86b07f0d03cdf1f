"""Study 6, hash grid: levels and table size against the bytes that the context saves.

One model is trained and its attributes are kept. For every grid, a new context (grid and psi_p)
learns to predict them at fixed steps Q_0, and the file is written. The bytes that the context saves
are measured in this file, against one mean and one deviation per channel with the same coder.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from ...codec.file import encode
from ...codec.quantise import quantise
from ...equations import hash_grid, hash_rate, likelihood
from ...equations.prior import layout
from ...model import context, context_backward, join
from ...report.inspect import components
from ...report.jobs import in_processes
from ...scenes import load_scene
from ...training.adam import Adam
from ...training.parameters import Parameters, random_layers
from ..clock import alternate, compare, stretch_of
from .diagram import (
    Axes,
    Finding,
    figure,
    finish,
    legend_below,
    lines,
    table,
    unfold,
    work_precision,
)
from .fits import ATTRIBUTES, multiply_adds, reduced, train
from .quantisation import fixed

PLANES = ("xy", "xz", "yz")
LEVELS = {
    1: (("xyz", 8),),
    2: (("xyz", 4), ("xyz", 8)),
    4: (("xyz", 8), *((plane, 16) for plane in PLANES)),
    8: (("xyz", 8), ("xyz", 16), *((plane, res) for res in (16, 32) for plane in PLANES)),
}
COMMON = LEVELS[4], 512  # the grid over numbers of anchors
LEARNING_RATE = 0.01
LEAST_DEVIATION = 0.05  # of a channel, in steps: a constant channel still has a finite prior


class ContextFit:
    """A context that learns to predict fixed symbols: Eqs. (9), (12), (11), (14) and Adam."""

    def __init__(self, model, q, levels, table_size, seed=0):
        self.design = model.design._replace(grid=levels, table=(table_size, table_size))
        self.values, self.kept = join(q.model.anchors), q.kept
        self.steps = np.repeat(q.context.q, model.design.widths, axis=1)
        rng, shapes = np.random.default_rng(seed), self.design.layers()
        arrays = random_layers(rng, "psi_p", shapes["psi_p"])
        set_prior(
            arrays[f"psi_p.b{len(self.design.context)}"],
            self.design,
            channel_moments(self.values, self.kept, self.steps),
        )
        for i, shape in enumerate(self.design.levels()):
            arrays[f"grid.{i}"] = rng.uniform(-1e-4, 1e-4, shape)
        self.p = Parameters(arrays, float)
        self.adam = Adam(self.p)
        # psi_q is zero and gives Q_0: the symbols are given, so no steps are needed.
        self.networks = {"psi_p": self.p.network("psi_p"), "psi_q": zeros_of(shapes["psi_q"])}
        box = [corner.astype(float) for corner in model.box]
        tables = [T for T, _ in self.design.levels()]
        self.located = hash_grid.locate(q.model.anchors.x_a, *box, levels, tables)

    def step(self):
        """One iteration; returns the bits of all kept symbols and of the grid."""
        grids, count = self.p.listed("grid"), self.kept.sum()
        ctx, saved = context(self.design, self.networks, grids, self.located)
        bits, saved_bits = likelihood.forward(self.values, ctx.mu, ctx.sigma, self.steps)
        (R_hash, _, _), saved_rate = hash_rate.forward(grids)
        bars = likelihood.backward(saved_bits, self.kept / count)
        grids_bar, networks = context_backward(
            saved, np.zeros_like(ctx.q), bars["mu"], bars["sigma"]
        )
        rate_bar = hash_rate.backward(saved_rate, np.float64(1 / count))["grids"]
        gradients = self.p.zeros()
        gradients.fill("psi_p", networks["psi_p"])
        for whole, through_context, through_rate in zip(
            gradients.listed("grid"), grids_bar, rate_bar
        ):
            whole[...] = through_context + through_rate
        self.adam.step(self.p, gradients, lambda name: LEARNING_RATE)
        return float(bits[self.kept].sum()), float(R_hash)


def zeros_of(shapes):
    """The weights and biases of a network, all zero."""
    return [np.zeros(shape) for shape in shapes], [np.zeros(shape[1]) for shape in shapes]


def set_prior(last_bias, design, moments):
    """Make psi_p's last bias predict these means and log deviations."""
    mu, raw = layout(design.widths)
    last_bias[mu], last_bias[raw] = moments


def channel_moments(values, kept, steps):
    """Mean and log deviation of every channel over the coded values: the prior without context."""
    count = np.maximum(kept.sum(axis=0), 1)
    mu = np.where(kept, values, 0).sum(axis=0) / count
    var = (np.where(kept, values - mu, 0) ** 2).sum(axis=0) / count
    return mu, 0.5 * np.log(np.maximum(var, (LEAST_DEVIATION * steps[0]) ** 2))


def written(model, design, networks, grids):
    """Bytes of a file with another context: attributes, grid, psi_p and psi_q together."""
    changed = replace(model, design=design, networks={**model.networks, **networks}, grids=grids)
    sizes = components(encode(changed))
    return {
        "attribute_bytes": sum(sizes[name] for name in ATTRIBUTES),
        "grid_bytes": sizes["hash_grid"],
        "mlp_bytes": sizes["context_mlps"],
    }


def without_context(model, q):
    """The file with one Gaussian per channel: psi_p has zero weights, only its last bias counts."""
    design = model.design
    weights, biases = zeros_of(design.layers()["psi_p"])
    steps = np.repeat(q.context.q, design.widths, axis=1)
    set_prior(biases[-1], design, channel_moments(join(q.model.anchors), q.kept, steps))
    return written(model, design, {"psi_p": (weights, biases)}, model.grids)


def learnt(model, q, levels, table_size, steps):
    """A context after some steps, and what it saves and costs in the file."""
    fit = ContextFit(model, q, levels, table_size)
    for _ in range(steps):
        fit.step()
    alone = without_context(model, q)["attribute_bytes"]
    found = written(model, fit.design, fit.networks, fit.p.listed("grid"))
    saved = alone - found["attribute_bytes"]
    # Without a context, the mean and deviation of every channel are stored as float16 instead.
    cost = found["grid_bytes"] + found["mlp_bytes"] - 4 * sum(model.design.widths)
    about = {"alone_bytes": alone, "saved_bytes": saved, "cost_bytes": cost}
    return fit, {"anchors": len(q.kept), **found, **about, "net_bytes": saved - cost}


def with_anchors(task):
    """The row of a model with that many anchors, whose context has the grid COMMON."""
    anchors, iterations, steps = task
    model = fixed(train(load_scene("bouncing"), reduced(iterations, anchors=anchors)).model)
    return learnt(model, quantise(model), *COMMON, steps)[1]


def pays_from(rows):
    """The anchors from which the context saves more than it costs.

    Beyond the most anchors measured, it is taken to save as much per anchor as there.
    """
    most = rows[-1]
    if most["net_bytes"] < 0:
        return most["anchors"] * most["cost_bytes"] / max(most["saved_bytes"], 1e-9)
    return float(np.interp(0, *zip(*((row["net_bytes"], row["anchors"]) for row in rows))))


def measure(quick, progress, jobs):
    """Rows of every grid, rows of every number of anchors, and how often times were repeated."""
    iterations, steps = (120, 40) if quick else (950, 400)
    levels, sizes = ((1, 4), (64, 512)) if quick else (LEVELS, (32, 128, 512, 2048))
    counts = (50, 100) if quick else (100, 200, 400, 800, 1600, 3200)
    by_anchors = []
    for row in in_processes(with_anchors, [(A, iterations, steps) for A in counts], jobs):
        by_anchors.append(row)
        progress(f"hash grid: {len(by_anchors)} of {len(counts)} numbers of anchors")
    progress("hash grid: the model whose attributes are kept")
    model = fixed(train(load_scene("bouncing"), reduced(iterations)).model)
    q, rows, runs = quantise(model), [], {}
    for count, size in product(levels, sizes):
        progress(f"hash grid: {count} levels, {size} entries")
        fit, found = learnt(model, q, LEVELS[count], size, steps)
        rows.append(
            {
                "method": f"{count} level{'s' * (count > 1)}",
                "knob": size,
                "levels": count,
                "entries": sum(T * F for T, F in fit.design.levels()),
                **found,
                "multiply_adds": multiply_adds(fit.design, ("psi_p",), len(fit.values)),
                "reads": fit.located.nnz,
                "symbols": int(fit.kept.sum()),
            }
        )
        runs[count, size] = fit.step
    repeats = 3 if quick else 7
    times = alternate(runs, repeats)
    rows = [{**row, **times[row["levels"], row["knob"]].columns()} for row in rows]
    return rows, sorted(by_anchors, key=lambda row: row["anchors"]), repeats


def run(folder, quick, progress, jobs=1):
    rows, by_anchors, repeats = measure(quick, progress, jobs)
    reference = "one Gaussian per channel, the same symbols and coder"
    title = (
        f"{rows[0]['anchors']} anchors with {rows[0]['alone_bytes']:,} bytes of attributes, "
        f"entries of a level's table labelled\nreference: {reference}"
    )
    axes = Axes(
        "grid_bytes",
        "net_bytes",
        "hash grid in the file (bytes)",
        "bytes saved, less grid and networks",
        y_scale="linear",
    )
    time = axes._replace(x="ms", x_label="one iteration of the context (processor ms)")
    for name, shown in (("hash_grid", axes), ("hash_grid_time", time)):
        fig, (ax,) = figure()
        lines(ax, rows, shown)
        ax.axhline(0, linestyle=":", color="gray")
        legend_below(fig, ax, 4)
        finish(fig, folder / f"{name}.png", title)
    draw_anchors(folder / "hash_grid_anchors.png", by_anchors)
    return Finding(
        "hash_grid",
        "Hash grid",
        reference,
        [
            ("hash_grid.png", "Bytes saved in the whole file against the grid's own bytes."),
            ("hash_grid_time.png", "Bytes saved in the whole file against time."),
            ("hash_grid_anchors.png", "What the context saves and costs, over the anchors."),
        ],
        [table(folder, "hash_grid", rows), table(folder, "hash_grid_anchors", by_anchors)],
        read(rows, by_anchors),
        f"median and quartiles of {repeats} alternating repeats of one iteration of the context",
        stretch_of(rows),
    )


def draw_anchors(path, rows):
    """Saved and spent bytes over the number of anchors; the crossing is where the context pays."""
    kinds = {"saved by the context": "saved_bytes", "hash grid and context networks": "cost_bytes"}
    axes = Axes("anchors", "value", "anchors of the file", "bytes", y_scale="linear")
    levels, size = COMMON
    title = f"a context of {len(levels)} levels of up to {size} entries\n{says(rows)}"
    shown = [{**row, "knob": row["anchors"]} for row in unfold(rows, kinds)]
    work_precision(path, shown, axes, title, label=False)


def says(rows):
    """From how many anchors on the context pays, in words."""
    anchors = pays_from(rows)
    how = ", extrapolated" if anchors > rows[-1]["anchors"] else ""
    return f"the context pays from about {float(f'{anchors:.2g}'):,.0f} anchors on{how}"


def read(rows, by_anchors):
    """What the numbers say."""
    best, worst = (choose(rows, key=lambda row: row["net_bytes"]) for choose in (max, min))
    most = max(rows, key=lambda row: row["saved_bytes"])
    few, many = (choose(rows, key=lambda row: row["reads"]) for choose in (min, max))
    names = [f"an iteration with {row['reads']:,} reads of the grid" for row in (many, few)]
    times = compare(names[0], many, names[1], few)
    return (
        f"One Gaussian per channel needs {most['alone_bytes']:,} bytes for {most['symbols']:,} "
        f"symbols of {most['anchors']} anchors. The context that saves most, {most['method']} of "
        f"{most['knob']} entries, saves {most['saved_bytes']:,} bytes; its grid takes "
        f"{most['grid_bytes']:,} and its networks {most['mlp_bytes']:,}. In the whole file, "
        f"{best['method']} of {best['knob']} entries is the best with {best['net_bytes']:+,} bytes "
        f"and {worst['method']} of {worst['knob']} entries the worst with "
        f"{worst['net_bytes']:+,}. Measured with {by_anchors[0]['anchors']} to "
        f"{by_anchors[-1]['anchors']} anchors, {says(by_anchors)}. {times}"
    )
