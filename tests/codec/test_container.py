"""The container accounts for every byte and refuses every damage."""

import struct
import zlib

import numpy as np
import pytest

from p4dgs_ref.codec.container import (
    SECTIONS,
    BitstreamError,
    layout,
    read_container,
    write_container,
)


@pytest.fixture
def sections():
    rng = np.random.default_rng(0)
    return {name: rng.bytes(int(rng.integers(0, 60))) for name in SECTIONS} | {"masks": b""}


def repaired(data):
    """The same file with the right checksum of header and section table."""
    end = 14 + 9 * data[9]
    return data[:end] + struct.pack("<I", zlib.crc32(data[:end])) + data[end + 4 :]


def refused(data):
    with pytest.raises(BitstreamError) as caught:
        read_container(data)
    return caught.value


def test_round_trip_in_any_order(sections):
    data = write_container(sections)
    assert read_container(data) == sections
    assert list(read_container(data)) == list(SECTIONS)
    assert write_container(dict(reversed(sections.items()))) == data
    some = {name: sections[name] for name in ("offsets", "header")}
    assert read_container(write_container(some)) == some
    assert read_container(write_container({})) == {}


def test_worked_numbers():
    assert write_container({"masks": b"\1\2\3"}).hex(" ") == (
        "89 50 34 44 0d 0a 1a 0a 01 01 1e 00 00 00 07 03 00 00 00 1d 80 bc 55 fb 2d 2b 50 01 02 03"
    )


def test_layout_names_every_byte(sections):
    data = write_container(sections)
    rows = layout(data)
    assert sum(size for _, size in rows) == len(data)
    assert rows[:2] == [("container_header", 14), ("section_table", 9 * 11 + 4)]
    assert dict(rows[2:]) == {name: len(body) for name, body in sections.items()}


def test_unknown_section_is_not_written():
    with pytest.raises(ValueError, match="section 'colours': expected one of header"):
        write_container({"colours": b""})


def test_every_truncation_and_every_flipped_bit_is_refused(sections):
    data = write_container(sections)
    for n in range(len(data)):
        refused(data[:n])
    for at in range(8 * len(data)):
        bad = bytearray(data)
        bad[at // 8] ^= 1 << at % 8
        refused(bytes(bad))


def test_seeded_mutations_are_refused(sections):
    data, rng = write_container(sections), np.random.default_rng(1)
    for _ in range(2000):
        bad = bytearray(data)
        for _ in range(int(rng.integers(1, 6))):
            bad[int(rng.integers(len(bad)))] = int(rng.integers(256))
        if bad != data:
            refused(bytes(bad))


@pytest.mark.parametrize(
    "change, at, message",
    [
        (lambda d: b"\x88" + d[1:], 0, "magic"),
        (lambda d: d.replace(b"\r\n", b"\n"), 0, "magic"),
        (lambda d: d[:8] + b"\3" + d[9:], 8, "version 3"),
        (lambda d: d[:9] + b"\xff" + d[10:], 9, "255 sections"),
        (lambda d: d + b"\0", 10, "total length"),
        (lambda d: b"", 0, "at least"),
    ],
)
def test_refusals_name_the_place(sections, change, at, message):
    error = refused(change(write_container(sections)))
    assert (error.section, error.offset) == ("container", at)
    assert message in str(error)


def test_wrong_order_or_repetition_is_refused_although_the_checksum_is_right(sections):
    data = write_container(sections)
    rows = [data[14 + 9 * i : 23 + 9 * i] for i in range(11)]
    for i, j in ((0, 1), (3, 9)):
        table = list(rows)
        table[i], table[j] = table[j], table[i]
        error = refused(repaired(data[:14] + b"".join(table) + data[113:]))
        assert error.section == "container"
        assert "ascending" in error.message
        assert (error.offset - 14) % 9 == 0
    again = rows[:5] + [rows[4]] + rows[6:]
    assert "id 5 after 5" in refused(repaired(data[:14] + b"".join(again) + data[113:])).message
    for number in (0, 12, 255):
        assert "ascending" in refused(repaired(data[:104] + bytes([number]) + data[105:])).message


def test_absurd_lengths_are_refused_although_the_checksum_is_right(sections):
    data = write_container(sections)
    for length in (0, 2**32 - 1):
        bad = repaired(data[:15] + struct.pack("<I", length) + data[19:])
        assert bad != data
        assert "add up" in refused(bad).message
    empty = write_container({})
    assert "do not fit" in refused(empty[:9] + b"\x0b" + empty[10:]).message


def test_damaged_section_is_named(sections):
    data = bytearray(write_container(sections))
    data[-1] ^= 1
    last = [name for name in SECTIONS if sections[name]][-1]
    error = refused(bytes(data))
    assert error.section == last
    assert str(error).startswith(f"section '{last}', byte 0: checksum")
