"""Where the bytes of a file are, beside what the model says they should be."""
import numpy as np

from ..equations import hash_grid, likelihood
from ..model import context
from .container import read_container
from .file import attribute_columns, quantised_of


def entropy_bits(flags):
    """N+ (-log2 p+) + N- (-log2 p-) of a boolean array, Eq. (14): the best any Bernoulli stream can do."""
    n = np.array([np.count_nonzero(flags), np.size(flags) - np.count_nonzero(flags)], float)
    n = n[n > 0]
    return float((n * np.log2(n.sum() / n)).sum())


def float_context(model):
    """The context as training computes it, in float64: what the integers of `context.py` stand for."""
    design, box = model.design, [corner.astype(float) for corner in model.box]
    located = hash_grid.locate(model.anchors.x_a, *box, design.grid, [T for T, _ in design.levels()])
    return context(design, model.networks, model.grids, located)[0]


def ledger(data):
    """One row {name, bytes, estimate_bytes, symbols, bits_per_symbol} a section, in the order of the file.

    The rows' bytes add up to len(data).  The estimate is the entropy under the float model where a section is
    entropy coded, and the section itself where its content is stored as it is; the first row is the container.

    Raises     BitstreamError for a file that cannot be decoded
    """
    sections = read_container(data)
    q = quantised_of(sections)
    model = q.model
    counts = {"positions": q.positions.size, "masks": model.anchors.mask.size,
              "hash_grid": sum(grid.size for grid in model.grids)}
    bits = {"masks": entropy_bits(model.anchors.mask),
            "hash_grid": entropy_bits(np.concatenate([g.ravel() for g in model.grids]) > 0)}
    steps = np.repeat(q.context.q, model.design.widths, axis=1)
    prior = float_context(model)
    every = likelihood.forward(q.symbols * steps, prior.mu, prior.sigma, steps)[0].bits
    for name, columns in attribute_columns(model.design):
        bits[name] = float(every[:, columns][q.kept[:, columns]].sum())
        counts[name] = int(q.kept[:, columns].sum())
    frame = len(data) - sum(map(len, sections.values()))
    rows = [{"name": "container", "bytes": frame, "estimate_bytes": float(frame), "symbols": None,
             "bits_per_symbol": None}]
    for name, body in sections.items():
        size, symbols = len(body), counts.get(name)
        if name.endswith(("_mlps", "_mlp")):
            symbols = size // 2
        estimate = bits[name] / 8 if name in bits else float(size)
        rows.append({"name": name, "bytes": size, "estimate_bytes": estimate, "symbols": symbols,
                     "bits_per_symbol": 8 * size / symbols if symbols else None})
    return rows


def components(data):
    """Bytes by component; the container's frame counts as header.  They add up to len(data)."""
    sections = read_container(data)
    frame = len(data) - sum(map(len, sections.values()))
    sizes = {name: len(body) for name, body in sections.items()}
    return {**sizes, "header": sizes.get("header", 0) + frame}
