"""Where the bytes of a file are, beside what the model says they should be."""

import numpy as np
from scipy.special import xlogy

from ..equations import hash_grid, likelihood
from ..model import context
from .container import read_container
from .file import NETWORK_SECTIONS, attribute_columns, quantised_of
from .streams import ideal_bits_gaussian


def entropy_bits(flags):
    """N+ (-log2 p+) + N- (-log2 p-) of a boolean array, Eq. (14): the best any Bernoulli stream can do."""
    n = np.array([np.count_nonzero(flags), np.size(flags) - np.count_nonzero(flags)], float)
    n = n[n > 0]
    return float((n * np.log2(n.sum() / n)).sum())


def float_context(model):
    """The context as training computes it, in float64: what the integers of `context.py` stand for."""
    design, box = model.design, [corner.astype(float) for corner in model.box]
    located = hash_grid.locate(
        model.anchors.x_a, *box, design.grid, [T for T, _ in design.levels()]
    )
    return context(design, model.networks, model.grids, located)[0]


# Why a section is larger than its entropy under the float model: the four columns of the ledger, left to right.
GAPS = {
    "model": "means, deviations and frequencies are whole numbers, every symbol in the window has at least one count",
    "coder": "the coder ends with 4 to 8 bytes of state, a few bits a lane, and whole bytes",
    "headers": "number of lanes, probability of a one, the box of the positions; the container's table of sections",
}


def stream_header(body, before):
    """Bytes of a stream that say how to read it: `before` its message, the lane byte, the tail where lanes are many."""
    return before + 1 + 4 * (body[before] & 15 > 0) if len(body) > before else len(body)


def ledger(data):
    """One row a section, the container first; the rows' bytes add up to len(data).

    Fields     name, bytes; estimate_bytes: entropy under the float model; integer_bytes: under the integer frequencies;
               payload_bytes and header_bytes, whose sum is bytes; symbols, bits_per_symbol, None where there are none.
               What is stored as it is has no gaps: its three sizes are equal.  GAPS says what the differences are
    Raises     BitstreamError for a file that cannot be decoded
    """
    sections = read_container(data)
    q = quantised_of(sections)
    model, prior = q.model, float_context(q.model)
    steps = np.repeat(q.context.q, model.design.widths, axis=1)
    floats, _ = likelihood.forward(q.symbols * steps, prior.mu, prior.sigma, steps)
    integers = symbol_bits(q)
    found = {"positions": (q.positions.size, None, None, 24)}
    for name, flags in (
        ("masks", model.anchors.mask),
        ("hash_grid", np.concatenate([g.ravel() for g in model.grids]) > 0),
    ):
        ones, f = np.count_nonzero(flags), int.from_bytes(sections[name][:4], "little") / 2**24
        coded = -(xlogy(ones, f) + xlogy(flags.size - ones, 1 - f)) / np.log(2)
        found[name] = flags.size, entropy_bits(flags), coded, stream_header(sections[name], 4)
    for name, columns in attribute_columns(model.design):
        kept = q.kept[:, columns]
        found[name] = (
            int(kept.sum()),
            floats[:, columns][kept].sum(),
            integers[:, columns][kept].sum(),
            stream_header(sections[name], 0),
        )
    frame = len(data) - sum(map(len, sections.values()))
    rows = [_row("container", frame, None, None, None, frame)]
    for name, body in sections.items():
        symbols, estimate, integer, header = found.get(name, (None, None, None, 0))
        symbols = len(body) // 2 if name in NETWORK_SECTIONS else symbols
        rows.append(
            _row(
                name,
                len(body),
                symbols,
                estimate,
                integer,
                len(body) if name == "header" else header,
            )
        )
    return rows


def _row(name, size, symbols, estimate, integer, header):
    payload = size - header
    sizes = [float(payload if bits is None else bits / 8) for bits in (estimate, integer)]
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
    """What every symbol costs under the integer frequencies (A, n), zero where nothing is coded."""
    bits = np.zeros(q.kept.shape)
    bits[q.kept] = ideal_bits_gaussian(
        *(a[q.kept] for a in (q.symbols, q.context.mu_units, q.context.sigma_units))
    )
    return bits


def anchor_bits(data):
    """The model of a file and the bits that each of its anchors costs (A,): position, attributes, masks."""
    q = quantised_of(read_container(data))
    mask = q.model.anchors.mask
    return q.model, 48 + symbol_bits(q).sum(axis=1) + entropy_bits(mask) / len(mask)


def components(data):
    """Bytes by component; the container's frame counts as header.  They add up to len(data)."""
    sections = read_container(data)
    frame = len(data) - sum(map(len, sections.values()))
    sizes = {name: len(body) for name, body in sections.items()}
    return {**sizes, "header": sizes.get("header", 0) + frame}
