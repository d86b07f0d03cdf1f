"""Reads point clouds, the first anchors of a real scene.

.npy    an array of shape [A, 3]
.ply    x, y and z of the element `vertex`, as COLMAP and 3DGS write them
.txt    COLMAP's points3D.txt: lines of POINT3D_ID X Y Z R G B ERROR TRACK[]
"""

from pathlib import Path

import numpy as np

from .files import reading
from .limits import FARTHEST, MOST_ANCHORS
from .ply import read_ply
from .scene import require


def read_points(path: str | Path) -> np.ndarray:
    """The points [A, 3] of a file as float64; SceneError where it holds something else."""
    path = Path(path)
    require(path.suffix in READERS, path, "expected a file whose name ends in .npy, .ply or .txt")
    with reading(path, "a point cloud"):
        points = READERS[path.suffix](path)
    fits = points.ndim == 2 and points.shape[1] == 3 and len(points) and points.dtype.kind in "fiu"
    require(
        fits, path, f"expected numbers of shape [A, 3]; found {points.dtype} {list(points.shape)}"
    )
    require(len(points) <= MOST_ANCHORS, path, f"expected at most {MOST_ANCHORS} points")
    near = np.all(np.abs(points) <= FARTHEST)
    require(near, path, f"expected finite coordinates of at most {FARTHEST:g}")
    return points.astype(float)


def read_npy(path):
    """The array of a .npy file."""
    return np.load(path, allow_pickle=False)


def read_vertices(path):
    """The coordinates [A, 3] of the vertices of a PLY file."""
    vertices = read_ply(path)[0]["vertex"]
    named = {*"xyz"} <= {*vertices.dtype.names}
    require(named, path, "expected properties x, y, z of the element vertex")
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


def read_colmap(path):
    """The coordinates [A, 3] of the points of a points3D.txt; lines that begin with # are not."""
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    for row in rows:
        require(
            len(row) >= 8,
            path,
            f"a line of {len(row)} words; expected POINT3D_ID X Y Z R G B ERROR TRACK[]",
        )
    return np.array([row[1:4] for row in rows], float)


READERS = {".npy": read_npy, ".ply": read_vertices, ".txt": read_colmap}
