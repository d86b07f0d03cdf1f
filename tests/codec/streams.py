"""The published streams and the numbers that a decoder must find in them."""

import hashlib
import json

import numpy as np

from p4dgs_ref.codec.published import FOLDER

MANIFEST = json.loads((FOLDER / "manifest.json").read_text())
GOOD, BAD = ({row["name"]: row for row in MANIFEST[key]} for key in ("good", "bad"))


def read(name):
    return (FOLDER / name).read_bytes()


def arrays_of(row):
    """The expected arrays of a good stream, {name: array}, read as the manifest describes them."""
    body, arrays, end = read(row["expected"]), {}, 0
    for entry in row["arrays"]:
        count, start = int(np.prod(entry["shape"])), entry["offset"]
        assert start == end
        if entry["type"] == "bit":
            end += (count + 7) // 8
            array = np.unpackbits(np.frombuffer(body[start:end], np.uint8), bitorder="little")
            assert not array[count:].any()
        else:
            kind = np.dtype(f"<{entry['type'][0]}{int(entry['type'][1:]) // 8}")
            end += count * kind.itemsize
            array = np.frombuffer(body[start:end], kind)
        assert hashlib.sha256(body[start:end]).hexdigest() == entry["sha256"], entry["name"]
        arrays[entry["name"]] = array[:count].reshape(entry["shape"])
    assert end == len(body)
    return arrays
