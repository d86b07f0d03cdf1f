"""Where the bytes of a file are, and how many the entropy model predicts."""

import numpy as np
from scipy.special import xlogy

from ..codec.container import read_container
from ..codec.file import NETWORK_SECTIONS, attribute_columns, quantised_of
from ..codec.plain import BOX_BYTES
from ..codec.streams import ideal_bits_gaussian
from ..equations import hash_grid, likelihood
from ..model import context

# Why a section is larger than its entropy under the float model: from each size in a row of the
# ledger to the next.
GAPS = {
    "entropy to integers": "means, deviations and frequencies are integers, no frequency is zero",
    "integers to payload": "the coder's end: 4 to 8 bytes of state, a few bits a lane, whole bytes",
    "payload to bytes": "number of lanes, probability of a one, box of positions, section table",
}


def entropy_bits(flags):
    """Return N+ (-log2 p+) + N- (-log2 p-) of a boolean array, Eq. (14): the least it can cost."""
    n = np.array([np.count_nonzero(flags), np.size(flags) - np.count_nonzero(flags)], float)
    n = n[n > 0]
    return float((n * np.log2(n.sum() / n)).sum())


def float_context(model):
    """Return the context as training computes it, in float64; the codec's is in integers."""
    design, (lo, hi) = model.design, (corner.astype(float) for corner in model.box)
    return context(
        design,
        model.networks,
        model.grids,
        hash_grid.locate(model.anchors.x_a, lo, hi, design.grid, [T for T, _ in design.levels()]),
    )[0]


def stream_header(body, before):
    """Return how many bytes of a section precede the coder's state: `before`, lane byte, tail."""
    return before + 1 + 4 * (body[before] & 15 > 0) if len(body) > before else len(body)


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
    model, prior = q.model, float_context(q.model)
    steps = np.repeat(q.context.q, model.design.widths, axis=1)
    floats, _ = likelihood.forward(q.symbols * steps, prior.mu, prior.sigma, steps)
    integers = symbol_bits(q)
    parts = {
        "header": (len(sections["header"]),),
        "positions": (BOX_BYTES, q.positions.size),
    }
    signs = np.concatenate([grid.ravel() for grid in model.grids]) > 0
    for name, flags in (("masks", model.anchors.mask), ("hash_grid", signs)):
        ones, f = np.count_nonzero(flags), int.from_bytes(sections[name][:4], "little") / 2**24
        coded = -(xlogy(ones, f) + xlogy(flags.size - ones, 1 - f)) / np.log(2)
        parts[name] = stream_header(sections[name], 4), flags.size, entropy_bits(flags), coded
    for name, columns in attribute_columns(model.design):
        kept = q.kept[:, columns]
        estimate, coded = (bits[:, columns][kept].sum() for bits in (floats, integers))
        parts[name] = stream_header(sections[name], 0), int(kept.sum()), estimate, coded
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


def symbol_bits(q):
    """Return the bits [A, n] of symbols under the integer frequencies, 0 if none is coded."""
    bits = np.zeros(q.kept.shape)
    bits[q.kept] = ideal_bits_gaussian(
        q.symbols[q.kept], q.context.mu_units[q.kept], q.context.sigma_units[q.kept]
    )
    return bits


def anchor_bits(data):
    """Return the model of a file, and the bits [A] of each anchor: position, attributes, masks."""
    sections = read_container(data)
    q = quantised_of(sections)
    mask = q.model.anchors.mask
    position = 8 * (len(sections["positions"]) - BOX_BYTES) / len(mask)  # the mean of all anchors
    return q.model, position + symbol_bits(q).sum(axis=1) + entropy_bits(mask) / len(mask)


def components(data):
    """Return {name: bytes} of every section; the container's own are among those of the header."""
    sizes = {name: len(body) for name, body in read_container(data).items()}
    return {**sizes, "header": sizes.get("header", 0) + len(data) - sum(sizes.values())}
