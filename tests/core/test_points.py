"""Point clouds from .npy and .ply files."""

import numpy as np
import pytest

from p4dgs_ref.scenes.files import read_points
from tests.core.refusals import refuse

POINTS = np.array([[0.5, -0.25, 1.0], [0.125, 2.0, -3.0], [1e-3, 0.75, 0.5], [4.0, 5.0, 6.0]])
HEADER = """ply
format {} 1.0
comment made by hand
element vertex 4
property uchar red
property {kind} x
property {kind} y
property {kind} z
element face 1
property list uchar int vertex_indices
end_header
"""


def binary(order):
    kind = np.dtype([("red", "u1"), *((axis, order + "f4") for axis in "xyz")])
    rows = np.array([(7, *point) for point in POINTS], kind)
    return rows.tobytes() + b"\x03\x00\x00\x00\x00"


def write(path, form, body):
    kind = "double" if form == "ascii" else "float"
    path.write_bytes(HEADER.format(form, kind=kind).encode() + body)


def test_every_form_of_file_gives_the_same_points(tmp_path):
    lines = "".join(f"7 {x!r} {y!r} {z!r}\n" for x, y, z in POINTS.tolist()) + "3 0 1 2\n"
    write(tmp_path / "a.ply", "ascii", lines.encode())
    write(tmp_path / "l.ply", "binary_little_endian", binary("<"))
    write(tmp_path / "b.ply", "binary_big_endian", binary(">"))
    np.save(tmp_path / "n.npy", POINTS)
    np.save(tmp_path / "f.npy", POINTS.astype(np.float32))
    assert np.array_equal(read_points(tmp_path / "a.ply"), POINTS)
    assert np.array_equal(read_points(tmp_path / "n.npy"), POINTS)
    for name in ("l.ply", "b.ply", "f.npy"):
        assert np.array_equal(read_points(tmp_path / name), POINTS.astype(np.float32))


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("missing.ply", None, ["missing; expected a point cloud"]),
        ("points.txt", b"1 2 3", ["a line of 3 words", "ERROR TRACK[]"]),
        ("empty.ply", b"", ["ply"]),
        ("cut.ply", b"ply\nformat ascii 1.0\nelement vertex 4\n", ["end_header"]),
        ("faces.ply", b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", ["vertex"]),
        (
            "flat.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            ["properties x, y, z"],
        ),
        (
            "list.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n",
            ["properties x, y, z"],
        ),
        ("short.ply", HEADER.format("ascii", kind="float").encode() + b"7 1 2 3\n", ["4 lines"]),
        ("half.ply", HEADER.format("binary_little_endian", kind="float").encode() + b"7", ["read"]),
        ("order.ply", HEADER.format("sideways", kind="float").encode(), ["point cloud"]),
        ("words.ply", HEADER.format("ascii", kind="float").encode() + b"7 a b c\n" * 4, ["read"]),
        ("nan.ply", HEADER.format("ascii", kind="float").encode() + b"7 1 nan 3\n" * 4, ["finite"]),
        ("text.npy", b"no array", ["point cloud"]),
        ("noformat.ply", b"ply\nelement vertex 1\nend_header\n1\n", ["point cloud"]),
        (
            "count.ply",
            HEADER.format("binary_little_endian", kind="float")
            .replace("vertex 4", f"vertex {10**30}")
            .encode(),
            ["point cloud"],
        ),
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
        (np.zeros((0, 3)), "[A, 3]"),
        (np.zeros((4, 3), complex), "[A, 3]"),
        (np.full((4, 3), "a"), "[A, 3]"),
        (np.full((4, 3), np.inf), "finite"),
        (np.full((4, 3), 1e300), "at most 1e+06"),
        (np.broadcast_to(np.int8(0), (2**22 + 1, 3)), "at most 4194304 points"),
        (np.array([None]), "point cloud"),
    ],
)
def test_other_arrays_are_refused(array, words, tmp_path):
    np.save(tmp_path / "points.npy", array, allow_pickle=True)
    refuse(["points.npy", words], read_points, tmp_path / "points.npy")
