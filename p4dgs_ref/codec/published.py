"""The conformance streams: small files for other decoders, their contents, and files to refuse.

The folder `p4dgs_ref/codec/streams_v1` holds them. `manifest.json` is an object with two lists of
objects:

    good   name, says (what the stream tests), file, bytes, sha256, header (the decoded JSON),
           sections {name: bytes}, expected (a file), and arrays: a list of
           {name, type, shape, offset, sha256}. An array stands row by row, little-endian, from
           byte `offset` of the expected file on.
    bad    name, says, file, bytes, sha256, section, offset, kind: where a decoder must refuse the
           file, and why. `section` is "container" for the frame of the file. `offset` counts bytes
           from the start of the section, or of the file for the container; it is null where
           correct decoders may differ. `kind` is one of magic, version, length (of file or
           section), checksum, table (section ids and their order), missing, unexpected (a
           section), header (its content), number (a weight or the box), stream (an entropy-coded
           message). An impossible state is refused where it begins, behind the byte of lanes
           (`state_too_small`: byte 1; `idle_high_word`: byte 5, as its section begins with a
           probability).

A port must read these streams, but for those whose names begin with `coded_`. They are not of this
page, and a port may refuse or skip all of them; if it reads one of the valid ones, it must read all
of them.

Types are u8, u16, i32, i64, f32, f64, and bit: eight to a byte, the lowest bit first, the last byte
filled with zeros. Symbols reach 2^31 and mu_units 2^34; they are stored as i64 where i32 is too
narrow.

A stream has A anchors and n = d + 6 + 3 k columns: f, s, l, O, three numbers per child in O.

    positions     u16       (A, 3)      x_a           f64  (A, 3)
    masks         u8        (A, k)      signs         bit  (entries of the grid,)
    h             i32       (A, H)      q_units       i32  (A, 4)
    q             f64       (A, 4)      sigma_units   i32  (A, n)
    mu_units      i32, i64  (A, n)      symbols       i32, i64  (A, n)
    attributes    f64       (A, n)
    anchor_mlps, context_mlps, deformation_mlp (where it exists)
                  f32       every number in the order of the section

Masked children have symbols and attributes 0; their mu_units and sigma_units are given all the
same. Doubles must agree bit for bit.
"""

from pathlib import Path

import numpy as np

from .context import hash_feature
from .file import NETWORK_SECTIONS
from .plain import network_numbers

FOLDER = Path(__file__).with_name("streams_v1")
TYPES = {"u8": "u1", "u16": "<u2", "i32": "<i4", "i64": "<i8", "f32": "<f4", "f64": "<f8"}


def expected(quantised):
    """The arrays that a decoder must find in a file: {name: (type, array)}."""
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
