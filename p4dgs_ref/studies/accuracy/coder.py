"""Study 3, entropy coder: bits of frequencies, of means, of deviations and of weights, against bytes and time.

The codec's format fixes these widths.  Here its construction is written once more with the widths as parameters, and
the codec's own rANS codes and decodes the symbols: frequencies that total 2^p, times 2^(24 - p), are the same model.
"""

from dataclasses import replace

import numpy as np
from scipy.special import ndtr, ndtri

from ...codec import rans
from ...codec.context import coding_context
from ...codec.fixed_point import exponent
from ...codec.gaussian_table import MU_BITS, PRECISION, SIGMA_BITS, Model, gaussian_model
from ...codec.inspect import float_context
from ...codec.quantise import quantise
from ...codec.streams import (
    decode_gaussian,
    decode_symbols,
    encode_gaussian,
    ideal_bits_gaussian,
    pack_fields,
)
from ...equations import likelihood
from ...equations.prior import layout
from ...model import split
from ...scenes import load_scene
from ...training.presets import TINY
from ...training.trainer import Trainer
from .diagram import Axes, Finding, at, figure, finish, legend, lines, number, table
from .timing import alternate

PRECISIONS = (8, 10, 12, 14, 16, 18, 20, 22, 24)
WIDE = 12.0  # sigmas, the codec's window
MU_WIDTHS, SIGMA_WIDTHS, WEIGHT_WIDTHS = (
    (0, 1, 2, 3, 4, 6, 8, 10),
    (0, 1, 2, 3, 4, 6),
    (3, 4, 5, 6, 7, 8, 10, 12, 15),
)


def message(n, seed=0):
    """Symbols with their own mean and deviation, in steps, and their bits under the true Gaussians."""
    rng = np.random.default_rng(seed)
    sigma = np.exp(rng.uniform(np.log(0.15), np.log(8), n))
    mu = 3 * rng.normal(size=n)
    symbols = np.rint(mu + sigma * rng.normal(size=n)).astype(np.int64)
    bits = likelihood.forward(symbols.astype(float), mu, sigma, np.ones(n))[0].bits
    return symbols, mu, sigma, float(bits.sum())


def model_of(mu, sigma, precision, mu_bits, sigma_bits, reach):
    """The frequency tables of n symbols, with every width a parameter.

    Shapes     mu, sigma (n,) in steps; reach: half a window in sigmas -> gaussian_table.Model
    Raises     ValueError where a window has more entries than half the frequencies there are
    """
    mu_units, sigma_units = (
        np.rint(mu * 2.0**mu_bits).astype(np.int64),
        np.rint(np.log2(sigma) * 2.0**sigma_bits).astype(int),
    )
    block = mu_units + (1 << mu_bits >> 1) >> mu_bits  # the symbol that holds the mean
    pairs, used = np.unique(
        np.stack([sigma_units, mu_units - (block << mu_bits)]), axis=1, return_inverse=True
    )
    used = used.ravel()
    deviation, place = 2.0 ** (pairs[0] / 2.0**sigma_bits), pairs[1] / 2.0**mu_bits
    half = 1 + np.ceil(reach * deviation).astype(np.int64)
    entries = 2 * half + 2  # the window's symbols, then the escape
    if entries.max() > 2 ** (precision - 1):
        raise ValueError(
            f"a window of {entries.max()} entries does not fit frequencies of {precision} bits"
        )
    first = np.cumsum(entries) - entries
    owner = np.repeat(np.arange(len(entries)), entries)
    j = np.arange(len(owner)) - first[owner]
    below = ndtr((j - half[owner] - 0.5 - place[owner]) / deviation[owner])
    below = np.where(j == 0, 0, np.where(j == entries[owner] - 1, 1, below))
    cum = (
        np.floor(below * (2**precision - entries[owner])).astype(np.int64) + j
    )  # rises by one at least
    keys = np.append(
        (owner << PRECISION) + (cum << PRECISION - precision), len(entries) << PRECISION
    )
    return Model(
        keys,
        first,
        entries - 1,
        np.zeros_like(first),
        used.astype(np.int32),
        (block - half[used]).astype(np.int32),
    )


def encode(symbols, model):
    """The bytes of symbols under a model, escapes in gamma code behind them as the codec writes them; and ideal bits."""
    place, blocks = symbols - model.lowest, model.blocks[model.table]
    out = np.flatnonzero((place < 0) | (place >= blocks))
    beyond = place[out] - blocks[out]
    gamma = np.where(beyond < 0, -2 * place[out], 2 * beyond + 1)
    entries = model.first[model.table] + np.where((place < 0) | (place >= blocks), blocks, place)
    b = np.frexp(gamma.astype(float))[1] - 1
    fields = np.stack([1 << b, gamma - (1 << b)], 1).ravel(), np.stack([b + 1, b], 1).ravel()
    ideal = float((PRECISION - np.log2(np.diff(model.keys)[entries])).sum()) + (2 * b + 1).sum()
    return (
        rans.encode(entries, model.keys) + pack_fields(*fields, fields[0][:0], fields[1][:0]),
        ideal,
        len(out),
    )


def coded_row(method, knob, data, symbols, bits, model, ideal, escapes):
    return {
        "method": method,
        "knob": knob,
        "symbols": len(symbols),
        "bytes": len(data),
        "table_entries": len(model.keys) - 1,
        "escapes": escapes,
        "percent": 100 * (8 * len(data) / bits - 1),
        "model_percent": 100 * (ideal / bits - 1),
    }


def variants():
    """[(method, knob, widths of model_of)] of all lines."""
    fixed = dict(precision=PRECISION, mu_bits=MU_BITS, sigma_bits=SIGMA_BITS, reach=WIDE)
    tail = {
        p: float(-ndtri(2.0 ** -(p + 1))) for p in PRECISIONS
    }  # sigmas that leave one frequency outside
    return [
        *(("frequencies, 12σ window", p, {**fixed, "precision": p}) for p in PRECISIONS),
        *(
            ("frequencies, fitted window", p, {**fixed, "precision": p, "reach": tail[p]})
            for p in PRECISIONS
        ),
        *(("mean", b, {**fixed, "mu_bits": b}) for b in MU_WIDTHS),
        *(("log2 deviation", b, {**fixed, "sigma_bits": b}) for b in SIGMA_WIDTHS),
    ]


def code(n, repeats, progress):
    """Rows of everything that is coded with other widths, and of the codec itself, timed in turn; each is decoded too."""
    symbols, mu, sigma, bits = message(n)
    rows, runs = [], {}
    for method, knob, widths in variants():
        try:
            model = model_of(mu, sigma, **widths)
        except ValueError:  # too few frequencies for that window
            continue
        data, ideal, escapes = encode(symbols, model)
        if not np.array_equal(decode_symbols(data, model), symbols):
            raise AssertionError(f"{method} {knob}: the decoder found other symbols")
        rows.append(coded_row(method, knob, data, symbols, bits, model, ideal, escapes))
        runs[method, knob] = lambda w=widths: decode_symbols(
            encode(symbols, model_of(mu, sigma, **w))[0], model_of(mu, sigma, **w)
        )
    units = (
        np.rint(mu * 2.0**MU_BITS).astype(np.int64),
        np.rint(np.log2(sigma) * 2.0**SIGMA_BITS).astype(np.int64),
    )
    data = encode_gaussian(symbols, *units)
    ideal = float(ideal_bits_gaussian(symbols, *units).sum())
    rows.append(coded_row("the codec", "", data, symbols, bits, gaussian_model(*units), ideal, 0))
    runs["the codec", ""] = lambda: decode_gaussian(encode_gaussian(symbols, *units), *units)
    progress("coder: times")
    ms = alternate(runs, repeats)
    return [{**row, "ns_per_symbol": 1e6 * ms[row["method"], row["knob"]] / n} for row in rows]


def context_rows(anchors):
    """Per cent over the entropy when psi_p's weights have fewer bits: the integer context of a `tiny` model.

    Random networks, sigma about two steps, attributes drawn from their prior; the steps stay those of the full widths.
    """
    trainer = Trainer(load_scene("bouncing"), TINY._replace(anchors=anchors))
    last, design = trainer.parameters[f"psi_p.b{len(TINY.context)}"], trainer.design
    last[layout(design.widths)[1]] = np.log(2 * np.repeat(design.Q_0, design.widths))
    trainer.networks["psi_p"][0][-1][...] *= 0.3
    drawn = trainer.model()
    prior = float_context(drawn)
    values = prior.mu + prior.sigma * np.random.default_rng(0).normal(size=prior.mu.shape)
    f, s, l, O = split(values, design)
    q = quantise(replace(drawn, anchors=drawn.anchors._replace(f_a=f, s_a=s, l_a=l, O_a=O)))
    steps, exact = np.repeat(q.context.q, design.widths, axis=1), float_context(q.model)
    bits = likelihood.forward(q.symbols * steps, exact.mu, exact.sigma, steps)[0].bits.sum()
    rows = []
    for width in WEIGHT_WIDTHS:
        weights, biases = q.model.networks["psi_p"]
        rounded = [
            np.rint(W * 2.0 ** (width - exponent(W))) * 2.0 ** (exponent(W) - width)
            for W in weights
        ]
        ctx = coding_context(
            design, {**q.model.networks, "psi_p": (rounded, biases)}, q.model.grids, q.positions
        )
        ideal = ideal_bits_gaussian(
            *(a.ravel() for a in (q.symbols, ctx.mu_units, ctx.sigma_units))
        ).sum()
        rows.append(
            {
                "method": "weights of ψ_p",
                "knob": width,
                "symbols": q.symbols.size,
                "model_percent": 100 * (ideal / bits - 1),
            }
        )
    return rows


def run(folder, quick, progress):
    n, repeats = (3000, 3) if quick else (20_000, 3)
    progress("coder: codes and decodes")
    rows = code(n, repeats, progress)
    context = context_rows(60 if quick else 300)
    files = [table(folder, "coder", rows), table(folder, "coder_context", context)]
    draw_precision(folder / "coder.png", rows, n)
    draw_widths(folder / "coder_context.png", rows, context)
    figures = [
        ("coder.png", "Bits of the frequencies: size over the entropy against time."),
        (
            "coder_context.png",
            "Bits of the integer context: what the model loses, the coder's own cost left out.",
        ),
    ]
    return Finding(
        "coder",
        "Entropy coder",
        "the entropy under the true Gaussians in float64",
        figures,
        files,
        read(rows, context),
        f"median of {repeats} alternating repeats, tables, encoding and decoding",
    )


def draw_precision(path, rows, n):
    fig, (ax,) = figure()
    shown = [
        row
        for row in rows
        if row["method"].startswith("frequencies") or row["method"] == "the codec"
    ]
    lines(
        ax,
        shown,
        Axes(
            "ns_per_symbol",
            "percent",
            "time (ns a symbol, encode and decode)",
            "size over the entropy (%)",
        ),
    )
    legend(ax)
    finish(
        fig,
        path,
        f"bits of the frequencies (labelled), {n:,} symbols, bytes written and read back\n"
        "reference: entropy under the true Gaussians",
    )


def draw_widths(path, rows, context):
    fig, (ax,) = figure()
    shown = [row for row in rows if row["method"] in ("mean", "log2 deviation")] + context
    lines(
        ax,
        shown,
        Axes(
            "knob",
            "model_percent",
            "fractional bits of mean and deviation; bits of a weight",
            "entropy lost by the model (%)",
            "linear",
        ),
        label=False,
    )
    for width, name in (
        (MU_BITS, "mean"),
        (SIGMA_BITS, "log2 deviation"),
        (WEIGHT_WIDTHS[-1], "weights of ψ_p"),
    ):
        chosen = [row for row in shown if row["method"] == name and row["knob"] == width]
        ax.plot(
            width, chosen[0]["model_percent"], "o", markersize=16, fillstyle="none", color="black"
        )
    legend(ax)
    finish(
        fig,
        path,
        "bits of the integer context (circled: the codec's)\nreference: the same entropy with float64 parameters",
    )


def read(rows, context):
    """What the numbers say."""
    fitted, wide = (
        [row for row in rows if row["method"] == f"frequencies, {kind} window"]
        for kind in ("fitted", "12σ")
    )
    codec, enough = (
        at(rows, method="the codec"),
        [row for row in fitted if row["percent"] < 2 * fitted[-1]["percent"]],
    )
    mean, deviation = (
        [row for row in rows if row["method"] == name] for name in ("mean", "log2 deviation")
    )
    light = next(
        row for row in context if row["model_percent"] < 0.1 + context[-1]["model_percent"]
    )
    return (
        f"With {fitted[0]['knob']} bits and a window fitted to them the file is {fitted[0]['percent']:.2f} % over the "
        f"entropy, with {fitted[-1]['knob']} bits {fitted[-1]['percent']:.3f} %; {enough[0]['knob']} bits are the "
        f"fewest within twice that; the codec's window of 12 σ needs {wide[0]['knob']} bits to fit at all and costs "
        f"{wide[0]['percent']:.2f} % there. The codec itself ends {codec['percent']:.3f} % over, of which the model "
        f"is {codec['model_percent']:.3f} %, with {codec['table_entries']:,} table entries; means of "
        f"{mean[-1]['knob']} bits without its coarser grid for wide Gaussians take {mean[-1]['table_entries']:,} and "
        f"{mean[-1]['ns_per_symbol'] / codec['ns_per_symbol']:.2g} times its time. Whole-number deviations (0 bits) "
        f"lose {deviation[0]['model_percent']:.2f} %, the codec's {SIGMA_BITS} bits "
        f"{at(deviation, knob=SIGMA_BITS)['model_percent']:.3f} %; whole-number means lose "
        f"{number(mean[0]['model_percent'])} %. Weights of {light['knob']} bits are within 0.1 % of the codec's "
        f"{context[-1]['knob']}."
    )
