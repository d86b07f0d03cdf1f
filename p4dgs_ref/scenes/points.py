"""Reads point clouds, the first anchors of a real scene: .npy of shape [A, 3], or .ply.

Of a PLY file (ASCII or binary) the coordinates x, y, z of the element `vertex` are read, which must
come first, as in the files of COLMAP and of 3DGS. Its other properties are skipped.
"""

from pathlib import Path

import numpy as np

from .scene import FARTHEST, SceneError, require

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
MOST_POINTS = 2**22  # a file may not hold more anchors
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def read_points(path: str | Path) -> np.ndarray:
    """The points [A, 3] of a file as float64; SceneError where it holds something else."""
    path = Path(path)
    require(
        path.suffix in (".npy", ".ply"), path, "expected a file whose name ends in .npy or .ply"
    )
    require(path.is_file(), path, "no such file")
    try:
        points = np.load(path, allow_pickle=False) if path.suffix == ".npy" else read_ply(path)
    except SceneError:
        raise
    except Exception as error:  # a broken file can fail in any layer of its reader
        raise SceneError(path, f"expected a point cloud; reading it failed: {error}") from None
    fits = points.ndim == 2 and points.shape[1] == 3 and len(points) and points.dtype.kind in "fiu"
    require(
        fits, path, f"expected numbers of shape [A, 3]; found {points.dtype} {list(points.shape)}"
    )
    require(len(points) <= MOST_POINTS, path, f"expected at most {MOST_POINTS} points")
    near = np.all(np.abs(points) <= FARTHEST)
    require(near, path, f"expected finite coordinates of at most {FARTHEST:g}")
    return points.astype(float)


def read_ply(path):
    """The coordinates [A, 3] of the vertices of a PLY file."""
    with open(path, "rb") as file:
        lines = [file.readline(200).split()]
        require(lines[0] == [b"ply"], path, "expected a first line 'ply'")
        while lines[-1] != [b"end_header"]:
            line = file.readline(200)
            require(
                line and len(lines) < 1000, path, "expected a header that ends with 'end_header'"
            )
            lines.append(line.split())
        body = file.read()
    words = [[word.decode("ascii") for word in line] for line in lines]
    order = next(BYTE_ORDERS[line[1]] for line in words if line[:1] == ["format"])
    starts = [i for i, line in enumerate(words) if line[:1] == ["element"]] + [len(words)]
    require(
        len(starts) > 1 and words[starts[0]][1] == "vertex",
        path,
        "expected 'vertex' as first element",
    )
    count = int(words[starts[0]][2])
    properties = [line for line in words[starts[0] : starts[1]] if line[:1] == ["property"]]
    kinds = [(line[-1], order + PLY_TYPES[line[1]]) for line in properties]
    names = [name for name, _ in kinds]
    require(
        {"x", "y", "z"} <= set(names), path, "expected properties x, y and z of the element vertex"
    )
    if order:
        vertices = np.frombuffer(body, np.dtype(kinds), count)
        return np.stack([vertices[axis] for axis in "xyz"], axis=1)
    rows = [line.split() for line in body.splitlines()[:count]]
    require(len(rows) == count, path, f"expected {count} lines of vertices")
    columns = [names.index(axis) for axis in "xyz"]
    return np.array([[float(row[i]) for i in columns] for row in rows])
