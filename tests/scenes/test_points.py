"""Point clouds from .npy files and binary .ply files."""

import io

import numpy as np
import pytest

from p4dgs_ref.scenes.files import read_points
from tests.scenes.refusals import refuse

POINTS = np.array([[0.5, -0.25, 1.0], [0.125, 2.0, -3.0], [1e-3, 0.75, 0.5], [4.0, 5.0, 6.0]])
LITTLE = """ply
format binary_little_endian 1.0
comment made by hand
element vertex 4
property uchar red
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""


def binary(points=POINTS):
    kind = np.dtype([("red", "u1"), *((axis, "<f4") for axis in "xyz")])
    rows = np.array([(7, *point) for point in points], kind)
    return rows.tobytes() + b"\x03\x00\x00\x00\x00"


def test_every_form_of_file_gives_the_same_points(tmp_path):
    (tmp_path / "l.ply").write_bytes(LITTLE.encode() + binary())
    np.save(tmp_path / "n.npy", POINTS)
    np.save(tmp_path / "f.npy", POINTS.astype(np.float32))
    (tmp_path / "crlf.ply").write_bytes(LITTLE.replace("\n", "\r\n").encode() + binary())
    (tmp_path / "e.ply").write_bytes(LITTLE.replace("by hand", "à la main").encode() + binary())
    np.save(tmp_path / "h.npy", POINTS.astype(np.float16))
    single = dict.fromkeys(("l.ply", "crlf.ply", "e.ply", "f.npy"), np.float32)
    for name, dtype in (single | {"n.npy": np.float64, "h.npy": np.float16}).items():
        assert np.array_equal(read_points(tmp_path / name), POINTS.astype(dtype)), name


def test_headers_as_other_programs_write_them(tmp_path):
    """Comments anywhere, names with - and ., blanks at the ends of lines, a second element."""
    text = LITTLE.replace("comment made by hand\n", "")
    text = text.replace("\n", " \t\nobj_info by hand  \ncomment end_header, \xe9\n")
    text = text.replace("red", "f_dc-0.red").removesuffix(
        "obj_info by hand  \ncomment end_header, \xe9\n"
    )
    (tmp_path / "m.ply").write_bytes(text.encode("latin-1") + binary())
    assert np.array_equal(read_points(tmp_path / "m.ply"), POINTS.astype(np.float32))


NPZ = io.BytesIO()
np.savez(NPZ, POINTS)


def header(old="", new=""):
    return LITTLE.replace(old, new).encode()


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("missing.ply", None, ["missing; expected points"]),
        ("points.obj", b"", [".npy, .ply"]),
        ("faces.ply", header("vertex 4", "corner 4"), ["'vertex' first", "element corner 4"]),
        ("flat.ply", header("property float y\n") + bytes(36), ["y"]),
        (
            "list.ply",
            header("uchar red", "list uchar int red"),
            ["format binary", "and properties of one"],
        ),
        (
            "ascii.ply",
            header("binary_little_endian", "ascii"),
            ["format ascii 1.0", "expected a .ply in binary_little_endian"],
        ),
        ("long.ply", header("\nelement", "\ncomment" + "a" * 2**14 + "\nelement"), ["end_header"]),
        (
            "count.ply",
            header("vertex 4", f"vertex {10**30}"),
            ["a binary .ply"],
        ),
        ("nan.ply", header() + binary([[1, np.nan, 3]] * 4), ["finite"]),
        ("text.npy", b"no array", ["points in a .npy"]),
        ("archive.npy", NPZ.getvalue(), ["read", "points in a .npy"]),
    ],
)
def test_other_files_are_refused_in_one_line(name, content, words, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    refuse([name, *words], read_points, tmp_path / name)


@pytest.mark.parametrize(
    "array, words",
    [
        (np.zeros((4, 2)), "[A, 3]"),
        (np.zeros((4, 3), complex), "finite"),
        (np.full((4, 3), np.inf), "finite"),
        (np.full((4, 3), np.longdouble(2) ** 2000), "at most 1e+06"),
        (np.broadcast_to(np.int8(0), (2**22 + 1, 3)), "1 to 4194304 points"),
    ],
)
def test_other_arrays_are_refused(array, words, tmp_path):
    np.save(tmp_path / "points.npy", array, allow_pickle=True)
    refuse(["points.npy", words], read_points, tmp_path / "points.npy")
