"""What our own decoder finds in a file, as a port writes it: arrays by name, and refusals."""

import json
from pathlib import Path

import numpy as np

from p4dgs_ref.codec.container import BitstreamError, read_container
from p4dgs_ref.codec.context import hash_feature
from p4dgs_ref.codec.file import NETWORK_SECTIONS, quantised_of
from p4dgs_ref.codec.plain import network_numbers
from p4dgs_ref.oracle.streams import STREAMS, TYPES, read_rows
from tests.workshop import writer


def arrays_of(quantised):
    """Return the arrays that a decoder must find in the file of a model, {name: (type, array)}."""
    model, ctx = quantised.model, quantised.context
    signs = np.concatenate([grid.ravel() for grid in model.grids])
    # Undoes the one rounded product of doubles, q = q_units Q_0 2^-15.
    q_units = np.rint(ctx.q / (np.array(model.design.Q_0) * 2.0**-15))
    arrays = {
        "positions": ("u16", quantised.positions),
        "x_a": ("f64", model.anchors.x_a),
        "masks": ("u8", model.anchors.mask),
        "signs": ("bit", signs > 0),
        "h": ("i32", hash_feature(quantised.positions, model.grids, model.design)),
        "q_units": ("i32", q_units),
        "q": ("f64", ctx.q),
        "mu_units": (_integer_type(ctx.mu_units), ctx.mu_units),
        "sigma_units": ("i32", ctx.sigma_units),
        "symbols": (_integer_type(quantised.symbols), quantised.symbols),
        "attributes": ("f64", quantised.symbols * np.repeat(ctx.q, model.design.widths, axis=1)),
    }
    for section, members in NETWORK_SECTIONS.items():
        present = {name: model.networks[name] for name in members if name in model.networks}
        if present:
            arrays[section] = "f32", network_numbers(present)
    return arrays


def _integer_type(array):
    return "i32" if -(2**31) <= array.min() <= array.max() < 2**31 else "i64"


def decoded(data):
    """Return all arrays that the conformance streams name, {name: array}, decoded from any file.

    Raises BitstreamError.
    """
    types = {**TYPES, "bit": bool}
    arrays = arrays_of(quantised_of(read_container(data)))
    return {name: np.asarray(a).astype(types[kind]) for name, (kind, a) in arrays.items()}


def write_answers(folder):
    """Write what is found in the conformance streams to `folder`/codec, as a port would."""
    place, refusals, rows = Path(folder) / "codec", {}, read_rows()
    place.mkdir(parents=True, exist_ok=True)
    for row in rows["good"] + rows["bad"]:
        try:
            arrays = decoded((STREAMS / row["file"]).read_bytes())
        except BitstreamError as error:
            refusals[row["name"]] = str(error)
        else:
            (place / f"{row['name']}.safetensors").write_bytes(writer.dump(arrays))
    (place / "refusals.json").write_text(json.dumps(refusals, indent=1), encoding="utf-8")
