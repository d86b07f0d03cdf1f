"""The file: a fixed header, a table of the sections with their checksums, and the sections.

All integers are unsigned and little-endian. CRC-32 is the checksum of zlib, PNG and gzip:
polynomial 0xEDB88320 (reflected), initial value and final XOR 0xFFFFFFFF.

    offset      bytes  field
    0           8      magic number 89 50 34 44 0D 0A 1A 0A: "P4D" between bytes that a transfer in
                       text mode or with 7 bits would change
    8           1      version, 1
    9           1      S, the number of sections, 0 to 11
    10          4      total length of the file in bytes, at most 2^29
    14          9 S    section table, one row per section: id (1 byte), length in bytes (4 bytes),
                       CRC-32 of the section's bytes (4 bytes)
    14 + 9 S    4      CRC-32 of all bytes before this field
    18 + 9 S    ...    the sections' bytes in the order of the table, without gaps

The section ids are

    1 header     2 positions    3 features    4 scales             5 offset_scales    6 offsets
    7 masks      8 hash_grid    9 deformation_mlp    10 anchor_mlps    11 context_mlps

The rows of the table, and therefore the sections, are in strictly ascending order of id, so no
section occurs twice. The total length equals 18 + 9 S plus the lengths of all sections, and it is
the size of the file: there are no unused bytes. No model within the limits of the header
(`header.py`) needs more than 2^29 bytes.

A reader checks, in this order: the size (at least 18 bytes), magic, version, S, total length, the
checksum of the table, the ids and their order, the sum of the lengths, and the checksum of every
section. All but the last need only the size of the file and its first 117 bytes. The next part of
this page says which sections a model needs. `p4dgs-ref oracle export` writes small files that test
a decoder: valid ones with their decoded contents, and files that it must refuse.

Worked example. The file whose only section is "masks" (id 7) with the bytes 01 02 03 has
18 + 9 + 3 = 30 bytes:

    89 50 34 44 0D 0A 1A 0A  01  01  1E 00 00 00    magic, version, S, total length
    07 03 00 00 00 1D 80 BC 55                      the row: id, length, CRC-32 of 01 02 03
    FB 2D 2B 50                                     CRC-32 of the 23 bytes so far
    01 02 03                                        the section
"""

import os
import struct
import zlib

from ..limits import MAX_FILE_BYTES

MAGIC = b"\x89P4D\r\n\x1a\n"
VERSION = 1
SECTIONS = (  # an id is a position in this tuple, counted from 1
    "header",
    "positions",
    "features",
    "scales",
    "offset_scales",
    "offsets",
    "masks",
    "hash_grid",
    "deformation_mlp",
    "anchor_mlps",
    "context_mlps",
)
FIXED = struct.Struct("<8sBBI")  # magic, version, S, total length
ROW = struct.Struct("<BII")  # id, length, CRC-32
CRC = struct.Struct("<I")
LONGEST_FRAME = FIXED.size + ROW.size * len(SECTIONS) + CRC.size


class BitstreamError(ValueError):
    """A file that is damaged, or that no encoder of this version writes."""

    def __init__(self, section, offset, message):
        """Store the place of the mistake beside the message.

        `offset` counts bytes from the start of the section, or of the file for "container".
        """
        super().__init__(f"section {section!r}, byte {offset}: {message}")
        self.section, self.offset, self.message = section, offset, message


class EncodeError(ValueError):
    """A model that the format cannot store; the message names the array and what was expected."""


def expect(holds, section, offset, message):
    """Raise BitstreamError unless a condition holds."""
    if not holds:
        raise BitstreamError(section, offset, message)


def require_encodable(holds, message):
    """Raise EncodeError unless a condition holds."""
    if not holds:
        raise EncodeError(message)


def write_container(sections):
    """Return the file with these sections, {name: bytes} in any order."""
    rows = [(i, sections[name]) for i, name in enumerate(SECTIONS, 1) if name in sections]
    total = FIXED.size + ROW.size * len(rows) + CRC.size + sum(len(body) for _, body in rows)
    head = FIXED.pack(MAGIC, VERSION, len(rows), total)
    head += b"".join(ROW.pack(i, len(body), zlib.crc32(body)) for i, body in rows)
    return b"".join([head, CRC.pack(zlib.crc32(head)), *(body for _, body in rows)])


def read_file(path):
    """Return the bytes of a file; the bulk is read only after its header and table are checked.

    Raises BitstreamError if one of these is wrong, and OSError.
    """
    with open(path, "rb") as file:
        size, start = os.fstat(file.fileno()).st_size, file.read(LONGEST_FRAME)
        read_table(start, size)
        return start + file.read(size - len(start))


def read_container(data):
    """Return the sections of a file, {name: memoryview} in its order, after checking every byte.

    Raises BitstreamError whose `section` is "container" or the section with a wrong checksum.
    """
    message = f"expected the bytes of a file, got {type(data).__name__}"
    expect(isinstance(data, (bytes, bytearray, memoryview)), "container", 0, message)
    rows, view = read_table(data, len(data)), memoryview(data)
    sections = {name: view[start : start + length] for name, start, length, _ in rows}
    for name, _, _, crc in rows:
        computed = zlib.crc32(sections[name])
        message = f"checksum {computed:08x}, the section table says {crc:08x}"
        expect(computed == crc, name, 0, message)
    return sections


def layout(data):
    """Return what every byte of a file belongs to: (name, bytes) pairs that add up to len(data).

    Checks the container header and the section table, but not the checksums of the sections.
    """
    parts = [(name, length) for name, _, length, _ in read_table(data, len(data))]
    table = len(data) - FIXED.size - sum(length for _, length in parts)
    return [("container_header", FIXED.size), ("section_table", table), *parts]


def require_magic(data, size):
    """Refuse a file of `size` bytes that is too short or does not begin with the magic number."""
    least = FIXED.size + CRC.size
    expect(
        min(len(data), size) >= least,
        "container",
        len(data),
        f"not a P-4DGS file: expected at least {least} bytes",
    )
    expect(
        data[:8] == MAGIC,
        "container",
        0,
        f"not a P-4DGS file: wrong magic number, expected {MAGIC.hex(' ')}",
    )


def read_table(data, size):
    """Return the checked rows of the section table: (name, offset in the file, length, CRC-32).

    `data` are the first LONGEST_FRAME bytes or more of a file of `size` bytes.
    """
    require_magic(data, size)
    expect(data[8] == VERSION, "container", 8, f"version {data[8]}, expected {VERSION}")
    _, _, count, total = FIXED.unpack_from(data)
    expect(
        count <= len(SECTIONS),
        "container",
        9,
        f"{count} sections, expected at most {len(SECTIONS)}",
    )
    expect(
        total == size <= MAX_FILE_BYTES,
        "container",
        10,
        f"total length {total}, expected the file's {size} bytes, at most {MAX_FILE_BYTES}; "
        "is the file complete?",
    )
    end = FIXED.size + ROW.size * count
    expect(
        CRC.pack(zlib.crc32(data[:end])) == data[end : end + CRC.size],
        "container",
        end,
        "wrong checksum of header and section table",
    )
    rows, start, last = [], end + CRC.size, 0
    for row in range(FIXED.size, end, ROW.size):
        number, length, crc = ROW.unpack_from(data, row)
        expect(
            last < number <= len(SECTIONS),
            "container",
            row,
            f"section id {number} after {last}, expected ascending ids up to {len(SECTIONS)}",
        )
        rows.append((SECTIONS[number - 1], start, length, crc))
        start, last = start + length, number
    expect(
        start == total,
        "container",
        FIXED.size,
        f"the lengths of the sections add up to {start}, not to {total}",
    )
    return rows
