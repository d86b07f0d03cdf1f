"""Study 3, entropy coder: bits of frequencies, means and deviations, lanes, and their cost.

The codec's format fixes these widths. Here its tables are built once more with the widths as
parameters, and the codec's own rANS codes and decodes the symbols. Frequencies that total 2^p,
multiplied by 2^(24 - p), are the same model.
"""

import numpy as np
from scipy.special import ndtr, ndtri

from ...codec import rans
from ...codec.fixed_point import bit_length
from ...codec.gaussian_table import MU_BITS, PRECISION, SIGMA_BITS, Model, gaussian_model
from ...codec.streams import (
    decode_gaussian,
    decode_symbols,
    encode_gaussian,
    find_entries,
    ideal_bits_gaussian,
    pack_fields,
)
from ...equations import likelihood
from ..bench import in_units, random_message
from ..clock import alternate, compare, stated, stretch_of
from .diagram import (
    Axes,
    Finding,
    at,
    figure,
    finish,
    legend_below,
    lines,
    number,
    select,
    table,
    work_precision,
)

PRECISIONS = (8, 10, 12, 14, 16, 18, 20, 22, 24)
WIDE = 12.0  # sigmas, the codec's window
MU_WIDTHS = (0, 1, 2, 3, 4, 6, 8, 10)
SIGMA_WIDTHS = (0, 1, 2, 3, 4, 6)
LANES = (1, 8, 32, 128, 512)
WIDE_WINDOW, FITTED_WINDOW = "frequencies, 12σ window", "frequencies, fitted window"
CODEC, LANED = "the codec", "the codec, lanes labelled"


def message(n, seed=0):
    """Symbols with their means and deviations in steps, and their bits under these Gaussians."""
    symbols, mu, sigma = random_message(n, seed)
    bits, _ = likelihood.forward(symbols.astype(float), mu, sigma, np.ones(n))
    return symbols, mu, sigma, float(bits.sum())


def model_of(mu, sigma, precision, mu_bits, sigma_bits, reach):
    """The frequency tables of n symbols, with every width a parameter.

    mu and sigma (n,) are in steps; `reach` is half a window in sigmas. Raises ValueError where a
    window has more entries than half the frequencies.
    """
    mu_units = np.rint(mu * 2.0**mu_bits).astype(np.int64)
    sigma_units = np.rint(np.log2(sigma) * 2.0**sigma_bits).astype(int)
    block = mu_units + (1 << mu_bits >> 1) >> mu_bits  # the symbol that holds the mean
    keys = np.stack([sigma_units, mu_units - (block << mu_bits)])
    pairs, used = np.unique(keys, axis=1, return_inverse=True)
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
    # Adding j makes every frequency at least 1.
    cumulative = np.floor(below * (2**precision - entries[owner])).astype(np.int64) + j
    keys = (owner << PRECISION) + (cumulative << PRECISION - precision)
    return Model(
        np.append(keys, len(entries) << PRECISION),
        first,
        entries - 1,
        np.zeros_like(first),
        used.astype(np.int32),
        (block - half[used]).astype(np.int32),
    )


def encode(symbols, model):
    """The bytes of symbols under a model, their ideal bits, and the number of escapes.

    Escapes are appended in gamma code, as the codec writes them.
    """
    entries, gamma = find_entries(symbols, model)
    b = bit_length(gamma) - 1
    values = np.stack([1 << b, gamma - (1 << b)], 1).ravel()
    widths = np.stack([b + 1, b], 1).ravel()
    data = rans.encode(entries, model.keys) + pack_fields(values, widths)
    bits = PRECISION - np.log2(np.diff(model.keys)[entries])
    return data, float(bits.sum()) + (2 * b + 1).sum(), len(gamma)


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
    codec = dict(precision=PRECISION, mu_bits=MU_BITS, sigma_bits=SIGMA_BITS, reach=WIDE)
    # The fitted window: as many sigmas as leave one frequency outside.
    tail = {p: float(-ndtri(2.0 ** -(p + 1))) for p in PRECISIONS}
    return [
        *((WIDE_WINDOW, p, {**codec, "precision": p}) for p in PRECISIONS),
        *((FITTED_WINDOW, p, {**codec, "precision": p, "reach": tail[p]}) for p in PRECISIONS),
        *(("mean", bits, {**codec, "mu_bits": bits}) for bits in MU_WIDTHS),
        *(("log2 deviation", bits, {**codec, "sigma_bits": bits}) for bits in SIGMA_WIDTHS),
    ]


def code(n, repeats, progress):
    """Rows of all variants and of the codec itself, each decoded to check it, timed in turn."""
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
    units = in_units(mu, sigma)
    about = symbols, bits, gaussian_model(*units), float(ideal_bits_gaussian(symbols, *units).sum())
    for method, lanes in ((CODEC, None), *((LANED, lanes) for lanes in LANES)):
        try:
            data = encode_gaussian(symbols, *units, lanes)
        except ValueError:  # too few symbols for that many lanes
            continue
        rows.append(coded_row(method, lanes or "", data, *about, 0))
        runs[method, lanes or ""] = lambda lanes=lanes: decode_gaussian(
            encode_gaussian(symbols, *units, lanes), *units
        )
    progress("coder: times")
    times = alternate(runs, repeats)
    return [{**row, **times[row["method"], row["knob"]].columns("ns", 1e6 / n)} for row in rows]


def run(folder, quick, progress, jobs=1):
    n, repeats = 3000 if quick else 20_000, 3
    progress("coder: codes and decodes")
    rows = code(n, repeats, progress)
    axes = Axes(
        "ns",
        "percent",
        "processor time (ns per symbol, encode and decode)",
        "size above the entropy (%)",
    )
    work_precision(
        folder / "coder.png",
        [row for row in rows if row["method"] in (WIDE_WINDOW, FITTED_WINDOW, CODEC)],
        axes,
        f"bits of the frequencies (labelled), {n:,} symbols, bytes written and read back\n"
        "reference: entropy under the true Gaussians",
    )
    draw_widths(folder / "coder_context.png", rows)
    work_precision(
        folder / "coder_lanes.png",
        select(rows, method=LANED),
        axes,
        f"lanes (labelled), {n:,} symbols, bytes written and read back\n"
        "reference: entropy under the true Gaussians",
    )
    return Finding(
        "coder",
        "Entropy coder",
        "the entropy under the true Gaussians in float64",
        [
            ("coder.png", "Bits of the frequencies: size above the entropy against time."),
            (
                "coder_context.png",
                "Bits of the integer context: what the model loses, without the coder's own cost.",
            ),
            ("coder_lanes.png", "Number of lanes: size above the entropy against time."),
        ],
        [table(folder, "coder", rows)],
        read(rows),
        f"median and quartiles of {repeats} alternating repeats, tables, encoding and decoding",
        stretch_of(rows),
    )


def draw_widths(path, rows):
    fig, (ax,) = figure()
    of_codec = {
        "mean": MU_BITS,
        "log2 deviation": SIGMA_BITS,
    }
    shown = [row for row in rows if row["method"] in of_codec]
    axes = Axes(
        "knob",
        "model_percent",
        "fractional bits of mean and deviation",
        "entropy lost by the model (%)",
        "linear",
    )
    lines(ax, shown, axes, label=False)
    for method, width in of_codec.items():
        lost = at(shown, method=method, knob=width)["model_percent"]
        ax.plot(width, lost, "o", markersize=16, fillstyle="none", color="black")
    legend_below(fig, ax, 3)
    finish(
        fig,
        path,
        "bits of the integer context (circled: those of the codec)\n"
        "reference: the same entropy with float64 parameters",
    )


def read(rows):
    """What the numbers say."""
    fitted, wide = select(rows, method=FITTED_WINDOW), select(rows, method=WIDE_WINDOW)
    mean, deviation = select(rows, method="mean"), select(rows, method="log2 deviation")
    codec, most = at(rows, method=CODEC), fitted[-1]
    enough = next(row for row in fitted if row["percent"] < 2 * most["percent"])
    lanes = [
        f"{row['knob']}: {row['percent']:.2f} %, {stated(row, 'ns')}"
        for row in select(rows, method=LANED)
    ]
    of_codec = at(deviation, knob=SIGMA_BITS)["model_percent"]
    fine = f"the same with means of {mean[-1]['knob']} bits everywhere"
    times = compare("a symbol of the codec", codec, fine, mean[-1], "ns")
    return (
        f"With {fitted[0]['knob']} bits and a window fitted to them, the file is "
        f"{fitted[0]['percent']:.2f} % larger than the entropy, with {most['knob']} bits "
        f"{most['percent']:.3f} %; {enough['knob']} bits are the fewest within twice that. The "
        f"codec's window of 12 σ needs at least {wide[0]['knob']} bits and costs "
        f"{wide[0]['percent']:.2f} % there. The codec itself is {codec['percent']:.3f} % above the "
        f"entropy, of which the model is {codec['model_percent']:.3f} %, with "
        f"{codec['table_entries']:,} table entries; means of {mean[-1]['knob']} bits without "
        f"its coarser grid for wide Gaussians take {mean[-1]['table_entries']:,} entries. "
        f"{times} Deviations "
        f"rounded to a power of two (0 bits) lose {deviation[0]['model_percent']:.2f} %, the "
        f"codec's {SIGMA_BITS} bits {of_codec:.3f} %; means rounded to a step lose "
        f"{number(mean[0]['model_percent'])} %. Lanes, the size above the entropy and the time of "
        f"a symbol: {'; '.join(lanes)}."
    )
