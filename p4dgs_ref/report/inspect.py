"""Where the bytes of a file are, and how many the entropy model predicts."""

import numpy as np
from scipy.special import xlogy

from ..codec.container import read_container
from ..codec.file import ATTRIBUTE_SECTIONS, NETWORK_SECTIONS, attribute_columns, quantised_of
from ..codec.plain import BOX_BYTES
from ..codec.streams import ideal_bits_gaussian
from ..equations import hash_grid, hash_rate, likelihood
from ..model import context

BLOCK = 2**22  # numbers in a block of anchors: 32 MiB, half of what a decoder may need

# Why a section is larger than its entropy under the float model: the step from each size in a row
# of the ledger to the next.
GAPS = {
    "entropy to integers": "means, deviations and frequencies are integers, and no frequency is 0",
    "integers to payload": "coder's end: 4 to 8 bytes of state, a few bits per lane, whole bytes",
    "payload to bytes": "number of lanes, probability of a one, box of positions, section table",
}


def entropy_bits(grids):
    """Return the bits of the signs of grids, a list of arrays, by Eq. (14): the least they cost."""
    (R_hash, _, _), _ = hash_rate.forward(grids)
    return float(R_hash)


def float_context(model, rows=slice(None)):
    """Return the context of some anchors, or of all, in float64, as training computes it.

    The codec computes it in integers (`codec/context.py`).
    """
    design, (lo, hi) = model.design, (corner.astype(float) for corner in model.box)
    tables = [T for T, _ in design.levels()]
    located = hash_grid.locate(model.anchors.x_a[rows], lo, hi, design.grid, tables)
    return context(design, model.networks, model.grids, located)[0]


def float_bits(q, rows):
    """Return the bits [rows, n] of the symbols of some anchors under the float model."""
    prior = float_context(q.model, rows)
    steps = np.repeat(q.context.q[rows], q.model.design.widths, axis=1)
    return likelihood.forward(q.symbols[rows] * steps, prior.mu, prior.sigma, steps)[0]


def blocks_of(q):
    """Return slices of the anchors, each so short that its numbers fit beside the model.

    A file that the decoder accepts must not cost more memory here than there. A large grid makes
    the blocks longer, because each of them reads all of it.
    """
    design, A = q.model.design, len(q.symbols)
    nodes = sum(2 ** len(axes) for axes, _ in design.grid)
    features = len(design.grid) * design.F
    numbers = 8 * nodes + 16 * sum(design.widths) + sum(design.context) + features
    entries = sum(grid.size for grid in q.model.grids)
    size = max(1, (BLOCK + 2 * entries) // numbers)
    return [slice(start, start + size) for start in range(0, A, size)]


def attribute_bits(q):
    """Return {section: bits [2]} of the attributes: by the float model, by integer frequencies."""
    totals = {name: np.zeros(2) for name in ATTRIBUTE_SECTIONS}
    for rows in blocks_of(q):
        floats, integers = float_bits(q, rows), symbol_bits(q, rows)
        for name, columns in attribute_columns(q.model.design):
            kept = q.kept[rows, columns]
            totals[name] += [bits[:, columns][kept].sum() for bits in (floats, integers)]
    return totals


def stream_header(body, before):
    """Return how many bytes of a section precede the coder's state: `before`, lane byte, tail."""
    if len(body) <= before:
        return len(body)
    has_tail = body[before] & 15
    return before + 1 + (4 if has_tail else 0)


def ledger(data):
    """Return a row for the container and each section; their `bytes` add up to len(data).

    A row has name, bytes, payload_bytes and header_bytes (whose sum is bytes), estimate_bytes (the
    entropy under the float model), integer_bytes (under the integer frequencies), symbols and
    bits_per_symbol (None if there are no symbols). Content that is stored as it is has three
    equal sizes. GAPS explains the differences.

    Raises BitstreamError for a file that cannot be decoded.
    """
    sections = read_container(data)
    q = quantised_of(sections)
    model, totals = q.model, attribute_bits(q)
    parts = {
        "header": (len(sections["header"]),),
        "positions": (BOX_BYTES, q.positions.size),
    }
    signs = np.where(model.anchors.mask, 1.0, -1.0)
    for name, grids in (("masks", [signs]), ("hash_grid", model.grids)):
        size, ones = sum(grid.size for grid in grids), sum((grid > 0).sum() for grid in grids)
        f = int.from_bytes(sections[name][:4], "little") / 2**24
        coded = -(xlogy(ones, f) + xlogy(size - ones, 1 - f)) / np.log(2)
        parts[name] = stream_header(sections[name], 4), size, entropy_bits(grids), coded
    for name, columns in attribute_columns(model.design):
        symbols = int(np.count_nonzero(q.kept[:, columns]))
        parts[name] = stream_header(sections[name], 0), symbols, *totals[name].tolist()
    for name, members in NETWORK_SECTIONS.items():
        layers = [model.networks.get(member, ()) for member in members]
        parts[name] = 0, sum(a.size for pair in layers for arrays in pair for a in arrays)
    frame = len(data) - sum(map(len, sections.values()))
    return [
        ledger_row("container", frame, frame),
        *(ledger_row(name, len(body), *parts[name]) for name, body in sections.items()),
    ]


def ledger_row(name, size, header, symbols=None, estimate=None, coded=None):
    """Return a row; `estimate` and `coded` are bits, or None for content stored as it is."""
    payload = size - header
    sizes = [float(payload if bits is None else bits / 8) for bits in (estimate, coded)]
    return {
        "name": name,
        "bytes": size,
        "estimate_bytes": sizes[0],
        "integer_bytes": sizes[1],
        "payload_bytes": payload,
        "header_bytes": header,
        "symbols": symbols,
        "bits_per_symbol": 8 * size / symbols if symbols else None,
    }


def symbol_bits(q, rows=slice(None)):
    """Return the bits [rows, n] of the symbols of some anchors, or of all.

    They come from the integer frequencies and are 0 where nothing is coded.
    """
    kept = q.kept[rows]
    arrays = (q.symbols, q.context.mu_units, q.context.sigma_units)
    bits = np.zeros(kept.shape)
    bits[kept] = ideal_bits_gaussian(*(array[rows][kept] for array in arrays))
    return bits


def anchor_bits(data):
    """Return the model of a file, and the bits [A] of each anchor: position, attributes, masks."""
    sections = read_container(data)
    q = quantised_of(sections)
    mask = q.model.anchors.mask
    position = 8 * (len(sections["positions"]) - BOX_BYTES) / len(mask)  # the mean of all anchors
    masks = entropy_bits([np.where(mask, 1.0, -1.0)]) / len(mask)
    return q.model, position + symbol_bits(q).sum(axis=1) + masks


def components(data):
    """Return {name: bytes} of every section; the container's own bytes count as the header's."""
    sizes = {name: len(body) for name, body in read_container(data).items()}
    return {**sizes, "header": sizes.get("header", 0) + len(data) - sum(sizes.values())}
