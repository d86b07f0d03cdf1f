"""Ways to damage a file, for `fuzz`.

RAW damage leaves lengths and checksums as they were, so a decoder must refuse every changed file.
REPAIRED damage makes them valid again and so reaches the content: the bytes of one section, fields
of the JSON header or of the container's table, and sections exchanged, repeated or missing.
"""

import json
import struct
import zlib
from typing import NamedTuple

import numpy as np

from p4dgs_ref.codec.container import MAGIC, SECTIONS, layout, read_container, write_container

# Values that a field of the header is set to, whatever its type.
VALUES = [
    *(0, 1, 2, 3, 5, 8, 255, 2**16, 2**22, 2**31, 10**400),
    *(-1, 0.5, 1e300, -0.0, True, None),
    *("", "xyz", [], {}, [0], [1, 2], [8, 8], [2**14] * 8),
    *([["xyz", 300]], [["xy", 9], ["yz", 2]], ["rotation"], [0.1] * 3, [1e-30] * 4),
]


class Mutation(NamedTuple):
    """A damaged file."""

    kind: str  # raw or repaired, and the operation: "raw flip"
    data: bytes
    original: bytes  # the good file it was made from


def sections_in(data):
    """The sections of a file, {name: bytes}."""
    return {name: bytes(body) for name, body in read_container(data).items()}


def mutation(seed, i, files):
    """Mutation number i of a seed, of one of several good files: the same on every machine."""
    rng = np.random.default_rng([seed, i])
    data, repaired = files[rng.integers(len(files))], bool(rng.integers(2))
    kinds = (damage_bytes, damage_bytes, damage_bytes, damage_sections, damage_table, damage_header)
    what, damaged = kinds[rng.integers(6)](rng, data, repaired)
    return Mutation(f"{'repaired' if repaired else 'raw'} {what}", damaged, data)


def damage_bytes(rng, data, repaired):
    """One operation on the bytes of the file; repaired: on one section, with new checksums."""
    operations = (truncate, extend, flip, overwrite, insert, remove, repeat, exchange)
    operation = operations[rng.integers(8)]
    if not repaired:
        return operation.__name__, operation(rng, data)
    sections = sections_in(data)
    name = [*sections][rng.integers(len(sections))]
    sections[name] = operation(rng, sections[name])
    return operation.__name__, write_container(sections)


def stretch(rng, data):
    """Start and end of up to 40 consecutive bytes."""
    start = int(rng.integers(len(data) + 1))
    return start, min(start + int(rng.integers(1, 41)), len(data))


def truncate(rng, data):
    return data[: rng.integers(len(data) + 1)]


def extend(rng, data):
    return data + rng.bytes(int(rng.integers(1, 65)))


def flip(rng, data):
    bad = bytearray(data)
    for at in rng.integers(0, 8 * len(data), int(rng.integers(1, 9))) if data else ():
        bad[at // 8] ^= 1 << int(at % 8)
    return bytes(bad)


def overwrite(rng, data):
    a, b = stretch(rng, data)
    noise = rng.bytes(b - a) if rng.integers(2) else rng.bytes(1) * (b - a)
    return data[:a] + noise + data[b:]


def insert(rng, data):
    a, _ = stretch(rng, data)
    return data[:a] + rng.bytes(int(rng.integers(1, 9))) + data[a:]


def remove(rng, data):
    a, b = stretch(rng, data)
    return data[:a] + data[b:]


def repeat(rng, data):
    a, b = stretch(rng, data)
    return data[:b] + data[a:b] + data[b:]


def exchange(rng, data):
    a, b, c = sorted(rng.integers(0, len(data) + 1, 3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def damage_sections(rng, data, repaired):
    """Two sections or their bodies exchanged, one repeated, or one missing.

    Raw: the section table still describes the old order.
    """
    rows = [(SECTIONS.index(name) + 1, body) for name, body in sections_in(data).items()]
    kinds = ("sections exchanged", "bodies exchanged", "section twice", "section missing")
    what = kinds[rng.integers(4)]
    end, (i, j) = frame_of(data), rng.choice(len(rows), 2, replace=False)
    if what == "sections exchanged":
        rows[i], rows[j] = rows[j], rows[i]
    elif what == "bodies exchanged":
        rows[i], rows[j] = (rows[i][0], rows[j][1]), (rows[j][0], rows[i][1])
    elif what == "section twice":
        rows.insert(j, rows[i])
    else:
        del rows[i]
    if repaired:
        return what, assemble(rows)
    return what, data[:end] + b"".join(body for _, body in rows)


def frame_of(data):
    """The bytes of a file before its first section."""
    return sum(size for _, size in layout(data)[:2])


def assemble(rows):
    """A container of any rows (id, body) in any order, with valid lengths and checksums."""
    return framed([(i, len(body), body) for i, body in rows])


def framed(rows, magic=MAGIC, version=1, total=None, tail=b""):
    """A file of any rows (id, length, body), valid or not, with valid checksums."""
    bodies = b"".join(body for _, _, body in rows) + tail
    size = 18 + 9 * len(rows) + len(bodies)
    head = magic + struct.pack("<BBI", version, len(rows), size if total is None else total)
    for number, length, body in rows:
        head += struct.pack("<BII", number, length, zlib.crc32(body))
    return head + struct.pack("<I", zlib.crc32(head)) + bodies


def damage_table(rng, data, repaired):
    """One field of the container header or the section table; repaired: with a valid checksum."""
    end = frame_of(data) - 4
    fields = [(0, 8), (8, 1), (9, 1), (10, 4)]  # (offset, bytes)
    for row in range(14, end, 9):
        fields += [(row, 1), (row + 1, 4), (row + 5, 4)]
    at, size = fields[rng.integers(len(fields))]
    old = int.from_bytes(data[at : at + size], "little")
    values = [0, 1, old + 1, old - 1, old + 9, 2**31, 2**32 - 1, int(rng.integers(2**32))]
    new = values[rng.integers(8)] % 256**size
    head = data[:at] + new.to_bytes(size, "little") + data[at + size : end]
    crc = zlib.crc32(head).to_bytes(4, "little") if repaired else data[end : end + 4]
    return "table field", head + crc + data[end + 4 :]


def damage_header(rng, data, repaired):
    """One to three fields of the JSON header get another value or a near one, or are removed."""
    sections = sections_in(data)
    fields = json.loads(sections["header"])
    for name in rng.choice([*fields], int(rng.integers(1, 4)), replace=False):
        how = rng.random()
        if how < 0.1:
            del fields[name]
        elif how < 0.5:
            fields[name] = nudged(rng, fields[name])
        else:
            fields[name] = VALUES[rng.integers(len(VALUES))]
    header = json.dumps(fields, separators=(",", ":")).encode()
    if repaired:
        return "header field", write_container({**sections, "header": header})
    start = frame_of(data)
    return "header field", data[:start] + header + data[start + len(sections["header"]) :]


def nudged(rng, value):
    """A JSON value with one of its numbers slightly changed."""
    if isinstance(value, list) and value:
        i = int(rng.integers(len(value)))
        return [*value[:i], nudged(rng, value[i]), *value[i + 1 :]]
    if isinstance(value, (int, float)):
        return value + int(rng.choice([-1, 1, 7]))
    return value
