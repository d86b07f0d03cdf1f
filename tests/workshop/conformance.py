"""Writes the conformance streams: `python -m tests.workshop.conformance [-o DIR]`.

The files are the same bytes on every machine: their models are made of integers, and the only
floating-point operations are products and sums that IEEE 754 rounds in one way. The format of the
folder is described in the README of the vectors.
"""

import argparse
import hashlib
import json
import os
from pathlib import Path

import numpy as np

from p4dgs_ref.codec.container import write_container
from p4dgs_ref.oracle.streams import STREAMS, TYPES
from tests.workshop.conformance_bad import forgeries
from tests.workshop.conformance_good import GOOD, stream_of
from tests.workshop.decoded import arrays_of


def files():
    """Every file of the folder, {name: bytes}, the manifest last."""
    contents = {}
    good = [good_row(name, *row, contents) for name, row in GOOD.items()]
    bad = [bad_row(*forgery, contents) for forgery in forgeries()]
    contents["manifest.json"] = manifest({"good": good, "bad": bad})
    return contents


def good_row(name, says, maker, contents):
    """The manifest's row of a good stream; adds its two files to `contents`."""
    quantised, sections = stream_of(maker)
    data = write_container(sections)
    row = file_row(name, says, data, contents)
    row["header"] = json.loads(sections["header"])
    row["sections"] = {name: len(body) for name, body in sections.items()}
    row["expected"] = f"{row['name']}.bin"
    row["arrays"] = []
    body = b""
    for name, (kind, array) in arrays_of(quantised).items():
        part = array_bytes(kind, array)
        entry = {"name": name, "type": kind, "shape": list(array.shape), "offset": len(body)}
        row["arrays"].append({**entry, "sha256": hashlib.sha256(part).hexdigest()})
        body += part
    contents[row["expected"]] = body
    return row


def bad_row(name, says, data, section, offset, kind, contents):
    """The manifest's row of a bad stream; adds its file to `contents`."""
    row = file_row(name, says, data, contents)
    return {**row, "section": section, "offset": offset, "kind": kind}


def file_row(name, says, data, contents):
    """The fields that good and bad rows share; adds the file to `contents`."""
    contents[f"{name}.p4dgs"] = data
    return {
        "name": name,
        "says": says,
        "file": f"{name}.p4dgs",
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def array_bytes(kind, array):
    """An array as the expected file stores it."""
    if kind == "bit":
        return np.packbits(array, bitorder="little").tobytes()
    return np.ascontiguousarray(array, TYPES[kind]).tobytes()


def manifest(lists):
    """JSON with one line for every array and every bad stream."""
    lines = ['{"format": 1, "license": "CC0-1.0",']
    for key, rows in lists.items():
        lines.append(f'"{key}": [')
        for row in rows:
            arrays = row.get("arrays", [])
            text = compact({k: v for k, v in row.items() if k != "arrays"})
            if arrays:
                text = text[:-1] + ',"arrays":[\n' + ",\n".join(map(compact, arrays)) + "]}"
            lines.append(text + ("," if row is not rows[-1] else ""))
        lines.append("]," if key != list(lists)[-1] else "]}")
    return "\n".join(lines).encode() + b"\n"


def compact(value):
    """JSON without spaces."""
    return json.dumps(value, separators=(",", ":"))


def main(arguments=None):
    parser = argparse.ArgumentParser(
        prog="python -m tests.workshop.conformance", description=__doc__.split("\n")[0]
    )
    parser.add_argument(
        "-o",
        metavar="DIR",
        type=Path,
        default=STREAMS,
        help="where to write (default: the folder of published streams in the package)",
    )
    folder = parser.parse_args(arguments).o
    contents = files()
    os.makedirs(folder, exist_ok=True)
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    print(f"{folder}: {len(contents)} files, {sum(map(len, contents.values())):,} bytes")


if __name__ == "__main__":
    main()
