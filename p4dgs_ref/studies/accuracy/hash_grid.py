"""Study 6, hash grid: levels and table size against the bits that the context saves, its side information and time.

A model is trained once and its attributes are held; for every grid a new context (grid, psi_p) learns to predict
them at fixed steps Q_0, and the file is written.  What the context saves is measured in bytes of that file against
one mean and one deviation per channel, coded by the same coder.
"""

from dataclasses import replace

import numpy as np

from ...codec.file import encode
from ...codec.inspect import components
from ...codec.quantise import quantise
from ...equations import hash_grid, hash_rate, likelihood
from ...equations.prior import layout
from ...model import context, context_backward, join
from ...scenes import load_scene
from ...training.adam import Adam
from ...training.parameters import Parameters, random_layers
from .diagram import Axes, Finding, figure, finish, legend, lines, table
from .fits import multiply_adds, reduced, train
from .quantisation import fixed
from .timing import alternate

ATTRIBUTES = ("features", "scales", "offset_scales", "offsets")
LEVELS = {
    1: (("xyz", 8),),
    2: (("xyz", 4), ("xyz", 8)),
    4: (("xyz", 8), ("xy", 16), ("xz", 16), ("yz", 16)),
    8: (
        ("xyz", 8),
        ("xyz", 16),
        *((plane, res) for res in (16, 32) for plane in ("xy", "xz", "yz")),
    ),
}
LEARNING_RATE = 0.01
LEAST_DEVIATION = 0.05  # of a channel, in steps: a constant channel still has a finite prior


class ContextFit:
    """A context that learns to predict fixed symbols: Eqs. (9), (12), (11), (14) and Adam."""

    def __init__(self, model, q, levels, table_size, seed=0):
        self.design = model.design._replace(grid=levels, table=(table_size, table_size))
        self.values, self.steps = (
            join(q.model.anchors),
            np.repeat(q.context.q, model.design.widths, axis=1),
        )
        self.kept = q.kept
        rng, shapes = np.random.default_rng(seed), self.design.layers()
        arrays = random_layers(rng, "psi_p", shapes["psi_p"])
        mu, raw = layout(self.design.widths)
        last = f"psi_p.b{len(self.design.context)}"
        arrays[last][mu], arrays[last][raw] = channel_moments(self.values, self.kept, self.steps)
        arrays.update(
            {
                f"grid.{i}": rng.uniform(-1e-4, 1e-4, shape)
                for i, shape in enumerate(self.design.levels())
            }
        )
        self.p = Parameters(arrays, float)
        self.adam = Adam(self.p)
        # psi_q is not asked for steps here: the symbols are given, and its layers give Q_0
        self.networks = {
            "psi_p": self.p.network("psi_p"),
            "psi_q": tuple(
                [np.zeros(shape if kind == "W" else shape[1]) for shape in shapes["psi_q"]]
                for kind in "Wb"
            ),
        }
        box = [corner.astype(float) for corner in model.box]
        self.located = hash_grid.locate(
            q.model.anchors.x_a, *box, levels, [T for T, _ in self.design.levels()]
        )

    def step(self):
        """One iteration on the bits of all kept symbols and of the grid; returns both."""
        grids = self.p.listed("grid")
        ctx, res = context(self.design, self.networks, grids, self.located)
        out, res_bits = likelihood.forward(self.values, ctx.mu, ctx.sigma, self.steps)
        rate, res_grid = hash_rate.forward(grids)
        bars = likelihood.backward(res_bits, self.kept / self.kept.sum())
        grids_bar, networks = context_backward(res, np.zeros_like(ctx.q), bars["mu"], bars["sigma"])
        gradients = self.p.zeros()
        gradients.fill("psi_p", networks["psi_p"])
        sides = hash_rate.backward(res_grid, np.float64(1 / self.kept.sum()))["grids"]
        for i, (a, b) in enumerate(zip(grids_bar, sides)):
            gradients[f"grid.{i}"][...] = a + b
        self.adam.step(self.p, gradients, lambda name: LEARNING_RATE)
        return float(out.bits[self.kept].sum()), float(rate.R_hash)


def channel_moments(values, kept, steps):
    """Mean and log deviation of every channel over what is coded: the prior that has no context (n,), (n,)."""
    count = np.maximum(kept.sum(axis=0), 1)
    mu = np.where(kept, values, 0).sum(axis=0) / count
    var = (np.where(kept, values - mu, 0) ** 2).sum(axis=0) / count
    return mu, 0.5 * np.log(np.maximum(var, (LEAST_DEVIATION * steps[0]) ** 2))


def written(model, design, networks, grids):
    """Bytes of a file with another context: attributes, grid, psi_p and psi_q together."""
    sizes = components(
        encode(replace(model, design=design, networks={**model.networks, **networks}, grids=grids))
    )
    return {
        "attribute_bytes": sum(sizes[name] for name in ATTRIBUTES),
        "grid_bytes": sizes["hash_grid"],
        "mlp_bytes": sizes["context_mlps"],
    }


def without_context(model, q):
    """The file under one Gaussian a channel: psi_p's weights are zero, so that its last bias is all it says."""
    design = model.design
    mu, raw = layout(design.widths)
    shapes = design.layers()["psi_p"]
    weights, biases = (
        [np.zeros(shape) for shape in shapes],
        [np.zeros(shape[1]) for shape in shapes],
    )
    steps = np.repeat(q.context.q, design.widths, axis=1)
    biases[-1][mu], biases[-1][raw] = channel_moments(join(q.model.anchors), q.kept, steps)
    return written(model, design, {"psi_p": (weights, biases)}, model.grids)


def measure(quick, progress):
    iterations, fits = (120, 40) if quick else (950, 400)
    levels = {n: LEVELS[n] for n in ((1, 4) if quick else LEVELS)}
    sizes = (64, 512) if quick else (32, 128, 512, 2048)
    progress("hash grid: the model whose attributes are held")
    model = fixed(train(load_scene("bouncing"), reduced(iterations)).model)
    q = quantise(model)
    alone, rows, runs = without_context(model, q), [], {}
    for count, grid in levels.items():
        for size in sizes:
            progress(f"hash grid: {count} levels, {size} entries")
            fit = ContextFit(model, q, grid, size)
            for _ in range(fits):
                fit.step()
            sizes_of = written(
                model,
                fit.design,
                {name: fit.networks[name] for name in ("psi_p", "psi_q")},
                fit.p.listed("grid"),
            )
            rows.append(
                {
                    "method": f"{count} level{'s' * (count > 1)}",
                    "knob": size,
                    "levels": count,
                    "entries": sum(T * F for T, F in fit.design.levels()),
                    **sizes_of,
                    "saved_bytes": alone["attribute_bytes"] - sizes_of["attribute_bytes"],
                    "multiply_adds": multiply_adds(fit.design, ("psi_p",), len(fit.values)),
                    "reads": fit.located.nnz,
                    "symbols": int(fit.kept.sum()),
                }
            )
            runs[count, size] = fit.step
    repeats = 3 if quick else 7
    ms = alternate(runs, repeats)
    return [{**row, "ms": ms[row["levels"], row["knob"]]} for row in rows], alone, repeats


def run(folder, quick, progress):
    rows, alone, repeats = measure(quick, progress)
    files = [table(folder, "hash_grid", rows)]
    title = (
        f"bytes saved of {alone['attribute_bytes']:,}, entries of a level's table labelled\n"
        "reference: one Gaussian a channel, same symbols, same coder"
    )
    for name, x, label, scale in (
        ("hash_grid", "grid_bytes", "hash grid in the file (bytes)", "log"),
        ("hash_grid_time", "ms", "one iteration of the context (ms)", "log"),
    ):
        fig, (ax,) = figure()
        lines(
            ax, rows, Axes(x, "saved_bytes", label, "bytes that the context saves", scale, "linear")
        )
        if x == "grid_bytes":
            bound = np.geomspace(min(row[x] for row in rows), max(row[x] for row in rows), 50)
            ax.plot(bound, bound, ":", color="gray", label="pays for the grid")
        legend(ax)
        finish(fig, folder / f"{name}.png", title)
    figures = [
        ("hash_grid.png", "Bytes saved against the grid's own bytes."),
        ("hash_grid_time.png", "Bytes saved against time."),
    ]
    return Finding(
        "hash_grid",
        "Hash grid",
        "one mean and deviation a channel, the same symbols and coder",
        figures,
        files,
        read(rows, alone),
        f"median of {repeats} alternating repeats of one iteration of the context",
    )


def read(rows, alone):
    """What the numbers say."""
    net = [(row["saved_bytes"] - row["grid_bytes"], row) for row in rows]
    gain, best = max(net, key=lambda pair: pair[0])
    most = max(rows, key=lambda row: row["saved_bytes"])
    loss, worst = min(net, key=lambda pair: pair[0])
    quick, slow = (choose(rows, key=lambda row: row["ms"]) for choose in (min, max))
    return (
        f"One Gaussian a channel needs {alone['attribute_bytes']:,} bytes for {rows[0]['symbols']:,} symbols. The "
        f"context that saves most, {most['method']} of {most['knob']} entries, saves {most['saved_bytes']:,} bytes "
        f"and its grid takes {most['grid_bytes']:,}. After the grid is paid for, {best['method']} of {best['knob']} "
        f"entries is best with {gain:+,} bytes and {worst['method']} of {worst['knob']} entries worst with {loss:+,}; "
        f"the context MLPs' {best['mlp_bytes']:,} bytes come on top. An iteration takes {quick['ms']:.3g} ms with "
        f"{quick['method']} and {quick['reads']:,} reads of the grid, {slow['ms']:.3g} ms with {slow['method']} and "
        f"{slow['reads']:,}."
    )
