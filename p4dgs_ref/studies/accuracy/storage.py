"""Study 9, storage: bits of network weights and of positions, against bytes and PSNR.

One model is trained. Its weights, or its positions, are then rounded to fewer bits, and the model
is written and measured with them. The file itself holds float16 and 16 bits per axis.
"""

from dataclasses import replace

import numpy as np

from ...codec.fixed_point import exponent
from ...codec.gaussian_table import SIGMA_BITS
from ...codec.streams import encode_gaussian
from ...scenes import load_scene
from .diagram import Axes, Finding, at, draw_panels, finish, legend_below, select, table
from .fits import TEST_VIEWS, judge, reduced, train

WEIGHT_BITS = (16, 12, 10, 8, 6, 4)
POSITION_BITS = (16, 14, 12, 10, 8)
ARRAY_BYTES = 2  # of an array of weights beside its symbols: its step and its deviation
PLAIN, CODED, POSITIONS = "weights, plain", "weights, entropy coded", "positions, plain"


def rounded(array, bits):
    """An array as integers of `bits` bits, sign included, and their step, a power of two."""
    step = 2.0 ** (exponent(array) + 1 - bits)
    most = 2 ** (bits - 1) - 1
    return np.clip(np.rint(array / step), -most, most).astype(np.int64), step


def coded_bytes(symbols):
    """The bytes of an array's integers under one Gaussian around zero, by the codec's own coder."""
    power = np.square(symbols, dtype=float).sum() / max(symbols.size, 1)
    deviation = max(np.sqrt(power), 2.0**-8)
    units = np.full(symbols.size, round(np.log2(deviation) * 2**SIGMA_BITS))
    return len(encode_gaussian(symbols.ravel(), np.zeros_like(units), units))


def weights_at(model, bits):
    """The model with weights of `bits` bits, and the bytes of these, plain and entropy coded."""
    networks, plain, coded = {}, 0.0, 0
    for name, pair in model.networks.items():
        grids = [[rounded(array, bits) for array in arrays] for arrays in pair]
        networks[name] = tuple([n * step for n, step in part] for part in grids)
        for symbols in (n for part in grids for n, _ in part):
            plain += bits * symbols.size / 8 + ARRAY_BYTES
            coded += coded_bytes(symbols) + ARRAY_BYTES
    return replace(model, networks=networks), plain, coded


def positions_at(model, bits):
    """The model with positions of `bits` bits per axis, and the bytes of these."""
    lo, hi = (corner.astype(float) for corner in model.box)
    step = np.where(hi > lo, hi - lo, 1) / (2**bits - 1)
    x_a = lo + np.rint((model.anchors.x_a - lo) / step) * step
    return replace(model, anchors=model.anchors._replace(x_a=x_a)), 3 * bits * len(x_a) / 8


def measure(iterations, progress):
    """Rows of both kinds of numbers with all their bits."""
    progress("storage: the model whose weights and positions are rounded")
    scene, rows = load_scene("bouncing"), []
    model = train(scene, reduced(iterations)).model
    for bits in WEIGHT_BITS:
        progress(f"storage: weights of {bits} bits")
        changed, plain, coded = weights_at(model, bits)
        found = judge(changed, scene)
        for method, stored in ((PLAIN, plain), (CODED, coded)):
            rows.append({"method": method, "knob": bits, "stored_bytes": round(stored), **found})
    for bits in POSITION_BITS:
        changed, stored = positions_at(model, bits)
        stored = {"stored_bytes": round(stored), **judge(changed, scene)}
        rows.append({"method": POSITIONS, "knob": bits, **stored})
    return rows


def run(folder, quick, progress, jobs=1):
    iterations = 120 if quick else 950
    rows = measure(iterations, progress)
    axes = Axes(
        "stored_bytes", "psnr_db", "bytes", "PSNR of the test views (dB)", "linear", "linear"
    )
    kinds = {"network weights": (PLAIN, CODED), "positions": (POSITIONS,)}
    contents = [
        (heading, [row for row in rows if row["method"] in methods], axes)
        for heading, methods in kinds.items()
    ]
    fig, panels = draw_panels(contents, (8, 5.4), margins=(0.12, 0.12), sharey=True)
    legend_below(fig, panels[0], 2)
    finish(
        fig,
        folder / "storage.png",
        f"bits of a weight, and of a position's axis (labelled), `tiny` after {iterations} "
        f"iterations\nreference: {TEST_VIEWS}",
    )
    return Finding(
        "storage",
        "Storage of weights and positions",
        TEST_VIEWS,
        [("storage.png", "PSNR against the bytes of all weights, and of all positions.")],
        [table(folder, "storage", rows)],
        read(rows),
        "not measured",
    )


def read(rows):
    """What the numbers say."""
    best, weights = at(rows, method=PLAIN, knob=16), []
    for bits in (12, 8, 6):
        row, coded = (at(rows, method=method, knob=bits) for method in (PLAIN, CODED))
        weights.append(
            f"{bits} bits {row['stored_bytes']:,} and {coded['stored_bytes']:,} bytes with "
            f"{row['psnr_db'] - best['psnr_db']:+.2f} dB"
        )
    finest, *_, coarsest = select(rows, method=POSITIONS)
    return (
        f"Weights of 16 bits take {best['stored_bytes']:,} bytes of a file of {best['bytes']:,}. "
        f"Plain and entropy coded, weights of {'; of '.join(weights)}. Positions of "
        f"{finest['knob']} bits per axis take {finest['stored_bytes']:,} bytes, of "
        f"{coarsest['knob']} bits {coarsest['stored_bytes']:,}, and PSNR changes by "
        f"{coarsest['psnr_db'] - finest['psnr_db']:+.2f} dB."
    )
