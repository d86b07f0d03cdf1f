"""Reads safetensors files: the length of a header, the header in JSON, the numbers.

bytes 0 to 7     length n of the header, unsigned, little-endian
n bytes          JSON {name: {"dtype": "F64", "shape": [5, 3], "data_offsets": [from, to]}},
                 padded with spaces
the rest         the numbers, row by row, little-endian; offsets count from here, and tensors follow
                 each other without a gap
"""

import json
import math
from typing import Any

import numpy as np

from ..messages import shorten

MAX_HEADER_BYTES = 2**20  # a larger length is damaged
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
    """A file is invalid. The message is one line with the field and what was expected."""


def record_of(array):
    """Return {dtype, shape} of an array and its bytes; `array_of` undoes it."""
    dtype = NAMES.get(array.dtype.newbyteorder("<"))
    require_tensor(dtype, "dtype", f"expected one of {', '.join(DTYPES)}, got {array.dtype}")
    return {"dtype": dtype, "shape": list(array.shape)}, array.astype(DTYPES[dtype]).tobytes()


def load(data):
    """Return every tensor in the bytes of a file, {name: array}. Raises TensorError."""
    length = int.from_bytes(data[:8], "little") if len(data) >= 8 else 0
    require_tensor(
        length <= MAX_HEADER_BYTES,
        "header",
        f"expected a length of at most {MAX_HEADER_BYTES} bytes, got {length}",
    )
    header, body, arrays = json_object(data[8 : 8 + length]), memoryview(data)[8 + length :], {}
    require_tensor(
        header is not None and 8 + length <= len(data),
        "header",
        "expected its length in 8 bytes and a JSON object",
    )
    header.pop("__metadata__", None)
    for name, record in header.items():
        offsets: Any = record.get("data_offsets") if isinstance(record, dict) else None
        require_tensor(
            naturals(offsets) and len(offsets) == 2,
            f"{name}.data_offsets",
            "expected two non-negative integers",
        )
        arrays[name] = array_of(name, record, body[slice(*offsets)])
    return arrays


def array_of(name, record, data):
    """Return the array that `dtype` and `shape` of a record describe. Raises TensorError."""
    code, shape = DTYPES.get(str(record.get("dtype"))), record.get("shape")
    require_tensor(
        code,
        f"{name}.dtype",
        f"expected one of {', '.join(DTYPES)}; bfloat16 is not judged; the vectors' page says why",
    )
    require_tensor(
        naturals(shape) and len(shape) <= 32 and max(shape, default=0) < 2**31,
        f"{name}.shape",
        "expected a list of non-negative integers",
    )
    size = math.prod(shape) * np.dtype(code).itemsize  # Python's integers do not overflow
    require_tensor(
        len(data) == size,
        name,
        f"expected {size} bytes for {record['dtype']} {shape}, got {len(data)}",
    )
    require_tensor(
        code != "|b1" or not bytes(data).strip(b"\0\1"), name, "expected bytes 0 and 1 for BOOL"
    )
    return np.frombuffer(data, code).reshape(shape)


def require_tensor(condition, where, expected):
    """Raise a TensorError unless the condition holds."""
    if not condition:
        raise TensorError(shorten(f"{where}: {expected}"))


def json_object(text) -> Any:
    """Return the object in a JSON text, or None if the text is not a JSON object."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def naturals(value):
    """Whether a value from JSON is a list of non-negative integers."""
    return isinstance(value, list) and all(type(n) is int and n >= 0 for n in value)
