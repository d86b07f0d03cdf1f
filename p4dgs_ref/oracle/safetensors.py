"""The safetensors format in a few lines: 8 bytes of length, a JSON header, raw little-endian numbers.

bytes 0 to 7     length n of the header, unsigned, little-endian
n bytes          JSON {name: {"dtype": "F64", "shape": [5, 3], "data_offsets": [from, to]}}, padded with spaces
the rest         the numbers, row by row; offsets count from here, tensors follow each other without a gap
"""

import json
import struct

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
LONGEST_HEADER = 100_000_000  # the limit of the format


class TensorError(ValueError):
    """A file that does not hold what it should: one line naming file, field and expectation."""


def dump(arrays, metadata=None):
    """Bytes of a file and where every tensor lies in it: (bytes, {name: {dtype, shape, offset, bytes}}).

    Shapes     arrays {name: array of any shape, also () and empty}, of a type in DTYPES; offsets count from byte 0
    Raises     KeyError for another type
    Choice     wide types first, so that every tensor is aligned to its own width
    """
    header, parts, at = {"__metadata__": metadata} if metadata else {}, [], 0
    for name in sorted(arrays, key=lambda name: -np.asarray(arrays[name]).dtype.itemsize):
        array = np.asarray(arrays[name])
        dtype = NAMES[array.dtype.newbyteorder("<")]
        parts.append(array.astype(DTYPES[dtype]).tobytes())
        header[name] = {
            "dtype": dtype,
            "shape": list(array.shape),
            "data_offsets": [at, at + len(parts[-1])],
        }
        at += len(parts[-1])
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    places = {
        name: {
            "dtype": h["dtype"],
            "shape": h["shape"],
            "offset": 8 + len(text) + h["data_offsets"][0],
            "bytes": h["data_offsets"][1] - h["data_offsets"][0],
        }
        for name, h in header.items()
        if name != "__metadata__"
    }
    return struct.pack("<Q", len(text)) + text + b"".join(parts), places


def load(data, source="safetensors"):
    """Every tensor of a file's bytes: {name: array}.

    Raises     TensorError
    """

    def need(condition, field, expected):
        if not condition:
            raise TensorError(f"{source}: {field}: expected {expected}")

    need(len(data) >= 8, "length", "at least the 8 bytes of the header's length")
    n = struct.unpack("<Q", data[:8])[0]
    need(
        n <= min(len(data) - 8, LONGEST_HEADER),
        "header",
        f"{n} bytes, the file has {len(data) - 8} after its length",
    )
    try:
        header = json.loads(data[8 : 8 + n])
        need(isinstance(header, dict), "header", "a JSON object")
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        need(False, "header", "a JSON object")
    body, arrays = memoryview(data)[8 + n :], {}
    for name, h in header.items():
        if name == "__metadata__":
            continue
        need(
            isinstance(h, dict) and isinstance(h.get("dtype"), str) and h["dtype"] in DTYPES,
            f"{name}.dtype",
            f"one of {', '.join(DTYPES)}",
        )
        need(_naturals(h.get("shape")), f"{name}.shape", "a list of whole numbers")
        need(
            _naturals(h.get("data_offsets")) and len(h["data_offsets"]) == 2,
            f"{name}.data_offsets",
            "two whole numbers",
        )
        dtype, (start, end) = np.dtype(DTYPES[h["dtype"]]), h["data_offsets"]
        count = 1
        for length in h["shape"]:
            count *= length  # of Python's integers: nothing overflows
        need(
            start <= end <= len(body) and end - start == count * dtype.itemsize,
            f"{name}.data_offsets",
            f"{count * dtype.itemsize} bytes for {h['dtype']} {h['shape']} within the {len(body)} of the file, "
            f"got {start} to {end}",
        )
        arrays[name] = np.frombuffer(body[start:end], dtype).reshape(h["shape"])
    return arrays


def _naturals(value):
    return isinstance(value, list) and all(type(n) is int and n >= 0 for n in value)
