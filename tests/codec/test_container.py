"""The container accounts for every byte and refuses every damage.

Of a file with a wrong frame only the frame is read.
"""

import struct
import zlib

import numpy as np
import pytest

from p4dgs_ref.codec import container
from p4dgs_ref.codec.container import (
    MAGIC,
    SECTIONS,
    layout,
    read_container,
    read_file,
    write_container,
)
from tests.codec.models import flips, prefixes, refusal, traced
from tests.workshop.conformance_good import GOOD, stream_of

EMPTY = write_container({})


@pytest.fixture(scope="module")
def sections():
    rng = np.random.default_rng(0)
    return {name: rng.bytes(int(rng.integers(0, 60))) for name in SECTIONS} | {"masks": b""}


def repaired(data):
    """The same file with the right checksum of header and section table."""
    end = 14 + 9 * data[9]
    return data[:end] + struct.pack("<I", zlib.crc32(data[:end])) + data[end + 4 :]


def test_round_trip_in_any_order(sections):
    data = write_container(sections)
    assert read_container(data) == sections
    assert list(read_container(data)) == list(SECTIONS)
    assert write_container(dict(reversed(sections.items()))) == data
    some = {name: sections[name] for name in ("offsets", "header")}
    for fewer in (some, {}):
        assert read_container(write_container(fewer)) == fewer


def test_worked_numbers():
    text = "01 01 1e 00 00 00 07 03 00 00 00 1d 80 bc 55 fb 2d 2b 50 01 02 03"
    written = write_container({"masks": b"\1\2\3"}).hex(" ")
    assert written == f"89 50 34 44 0d 0a 1a 0a {text}"
    assert "FB 2D 2B 50" in container.__doc__


def test_layout_names_every_byte(sections):
    rows = layout(write_container(sections))
    assert rows[:2] == [("container_header", 14), ("section_table", 9 * 11 + 4)]
    assert rows[2:] == [(name, len(body)) for name, body in sections.items()]


def test_every_truncation_and_every_flipped_bit_is_refused(sections):
    data = write_container(sections)
    for bad in (*prefixes(data), *flips(data)):
        refusal(read_container, bad)


@pytest.mark.parametrize(
    "change, at, message",
    [
        (lambda d: b"\x88" + d[1:], 0, "magic"),
        (lambda d: d.replace(b"\r\n", b"\n"), 0, "magic"),
        (lambda d: d[:8] + b"\3" + d[9:], 8, "version 3"),
        (lambda d: d[:9] + b"\xff" + d[10:], 9, "255 sections"),
        (lambda d: d + b"\0", 10, "total length"),
        (lambda d: b"", 0, "at least"),
        (lambda d: repaired(d[:15] + bytes(4) + d[19:]), 14, "add up"),
        (lambda d: repaired(d[:15] + b"\xff" * 4 + d[19:]), 14, "add up"),
        (lambda d: EMPTY[:9] + b"\x0b" + EMPTY[10:], 113, "wrong checksum of header"),
        *(
            (lambda d, n=n: repaired(d[:104] + bytes([n]) + d[105:]), 104, "ascending")
            for n in (0, 12, 255)
        ),
        (lambda d: repaired(d[:50] + d[41:50] + d[59:]), 50, "id 4 after 4"),
        (lambda d: repaired(d[:14] + d[23:32] + d[14:23] + d[32:]), 23, "id 1 after 2"),
    ],
)
def test_refusals_name_the_place(sections, change, at, message):
    error = refusal(read_container, change(write_container(sections)))
    assert (error.section, error.offset) == ("container", at)
    assert message in error.message


LARGE = 3 * 2**30


def sparse(path, start, size=LARGE):
    """A file that begins with some bytes and goes on with zeros, which take no room on the disk."""
    with open(path, "wb") as file:
        file.write(start)
        file.truncate(size)
    return path


def frame(total, rows=b""):
    """The head of a file with a valid checksum."""
    head = MAGIC + struct.pack("<BBI", 1, len(rows) // 9, total) + rows
    return head + struct.pack("<I", zlib.crc32(head))


def test_good_files_are_read_whole(tmp_path):
    path = tmp_path / "good.p4dgs"
    _, make = GOOD["full"]
    for data in (write_container(stream_of(make)[1]), write_container({})):
        path.write_bytes(data)
        assert read_file(path) == data


@pytest.mark.parametrize(
    "start, size, message",
    [
        (b"", LARGE, "not a P-4DGS file: wrong magic number, expected 89 50 34 44"),
        (MAGIC + b"\3", LARGE, "version 3"),
        (frame(18), LARGE, f"total length 18, expected the file's {LARGE} bytes"),
        (frame(LARGE), LARGE, f"the file's {LARGE} bytes, at most {2**29}"),
        (frame(2**29), 2**29, "the lengths of the sections add up to 18"),
        (frame(2**29)[:-1], 2**29, "wrong checksum"),
        (b"", 5, "not a P-4DGS file: expected at least 18 bytes"),
    ],
)
def test_only_the_frame_of_a_wrong_file_is_read(tmp_path, start, size, message):
    path = sparse(tmp_path / "wrong.p4dgs", start, size)
    with traced(2**18):
        error = refusal(read_file, path)
    assert error.section == "container" and message in error.message
