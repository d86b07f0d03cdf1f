"""Writes the safetensors files that are published; `oracle/safetensors.py` has their layout."""

import json
import struct

import numpy as np

from p4dgs_ref.oracle import safetensors


def dump(arrays, metadata=None):
    """Return the bytes of a file.

    Wide types come first, so that every tensor is aligned to its own width. Raises TensorError for
    a type that is not in DTYPES.
    """
    header = {"__metadata__": metadata} if metadata else {}
    parts, at = [], 0
    for name in sorted(arrays, key=lambda name: -np.asarray(arrays[name]).dtype.itemsize):
        record, data = safetensors.record_of(np.asarray(arrays[name]))
        header[name] = {**record, "data_offsets": [at, at + len(data)]}
        parts.append(data)
        at += len(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + b"".join(parts)
