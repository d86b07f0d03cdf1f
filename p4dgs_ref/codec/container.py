"""The file: a fixed header, a table of sections with a checksum each, and the sections' bytes.

FORMAT.  All integers are unsigned and little-endian.  CRC-32 is that of zlib, PNG and gzip
(polynomial 0xEDB88320 reflected, start and final xor 0xFFFFFFFF).

    offset      bytes  field
    0           8      magic 89 50 34 44 0D 0A 1A 0A: "P4D" between bytes that a text-mode or 7-bit copy damages
    8           1      version, 1
    9           1      S, the number of sections, 0..11
    10          4      total length of the file in bytes, at most 2^32 - 1
    14          9 S    S rows of the section table: id (1), length (4), CRC-32 of the section's bytes (4)
    14 + 9 S    4      CRC-32 of all bytes before this field
    18 + 9 S    ...    the sections, back to back in the order of the table

Ids are the positions in `SECTIONS`, counted from 1; rows stand in strictly ascending order of id, so a section
occurs at most once.  18 + 9 S plus all lengths is the total length is the size of the file: no byte is unaccounted for.
A reader checks in this order: size, magic, version, S, total length, table checksum, ids and their order, sum of the
lengths, checksum of every section.  Which sections a model needs is decided by who decodes them.

WORKED NUMBERS.  The file of one section "masks" (id 7) with the bytes 01 02 03 has 18 + 9 + 3 = 30 bytes:
    89 50 34 44 0D 0A 1A 0A  01  01  1E 00 00 00  07 03 00 00 00 1D 80 BC 55  FB 2D 2B 50  01 02 03
"""

import struct
import zlib

MAGIC = b"\x89P4D\r\n\x1a\n"
VERSION = 1
SECTIONS = (
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
MAX_LENGTH = 2**32 - 1
_FIXED, _ROW, _CRC = struct.Struct("<8sBBI"), struct.Struct("<BII"), struct.Struct("<I")


class BitstreamError(ValueError):
    """A file or section that is damaged, or that no encoder of this version writes."""

    def __init__(self, section, offset, message):
        """`offset` counts bytes from the start of the section, or of the file for "container"."""
        super().__init__(f"section {section!r}, byte {offset}: {message}")
        self.section, self.offset, self.message = section, offset, message


def write_container(sections):
    """Put sections into one file.

    Shapes     sections: {name of SECTIONS: bytes}, in any order -> bytes
    Raises     ValueError for an unknown name or more than 2^32 - 1 bytes
    """
    unknown = sorted(set(sections) - set(SECTIONS))
    if unknown:
        raise ValueError(f"section {unknown[0]!r}: one of {', '.join(SECTIONS)} expected")
    rows = [(i, sections[name]) for i, name in enumerate(SECTIONS, 1) if name in sections]
    total = _FIXED.size + _ROW.size * len(rows) + _CRC.size + sum(len(body) for _, body in rows)
    if total > MAX_LENGTH:
        raise ValueError(f"file of {total} bytes: at most {MAX_LENGTH} expected")
    head = _FIXED.pack(MAGIC, VERSION, len(rows), total)
    head += b"".join(_ROW.pack(i, len(body), zlib.crc32(body)) for i, body in rows)
    return b"".join([head, _CRC.pack(zlib.crc32(head)), *(body for _, body in rows)])


def read_container(data):
    """Take a file apart after checking every byte of it.

    Shapes     bytes -> {name: bytes} in the order of the file
    Raises     BitstreamError; `section` is "container" or the section whose checksum fails
    """
    return {name: bytes(body) for name, body in open_container(data).items()}


def open_container(data):
    """`read_container` without copies: {name: memoryview}.

    Raises     BitstreamError as `read_container`
    """
    sections, whole = {}, memoryview(data)
    for name, start, length, crc in _read_table(data):
        body = whole[start : start + length]
        if zlib.crc32(body) != crc:
            raise BitstreamError(
                name, 0, f"checksum {zlib.crc32(body):08x}, the table says {crc:08x}"
            )
        sections[name] = body
    return sections


def layout(data):
    """Whom every byte of a file belongs to: a list of (name, bytes) whose sum is len(data).

    Raises     BitstreamError where `read_container` does, but for the sections' own checksums
    """
    rows = _read_table(data)
    return [
        ("container_header", _FIXED.size),
        ("section_table", _ROW.size * len(rows) + _CRC.size),
        *((name, length) for name, _, length, _ in rows),
    ]


def _read_table(data):
    """Rows (name, offset in the file, length, CRC-32) of a file whose header and table are sound."""
    if len(data) < _FIXED.size + _CRC.size:
        raise BitstreamError(
            "container", len(data), f"at least {_FIXED.size + _CRC.size} bytes expected"
        )
    magic, version, count, total = _FIXED.unpack_from(data)
    if magic != MAGIC:
        raise BitstreamError("container", 0, "not a P-4DGS file (wrong magic)")
    if version != VERSION:
        raise BitstreamError("container", 8, f"version {version}, only {VERSION} is known")
    if count > len(SECTIONS):
        raise BitstreamError("container", 9, f"{count} sections, at most {len(SECTIONS)} expected")
    if total != len(data):
        raise BitstreamError(
            "container", 10, f"total length {total}, the file has {len(data)} bytes"
        )
    table_end = _FIXED.size + _ROW.size * count
    if table_end + _CRC.size > total:
        raise BitstreamError("container", 9, f"{count} sections do not fit into {total} bytes")
    if zlib.crc32(data[:table_end]) != _CRC.unpack_from(data, table_end)[0]:
        raise BitstreamError("container", table_end, "checksum of header and section table fails")
    rows, start, last = [], table_end + _CRC.size, 0
    for row in range(_FIXED.size, table_end, _ROW.size):
        number, length, crc = _ROW.unpack_from(data, row)
        if not last < number <= len(SECTIONS):
            raise BitstreamError(
                "container",
                row,
                f"section id {number} after {last}: ascending ids to {len(SECTIONS)} expected",
            )
        rows.append((SECTIONS[number - 1], start, length, crc))
        start, last = start + length, number
    if start != total:
        raise BitstreamError(
            "container", _FIXED.size, f"lengths of the sections add up to {start}, not to {total}"
        )
    return rows
