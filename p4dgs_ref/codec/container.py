"""The file: a fixed header, a table of the sections with their checksums, and the sections.

All integers are unsigned and little-endian. CRC-32 is the checksum of zlib, PNG and gzip:
polynomial 0xEDB88320 (reflected), initial value and final XOR 0xFFFFFFFF.

Version 1 holds the paper's design. Version 2 holds the coded design, which goes beyond the paper:
it has the same sections with a smaller header, coded positions and this smaller frame around them.
What is said without a version holds for both.

VERSION 1.

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

The rows of the table, and therefore the sections, stand in strictly ascending order of id, so no
section occurs twice. The total length equals 18 + 9 S plus the lengths of all sections, and it is
the size of the file: every byte belongs to something. The numbers that a header may promise never
need more than 2^29 bytes.

A reader checks, in this order: the size (at least 18 bytes), magic, version, S, total length, the
checksum of the table, the ids and their order, the sum of the lengths, and the checksum of every
section. All but the last need the size of the file and its first 117 bytes only. The next part of
this page says which sections a model needs, and the last part before the tables (`published.py`)
names the kinds of errors and describes the expected numbers, the `.bin` files, of the streams on
which a decoder can be tried.

Worked numbers. The file whose only section is "masks" (id 7) with the bytes 01 02 03 has
18 + 9 + 3 = 30 bytes:

    89 50 34 44 0D 0A 1A 0A  01  01  1E 00 00 00    magic, version, S, total length
    07 03 00 00 00 1D 80 BC 55                      the row: id, length, CRC-32 of 01 02 03
    FB 2D 2B 50                                     CRC-32 of the 23 bytes so far
    01 02 03                                        the section

VERSION 2.

    offset      bytes  field
    0           8      magic number, as in version 1
    8           1      version, 2
    9           1      w, the number of bytes of a length, 1 to 4
    10          11 w   for each section id in ascending order, 0 where the file has no such section,
                       otherwise its length in bytes plus 1
    10 + 11 w   4      CRC-32 of all bytes of the file before and after this field
    14 + 11 w   ...    the sections' bytes in the order of their ids, without gaps

The lengths add up to the size of the file, which is at most 2^29 bytes. A reader checks in this
order: the size (at least 18 bytes), magic, version, w, the sum of the lengths, and the checksum.

Worked numbers. The file of the same section has 14 + 11 + 3 = 28 bytes:

    89 50 34 44 0D 0A 1A 0A  02  01                 magic, version, w
    00 00 00 00 00 00  04  00 00 00 00              a length of 3 for id 7
    0E 09 9B F7                                     CRC-32 of the 21 bytes before and the 3 behind
    01 02 03                                        the section
"""

import os
import struct
import zlib

from ..scenes.scene import MAX_FILE_BYTES

MAGIC = b"\x89P4D\r\n\x1a\n"
VERSIONS = 1, 2
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
FIXED_2 = len(MAGIC) + 2  # version 2: magic, version, w


class BitstreamError(ValueError):
    """A file that is damaged, or that no encoder of this version writes."""

    def __init__(self, section, offset, message):
        """`offset` counts bytes from the start of the section, or of the file for "container"."""
        super().__init__(f"section {section!r}, byte {offset}: {message}")
        self.section, self.offset, self.message = section, offset, message


def require(holds, section, offset, message):
    """Raise BitstreamError unless a condition holds."""
    if not holds:
        raise BitstreamError(section, offset, message)


def write_container(sections, version=1):
    """The file with these sections, {name: bytes} in any order."""
    rows = [(i, sections[name]) for i, name in enumerate(SECTIONS, 1) if name in sections]
    bodies = [body for _, body in rows]
    if version == 1:
        total = FIXED.size + ROW.size * len(rows) + CRC.size + sum(map(len, bodies))
        head = FIXED.pack(MAGIC, version, len(rows), total)
        head += b"".join(ROW.pack(i, len(body), zlib.crc32(body)) for i, body in rows)
        crc = zlib.crc32(head)
    else:
        numbers = [len(sections[name]) + 1 if name in sections else 0 for name in SECTIONS]
        w = (max(numbers).bit_length() + 7) // 8 or 1
        head = b"".join([MAGIC, bytes([version, w]), *(n.to_bytes(w, "little") for n in numbers)])
        crc = zlib.crc32(b"".join([head, *bodies]))
    return b"".join([head, CRC.pack(crc), *bodies])


def read_file(path):
    """The bytes of a file, which are read only after its frame was checked.

    Raises BitstreamError for a wrong frame, and OSError.
    """
    with open(path, "rb") as file:
        size, start = os.fstat(file.fileno()).st_size, file.read(LONGEST_FRAME)
        read_table(start, size)
        return start + file.read(size - len(start))


def read_container(data):
    """The sections of a file, {name: bytes} in the order of the file, after checking every byte.

    Raises BitstreamError whose `section` is "container" or the section with a wrong checksum.
    """
    return {name: bytes(body) for name, body in open_container(data).items()}


def open_container(data):
    """Like `read_container`, but without copying: {name: memoryview}."""
    rows, view = read_table(data, len(data)), memoryview(data)
    sections = {name: view[start : start + length] for name, start, length, _ in rows}
    if data[8] == 2:
        at = len(data) - sum(map(len, sections.values())) - CRC.size
        crc = zlib.crc32(view[at + CRC.size :], zlib.crc32(view[:at]))
        require(crc == CRC.unpack_from(data, at)[0], "container", at, "wrong checksum of the file")
        return sections
    for name, _, _, crc in rows:
        actual = zlib.crc32(sections[name])
        require(actual == crc, name, 0, f"checksum {actual:08x}, the section table says {crc:08x}")
    return sections


def layout(data):
    """What every byte of a file belongs to: a list of (name, bytes) whose sum is len(data).

    Checks the container header and the section table, but not the checksums of the sections.
    """
    parts = [(name, length) for name, _, length, _ in read_table(data, len(data))]
    head = FIXED.size if data[8] == 1 else FIXED_2
    rest = len(data) - head - sum(length for _, length in parts)
    return [("container_header", head), ("section_table", rest), *parts]


def read_table(data, size):
    """The checked rows of the section table: (name, offset in the file, length, CRC-32).

    `data` are the first LONGEST_FRAME bytes or more of a file of `size` bytes. In version 2 a row
    has no checksum.
    """
    least = FIXED.size + CRC.size
    require(
        min(len(data), size) >= least,
        "container",
        len(data),
        f"not a P-4DGS file: expected at least {least} bytes",
    )
    require(
        data[:8] == MAGIC,
        "container",
        0,
        f"not a P-4DGS file: wrong magic number, expected {MAGIC.hex(' ')}",
    )
    require(data[8] in VERSIONS, "container", 8, f"version {data[8]}, expected 1 or 2")
    return read_rows(data, size) if data[8] == 1 else read_lengths(data, size)


def read_rows(data, size):
    """The rows of a file of version 1."""
    _, _, count, total = FIXED.unpack_from(data)
    require(
        count <= len(SECTIONS),
        "container",
        9,
        f"{count} sections, expected at most {len(SECTIONS)}",
    )
    require(
        total == size <= MAX_FILE_BYTES,
        "container",
        10,
        f"total length {total}, expected the file's {size} bytes, at most {MAX_FILE_BYTES}",
    )
    end = FIXED.size + ROW.size * count
    require(
        CRC.pack(zlib.crc32(data[:end])) == data[end : end + CRC.size],
        "container",
        end,
        "wrong checksum of header and section table",
    )
    rows, start, last = [], end + CRC.size, 0
    for row in range(FIXED.size, end, ROW.size):
        number, length, crc = ROW.unpack_from(data, row)
        require(
            last < number <= len(SECTIONS),
            "container",
            row,
            f"section id {number} after {last}, expected ascending ids up to {len(SECTIONS)}",
        )
        rows.append((SECTIONS[number - 1], start, length, crc))
        start, last = start + length, number
    require(
        start == total,
        "container",
        FIXED.size,
        f"the lengths of the sections add up to {start}, not to {total}",
    )
    return rows


def read_lengths(data, size):
    """The rows of a file of version 2."""
    w = data[9]
    start = FIXED_2 + w * len(SECTIONS) + CRC.size
    require(1 <= w <= 4 and start <= size, "container", 9, f"lengths of {w} bytes, expected 1 to 4")
    rows = []
    for name, at in zip(SECTIONS, range(FIXED_2, start, w)):
        number = int.from_bytes(data[at : at + w], "little")
        if number:
            rows.append((name, start, number - 1, None))
            start += number - 1
    require(
        start == size <= MAX_FILE_BYTES,
        "container",
        FIXED_2,
        f"the lengths of the sections add up to {start} of {size} bytes",
    )
    return rows
