"""Reads and writes safetensors files: the length of a header, the header in JSON, the numbers.

bytes 0 to 7     length n of the header, unsigned, little-endian
n bytes          JSON {name: {"dtype": "F64", "shape": [5, 3], "data_offsets": [from, to]}},
                 padded with spaces
the rest         the numbers, row by row, little-endian; offsets count from here, and tensors follow
                 each other without a gap
"""

import json
import math
import struct
from typing import Any

import numpy as np

DTYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "|i1",
    "U64": "<u8",
    "U32": "<u4",
    "U16": "<u2",
    "U8": "|u1",
    "BOOL": "|b1",
}
NAMES = {np.dtype(code): name for name, code in DTYPES.items()}


class TensorError(ValueError):
    """A file is invalid. The message is one line with the file, the field and what was expected."""


def dump(arrays, metadata=None):
    """Return the bytes of a file and the place of every tensor in it.

    The places are {name: {dtype, shape, offset, bytes}}, offsets counting from byte 0. Wide types
    come first, so that every tensor is aligned to its own width. Raises KeyError for a type that is
    not in DTYPES.
    """
    header = {"__metadata__": metadata} if metadata else {}
    parts, places, at = [], {}, 0
    for name in sorted(arrays, key=lambda name: -np.asarray(arrays[name]).dtype.itemsize):
        array = np.asarray(arrays[name])
        dtype, shape = NAMES[array.dtype.newbyteorder("<")], list(array.shape)
        data = array.astype(DTYPES[dtype]).tobytes()
        header[name] = {"dtype": dtype, "shape": shape, "data_offsets": [at, at + len(data)]}
        places[name] = {"dtype": dtype, "shape": shape, "offset": at, "bytes": len(data)}
        parts.append(data)
        at += len(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    for place in places.values():
        place["offset"] += 8 + len(text)
    return struct.pack("<Q", len(text)) + text + b"".join(parts), places


def load(data, source: object = "safetensors"):
    """Return every tensor in the bytes of a file, {name: array}. Raises TensorError."""

    def need(condition, field, expected):
        if not condition:
            raise TensorError(f"{source}: {field}: expected {expected}")

    need(len(data) >= 8, "length", "at least the 8 bytes of the header's length")
    n, rest = struct.unpack("<Q", data[:8])[0], len(data) - 8
    need(n <= rest, "header", f"{n} bytes, the file has {rest} after its length")
    header = json_object(data[8 : 8 + n])
    need(header is not None, "header", "a JSON object")
    header.pop("__metadata__", None)
    body, arrays = memoryview(data)[8 + n :], {}
    for name, h in header.items():
        known = isinstance(header[name], dict) and str(h.get("dtype")) in DTYPES
        said = f"one of {', '.join(DTYPES)}; bfloat16 is not judged, the vectors' page says why"
        need(known, f"{name}.dtype", said)
        shape, offsets = h.get("shape"), h.get("data_offsets")
        need(naturals(shape), f"{name}.shape", "a list of integers, none of them negative")
        two = naturals(offsets) and len(offsets) == 2
        need(two, f"{name}.data_offsets", "two integers, none of them negative")
        dtype, (start, end) = np.dtype(DTYPES[h["dtype"]]), offsets
        size = math.prod(shape) * dtype.itemsize  # Python's integers do not overflow
        said = f"{size} bytes for {h['dtype']} {shape} within the {len(body)} of the file"
        inside = start <= end <= len(body) and end - start == size
        need(inside, f"{name}.data_offsets", f"{said}, got {start} to {end}")
        arrays[name] = np.frombuffer(body[start:end], dtype).reshape(shape)
    return arrays


def json_object(text) -> Any:
    """Return the object that a text in JSON describes, or None where it describes none."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def naturals(value):
    """Whether a value from JSON is a list of integers, none of them negative."""
    return isinstance(value, list) and all(type(n) is int and n >= 0 for n in value)
