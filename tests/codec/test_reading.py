"""Files are read only after their frame was checked, and only where they are regular files."""

import os
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import pytest

from p4dgs_ref.codec.container import MAGIC, read_file, write_container
from p4dgs_ref.codec.published import FOLDER
from tests.codec.models import refusal

ROOT = Path(__file__).resolve().parents[2]
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
    for data in ((FOLDER / "full.p4dgs").read_bytes(), write_container({})):
        path.write_bytes(data)
        assert read_file(path) == data


@pytest.mark.parametrize(
    "start, size, message",
    [
        (b"", LARGE, "not a P-4DGS file: wrong magic number, expected 89 50 34 44"),
        (MAGIC + b"\3", LARGE, "version 3"),
        (frame(18), LARGE, f"total length 18, but the file has {LARGE} bytes"),
        (frame(LARGE), LARGE, f"total length {LARGE}, expected at most {2**29}"),
        (frame(2**29), 2**29, "the lengths of the sections add up to 18"),
        (frame(2**29)[:-1], 2**29, "wrong checksum"),
        (b"", 5, "not a P-4DGS file: expected at least 18 bytes"),
    ],
)
def test_only_the_frame_of_a_wrong_file_is_read(tmp_path, start, size, message):
    path = sparse(tmp_path / "wrong.p4dgs", start, size)
    tracemalloc.start()
    try:
        error = refusal(read_file, path)
        assert tracemalloc.get_traced_memory()[1] < 2**18
    finally:
        tracemalloc.stop()
    assert error.section == "container" and message in error.message


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pipe", "sparse", "folder"])
def test_the_command_line_refuses_what_is_no_file_in_one_line(tmp_path, kind):
    path = tmp_path / kind
    make = {
        "pipe": os.mkfifo,
        "sparse": lambda path: sparse(path, frame(LARGE)),
        "folder": os.mkdir,
    }
    make[kind](path)
    command = [sys.executable, "-m", "p4dgs_ref", "decode", path, "-o", tmp_path / "new"]
    # A reader of the pipe would wait for a writer for ever.
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith(f"p4dgs-ref: {path}: ") and done.stderr.count("\n") == 1
    assert ("total length" if kind == "sparse" else "regular file") in done.stderr
    assert not (tmp_path / "new").exists()
