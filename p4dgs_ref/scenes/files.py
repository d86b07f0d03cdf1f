"""Reads the files of which scenes consist: JSON objects, pictures and point clouds.

The first anchors of a real scene stand at the points of

.npy    an array of shape [A, 3]
.ply    x, y and z of the element `vertex`, binary, as COLMAP and 3DGS write them
.txt    COLMAP's points3D.txt: lines of POINT3D_ID X Y Z R G B ERROR TRACK[]
"""

import json
import os
import warnings
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from .fields import SceneError, require
from .output import write_atomically
from .scene import FARTHEST, LARGEST_JSON, MOST_ANCHORS, as_float, over_background, size_of

FOLDERS = (
    "a D-NeRF folder with transforms_train.json and transforms_test.json, "
    "or a HyperNeRF or NeRF-DS folder with dataset.json"
)
PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


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
        clear = "transparency" in iio.immeta(file, plugin="pillow")  # alpha of a palette's colours
        image = iio.imread(file, plugin="pillow", mode="RGBA" if clear else None)
    return as_float(image, f"{where}: {file}")


def shrink(image, color, downscale, where):
    """The picture over a colour and its alpha (None for RGB), both sides divided by `downscale`."""
    require(
        not any(side % downscale for side in image.shape[:2]),
        where,
        f"{size_of(image)} pixels; expected sides divisible by downscale {downscale}",
    )
    # before the averaging, so that every colour is weighted by its alpha
    pixels, alpha = over_background(image, color)
    return box_filter(pixels, downscale), None if alpha is None else box_filter(alpha, downscale)


def box_filter(image, s):
    """The means over boxes of s by s pixels."""
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
    with reading(path, "points in a .npy, a binary .ply or COLMAP's points3D.txt"):
        points = READERS[path.suffix](path)
    require(
        points.ndim == 2 and points.shape[1] == 3 and 0 < len(points) <= MOST_ANCHORS,
        path,
        f"expected 1 to {MOST_ANCHORS} points, [A, 3]; found {list(points.shape)}",
    )
    require(
        points.dtype.kind in "fiu" and np.all(np.abs(points) <= FARTHEST),
        path,
        f"expected finite coordinates of at most {FARTHEST:g}",
    )
    return points.astype(float)


def write_ply(path, elements, comments=()):
    """Write float32 numbers as a binary file; returns the bytes of the header and every element.

    `elements` is {name: (names of its properties, rows [N, P])}. A comment is one line of ASCII.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, (properties, rows) in elements.items():
        lines.append(f"element {name} {len(rows)}")
        lines += [f"property float {of_element}" for of_element in properties]
    header = "\n".join([*lines, "end_header\n"]).encode("ascii")
    parts = [header, *(rows.astype("<f4").tobytes() for _, rows in elements.values())]
    write_atomically(Path(path), lambda file: file.write(b"".join(parts)))
    return [len(part) for part in parts]


def read_ply(path, expected=("vertex",)):
    """The first elements of a binary file, its comments, and the number of bytes that follow.

    `expected` are the names of these elements. An element is a structured array [N], whose fields
    are its properties. COLMAP and 3DGS write `vertex` first.
    """
    head, end, body = Path(path).read_bytes().partition(b"\nend_header\n")
    require(head[:3] == b"ply" and end, path, "expected a header from 'ply' to 'end_header'")
    start, *elements = head.decode("ascii").split("\nelement ")
    order = BYTE_ORDERS[start.split("\nformat ")[1].split()[0]]
    found, at = {}, 0
    for name, element in zip(expected, elements):
        first, *lines = (line.split() for line in element.splitlines())
        require(first[0] == name, path, f"expected {name!r}, not {first[0]!r}")
        properties = [line for line in lines if line[0] == "property"]
        kind = np.dtype([(line[-1], order + PLY_TYPES[line[1]]) for line in properties])
        found[name] = np.frombuffer(body, kind, int(first[1]), at)
        at += found[name].nbytes
    comments = [line[8:] for line in head.decode("ascii").splitlines() if line[:8] == "comment "]
    return found, comments, len(body) - at


def read_vertices(path):
    """The coordinates [A, 3] of the vertices of a PLY file."""
    vertices = read_ply(path)[0]["vertex"]
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


READERS = {
    ".npy": np.load,
    ".ply": read_vertices,
    ".txt": partial(np.loadtxt, usecols=(1, 2, 3), ndmin=2),
}
