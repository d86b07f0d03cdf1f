"""Conformance streams for other decoders: small files, the numbers in them, and damaged files that must be refused.

`python -m p4dgs_ref.codec.conformance [-o DIR]` writes them again, the same bytes on every machine: the models are made
of integers, and no floating-point result enters but products and sums that IEEE 754 rounds in one way.

FORMAT of the folder.  `manifest.json` is an object with two lists, of objects:
    good   name, says (what it tests), file, bytes, sha256, header (the decoded JSON), sections {name: bytes},
           expected (a file), arrays: a list of {name, type, shape, offset, sha256}: row by row, little-endian,
           from byte `offset` of the expected file on
    bad    name, says, file, bytes, sha256, section, offset, kind: where a decoder must refuse it, and what for.
           section is "container" for the frame of the file; offset counts bytes from the start of the section, or of
           the file for the container, and is null where sound decoders may differ.  kind is one of magic, version,
           length (of file or section), checksum, table (ids and their order), missing, unexpected (a section), header
           (its content), number (a weight or the box), stream (a message of the entropy coder)
Types are u8, u16, i32, i64, f32, f64, and bit: eight in a byte, the lowest bit first, the last byte filled with zeros.
Symbols reach 2^31 and mu_units 2^34; they are i64 where i32 does not hold them.
Arrays, for A anchors and the n = d + 6 + 3 k columns f, s, l, O (three of every child, child by child):
    positions  u16 (A, 3)          x_a          f64 (A, 3)       masks        u8 (A, k)
    signs      bit (entries,)      h            i32 (A, H)       q_units      i32 (A, 4)       q           f64 (A, 4)
    mu_units   i32, i64 (A, n)     sigma_units  i32 (A, n)       symbols  i32, i64 (A, n)      attributes  f64 (A, n)
    anchor_mlps, context_mlps, deformation_mlp (where it exists)  f32, every number in the section's order
Children that are masked have symbols and attributes 0; mu_units and sigma_units are given all the same.
Doubles are to be met bit for bit.
"""

import argparse
import hashlib
import json
import os
from pathlib import Path

import numpy as np

from .conformance_bad import forgeries
from .conformance_good import SAYS
from .container import write_container
from .context import hash_feature
from .file import NETWORK_SECTIONS, attribute_columns, sections_of
from .streams import encode_bits, encode_gaussian

FOLDER = Path(__file__).with_name("streams_v1")
TYPES = {"u8": "u1", "u16": "<u2", "i32": "<i4", "i64": "<i8", "f32": "<f4", "f64": "<f8"}


def stream_of(maker):
    """What one maker makes: (quantised, sections)."""
    made = maker()
    parts, symbols = made if isinstance(made, tuple) else (made, None)
    quantised = parts.quantised(symbols)
    sections, ctx = sections_of(quantised), quantised.context
    for name, columns in attribute_columns(parts.design):
        if name in parts.lanes:
            kept = quantised.kept[:, columns]
            coded = [
                a[:, columns][kept] for a in (quantised.symbols, ctx.mu_units, ctx.sigma_units)
            ]
            sections[name] = encode_gaussian(*coded, parts.lanes[name])
    if "hash_grid" in parts.lanes:
        signs = np.concatenate([grid.ravel() for grid in parts.grids])
        sections["hash_grid"] = encode_bits(signs > 0, parts.lanes["hash_grid"])
    return quantised, sections


def expected(quantised):
    """The arrays that a decoder must find: {name: (type, array)}."""
    model, ctx = quantised.model, quantised.context
    h = hash_feature(quantised.positions, model.grids, model.design)
    signs = np.concatenate([grid.ravel() for grid in model.grids])
    q_units = np.rint(
        ctx.q / (np.array(model.design.Q_0) * 2.0**-15)
    )  # undoes the one rounded product
    arrays = {
        "positions": ("u16", quantised.positions),
        "x_a": ("f64", model.anchors.x_a),
        "masks": ("u8", model.anchors.mask),
        "signs": ("bit", signs > 0),
        "h": ("i32", h),
        "q_units": ("i32", q_units),
        "q": ("f64", ctx.q),
        "mu_units": (_whole(ctx.mu_units), ctx.mu_units),
        "sigma_units": ("i32", ctx.sigma_units),
        "symbols": (_whole(quantised.symbols), quantised.symbols),
        "attributes": ("f64", quantised.symbols * np.repeat(ctx.q, model.design.widths, axis=1)),
    }
    for section, members in NETWORK_SECTIONS.items():
        layers = [
            a
            for name in members
            if name in model.networks
            for pair in zip(*model.networks[name])
            for a in pair
        ]
        if layers:
            arrays[section] = "f32", np.concatenate([a.ravel() for a in layers])
    return arrays


def _whole(array):
    return "i32" if -(2**31) <= array.min() <= array.max() < 2**31 else "i64"


def _bytes(kind, array):
    if kind == "bit":
        return np.packbits(array, bitorder="little").tobytes()
    return np.ascontiguousarray(array, TYPES[kind]).tobytes()


def files():
    """Every file of the folder, {name: bytes}, the manifest last."""
    contents, good, bad = {}, [], []
    for maker, says in SAYS.items():
        quantised, sections = stream_of(maker)
        row = _file_row(maker.__name__, says, write_container(sections), contents)
        row["header"], row["sections"] = (
            json.loads(sections["header"]),
            {key: len(sections[key]) for key in sections},
        )
        row["expected"], arrays, body = f"{row['name']}.bin", [], b""
        for name, (kind, array) in expected(quantised).items():
            part = _bytes(kind, array)
            arrays.append(
                {
                    "name": name,
                    "type": kind,
                    "shape": list(array.shape),
                    "offset": len(body),
                    "sha256": hashlib.sha256(part).hexdigest(),
                }
            )
            body += part
        row["arrays"], contents[row["expected"]] = arrays, body
        good.append(row)
    for name, says, data, section, offset, kind in forgeries():
        bad.append(
            {
                **_file_row(name, says, data, contents),
                "section": section,
                "offset": offset,
                "kind": kind,
            }
        )
    contents["manifest.json"] = _manifest({"good": good, "bad": bad})
    return contents


def _file_row(name, says, data, contents):
    contents[f"{name}.p4dgs"] = data
    return {
        "name": name,
        "says": says,
        "file": f"{name}.p4dgs",
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def _manifest(lists):
    """JSON with a line for every array and every bad stream."""
    lines = ['{"format": 1, "license": "CC0-1.0",']
    for key, rows in lists.items():
        lines.append(f'"{key}": [')
        for row in rows:
            arrays = row.get("arrays", [])
            text = _line({k: v for k, v in row.items() if k != "arrays"})
            if arrays:
                text = text[:-1] + ',"arrays":[\n' + ",\n".join(map(_line, arrays)) + "]}"
            lines.append(text + ("," if row is not rows[-1] else ""))
        lines.append("]," if key != list(lists)[-1] else "]}")
    return "\n".join(lines).encode() + b"\n"


def _line(value):
    return json.dumps(value, separators=(",", ":"))


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "-o", metavar="DIR", type=Path, default=FOLDER, help="where to write (default: the package)"
    )
    folder, contents = parser.parse_args(arguments).o, files()
    os.makedirs(folder, exist_ok=True)
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    print(f"{folder}: {len(contents)} files, {sum(map(len, contents.values())):,} bytes")


if __name__ == "__main__":
    main()
