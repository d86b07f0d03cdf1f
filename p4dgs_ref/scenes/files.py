"""Reads the files of which scenes consist: JSON objects, pictures and point clouds.

The first anchors of a real scene stand at the points of

.npy    an array of shape [A, 3]
.ply    x, y and z of the element `vertex`, as COLMAP and 3DGS write them
.txt    COLMAP's points3D.txt: lines of POINT3D_ID X Y Z R G B ERROR TRACK[]
"""

import json
import os
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from .ply import read_ply
from .scene import (
    FARTHEST,
    LARGEST_JSON,
    MOST_ANCHORS,
    SceneError,
    as_float,
    over_background,
    require,
    size_of,
)

FOLDERS = (
    "a D-NeRF folder with transforms_train.json and transforms_test.json, "
    "or a HyperNeRF or NeRF-DS folder with dataset.json"
)


def read_json(file, expected=FOLDERS):
    """The JSON object in a file; `expected` says what it should be."""
    with reading(file, f"JSON in UTF-8, {expected}"):
        size = file.stat().st_size
        require(size <= LARGEST_JSON, file, f"larger than {LARGEST_JSON} bytes; expected JSON")
        data = json.loads(file.read_text(encoding="utf-8"))
    require(isinstance(data, dict), file, f"a {type(data).__name__}; expected a JSON object")
    return data


def read_image(folder, name, where):
    """The pixels of a picture as float32 [H, W, 3 or 4]; the name may leave out .png."""
    file = folder / name
    if not os.path.isfile(file):  # unlike Path.is_file, also False for an impossible name
        file = folder / f"{name}.png"
    require(os.path.isfile(file), where, f"no picture {name!r}; expected {file}")
    require(
        file.resolve().is_relative_to(folder.resolve()),
        where,
        f"{name!r} is outside; expected a picture in the folder {folder}",
    )
    with reading(file, "a PNG of RGB or RGBA pixels", where), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a picture so large that it could be an attack
        picture: Any  # its class depends on the plugin
        with iio.imopen(file, "r", plugin="pillow") as picture:
            clear = "transparency" in picture.metadata()  # a palette or a colour with an alpha
            image = picture.read(mode="RGBA" if clear else None)
    return as_float(image, f"{where}: {file}")


def shrink(image, color, downscale, where, resample=lambda plane: plane):
    """The picture over a colour and its alpha (None for RGB), both sides divided by `downscale`.

    `resample` moves the pixels of a plane before they are averaged.
    """
    require(
        not any(side % downscale for side in image.shape[:2]),
        where,
        f"{size_of(image)} pixels; expected sides divisible by downscale {downscale}",
    )
    # before the averaging, so that every colour is weighted by its alpha
    pixels, alpha = over_background(image, color)
    pixels = box_filter(resample(pixels), downscale)
    return pixels, None if alpha is None else box_filter(resample(alpha), downscale)


def box_filter(image, s):
    """The means over boxes of s by s pixels."""
    if s == 1:
        return image
    height, width = image.shape[0] // s, image.shape[1] // s
    boxes = image.reshape(height, s, width, s, *image.shape[2:])
    return boxes.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


@contextmanager
def reading(file, expected, where=None):
    """Any error while a file is read becomes one line that says what was expected.

    `where` names the place that the file was found through.
    """
    place = f"{where}: {file}" if where else file
    kind = "a directory, a device or a broken link" if os.path.lexists(file) else "missing"
    require(os.path.isfile(file), place, f"{kind}; expected {expected}")
    try:
        yield
    except SceneError:
        raise
    except Exception as error:  # a broken file can fail in any layer of its reader
        raise SceneError(place, f"cannot be read ({error}); expected {expected}") from None


def read_points(path: str | Path) -> np.ndarray:
    """The points [A, 3] of a file as float64; SceneError where it holds something else."""
    path = Path(path)
    require(path.suffix in READERS, path, "expected a file whose name ends in .npy, .ply or .txt")
    with reading(path, "a point cloud"):
        points = READERS[path.suffix](path)
    require(
        points.ndim == 2 and points.shape[1] == 3 and len(points) and points.dtype.kind in "fiu",
        path,
        f"expected numbers of shape [A, 3]; found {points.dtype} {list(points.shape)}",
    )
    require(len(points) <= MOST_ANCHORS, path, f"expected at most {MOST_ANCHORS} points")
    require(
        np.all(np.abs(points) <= FARTHEST),
        path,
        f"expected finite coordinates of at most {FARTHEST:g}",
    )
    return points.astype(float)


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


READERS = {".npy": np.load, ".ply": read_vertices, ".txt": read_colmap}
