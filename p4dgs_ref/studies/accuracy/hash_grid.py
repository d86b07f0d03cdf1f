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
from ...scenes import load_scene
from ...training.adam import Adam
from ...training.parameters import Parameters, random_layers
from ..clock import alternate, compare, stretch_of
from ..inspect import components
from .diagram import Axes, Finding, figure, finish, legend_below, lines, table, work_precision
from .fits import ATTRIBUTES, multiply_adds, reduced, train
from .quantisation import fixed

PLANES = ("xy", "xz", "yz")
LEVELS = {
    1: (("xyz", 8),),
    2: (("xyz", 4), ("xyz", 8)),
    4: (("xyz", 8), *((plane, 16) for plane in PLANES)),
    8: (("xyz", 8), ("xyz", 16), *((plane, res) for res in (16, 32) for plane in PLANES)),
}
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


def measure(quick, progress):
    """Rows of every grid, the file without context, and how often times were repeated."""
    iterations, steps = (120, 40) if quick else (950, 400)
    levels, sizes = ((1, 4), (64, 512)) if quick else (LEVELS, (32, 128, 512, 2048))
    progress("hash grid: the model whose attributes are kept")
    model = fixed(train(load_scene("bouncing"), reduced(iterations)).model)
    q = quantise(model)
    alone, rows, runs = without_context(model, q), [], {}
    for count, size in product(levels, sizes):
        progress(f"hash grid: {count} levels, {size} entries")
        fit = ContextFit(model, q, LEVELS[count], size)
        for _ in range(steps):
            fit.step()
        in_file = written(model, fit.design, fit.networks, fit.p.listed("grid"))
        rows.append(
            {
                "method": f"{count} level{'s' * (count > 1)}",
                "knob": size,
                "levels": count,
                "entries": sum(T * F for T, F in fit.design.levels()),
                **in_file,
                "saved_bytes": alone["attribute_bytes"] - in_file["attribute_bytes"],
                "multiply_adds": multiply_adds(fit.design, ("psi_p",), len(fit.values)),
                "reads": fit.located.nnz,
                "symbols": int(fit.kept.sum()),
            }
        )
        runs[count, size] = fit.step
    repeats = 3 if quick else 7
    times = alternate(runs, repeats)
    rows = [{**row, **times[row["levels"], row["knob"]].columns()} for row in rows]
    return rows, alone, repeats


def run(folder, quick, progress, jobs=1):
    rows, alone, repeats = measure(quick, progress)
    reference = "one Gaussian per channel, the same symbols and coder"
    title = (
        f"bytes saved of {alone['attribute_bytes']:,}, entries of a level's table labelled\n"
        f"reference: {reference}"
    )
    axes = Axes(
        "grid_bytes",
        "saved_bytes",
        "hash grid in the file (bytes)",
        "bytes that the context saves",
        y_scale="linear",
    )
    fig, (ax,) = figure()
    lines(ax, rows, axes)
    sizes = [row["grid_bytes"] for row in rows]
    bound = np.geomspace(min(sizes), max(sizes), 50)
    ax.plot(bound, bound, ":", color="gray", label="pays for the grid")
    legend_below(fig, ax, 3)
    finish(fig, folder / "hash_grid.png", title)
    work_precision(
        folder / "hash_grid_time.png",
        rows,
        axes._replace(x="ms", x_label="one iteration of the context (ms)"),
        title,
    )
    return Finding(
        "hash_grid",
        "Hash grid",
        reference,
        [
            ("hash_grid.png", "Bytes saved against the grid's own bytes."),
            ("hash_grid_time.png", "Bytes saved against time."),
        ],
        [table(folder, "hash_grid", rows)],
        read(rows, alone),
        f"median and quartiles of {repeats} alternating repeats of one iteration of the context",
        stretch_of(rows),
    )


def read(rows, alone):
    """What the numbers say."""
    net = [(row["saved_bytes"] - row["grid_bytes"], row) for row in rows]
    gain, best = max(net, key=lambda pair: pair[0])
    loss, worst = min(net, key=lambda pair: pair[0])
    most = max(rows, key=lambda row: row["saved_bytes"])
    few, many = (choose(rows, key=lambda row: row["reads"]) for choose in (min, max))
    names = [f"an iteration with {row['reads']:,} reads of the grid" for row in (many, few)]
    times = compare(names[0], many, names[1], few)
    return (
        f"One Gaussian per channel needs {alone['attribute_bytes']:,} bytes for "
        f"{rows[0]['symbols']:,} symbols. The context that saves most, {most['method']} of "
        f"{most['knob']} entries, saves {most['saved_bytes']:,} bytes, and its grid takes "
        f"{most['grid_bytes']:,}. Less the grid, {best['method']} of {best['knob']} entries is the "
        f"best with {gain:+,} bytes and {worst['method']} of {worst['knob']} entries the worst "
        f"with {loss:+,}; the context MLPs take another {best['mlp_bytes']:,} bytes. {times}"
    )
