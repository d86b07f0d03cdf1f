"""Reads the files of which scenes consist: JSON objects, pictures and point clouds.

The first anchors of a real scene stand at the points of a .npy, an array of shape [A, 3], or of a
binary .ply, x, y and z of its element `vertex`, as 3DGS writes it, and COLMAP with
`model_converter --output_type PLY`.
"""

import json
import math
import os
import re
import warnings
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from imageio.plugins.pillow import PillowPlugin

from ..limits import MAX_ANCHORS, MAX_FILE_BYTES, MAX_HEADER_BYTES
from ..splatting.camera import Camera
from .fields import MAX_COORDINATE, SceneError, require
from .scene import View, as_float, over_background, size_of

MAX_JSON_BYTES = 2**27  # a view takes about 500
MAX_PICTURE = 2**27  # pixels times channels of a picture
CAPTURE = "transforms.json"
FOLDERS = (
    "a D-NeRF folder with transforms_train.json and transforms_test.json, a capture with "
    f"{CAPTURE}, or a HyperNeRF or NeRF-DS folder with dataset.json"
)
ENDINGS = (".png", ".PNG", ".jpg", ".JPG", ".jpeg", ".JPEG")
# The types of a PLY file that NumPy knows by another name, or that have another size there.
PLY_TYPES = {"char": "i1", "uchar": "u1", "int": "i4", "uint": "u4", "float": "f4"}
# Gives the number of vertices, and the lines of their properties.
PLY_HEADER = re.compile(
    rb"ply\r?\n(?:comment.*\n)*format binary_little_endian .*\n(?:(?:comment|obj_info).*\n)*"
    rb"element vertex (\d+)\r?\n((?:property \w+ \w+\r?\n)*)(?:element (?s:.*?)\n)?end_header\r?\n"
)
PIXELS = "RGB, RGBA, a palette or grey of 8 bits"
MODES = ("RGB", "RGBA", "P", "L", "LA", "1")  # these kinds, in the words of Pillow


def read_json(file, expected=FOLDERS):
    """The JSON object in a file; `expected` says in messages what the file should be."""
    with reading(file, f"JSON in UTF-8, {expected}", most=MAX_JSON_BYTES):
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    require(isinstance(data, dict), file, f"a {type(data).__name__}; expected a JSON object")
    return data


def read_image(folder, name, where):
    """The pixels of a picture as float32 [H, W, 3 or 4]; the name may leave out its ending.

    They are turned as the camera that took them says (EXIF).
    """
    files = [folder / f"{name}{ending}" for ending in ("", *ENDINGS)]
    # unlike Path.is_file, isfile is also False for an impossible name
    file = next(filter(os.path.isfile, files), None)
    named = files[0] if Path(name).suffix else f"{files[1]}, .jpg or .jpeg"
    require(file, where, f"no picture {name!r}; expected {named}")
    require(
        file.resolve().is_relative_to(folder.resolve()),
        where,
        f"{name!r} is outside; expected a picture in the folder {folder}",
    )
    place = f"{where}: {file}"
    with reading(file, f"a .png or .jpg, a picture of {PIXELS}", where):
        # Given a path, imageio would expand its ~ and read inside its .zip.
        with iio.imopen(file.read_bytes(), "r", plugin=PillowPlugin) as opened:
            shape = opened.properties().shape
            require(
                math.prod(shape) <= MAX_PICTURE,
                place,
                f"{shape} numbers; expected a picture of at most {MAX_PICTURE}",
            )
            described = opened.metadata(exclude_applied=False)  # this decodes the pixels
            mode = described["mode"]
            # Pillow would give other kinds, such as CMYK, as if their numbers were RGB or RGBA.
            require(mode in MODES, place, f"pixels of kind {mode}; expected {PIXELS}")
            clear = mode in ("RGBA", "LA") or "transparency" in described
            pixels = opened.read(mode="RGBA" if clear else "RGB")
            return as_float(turned(pixels, described.get("Orientation")), place)


def turned(pixels, orientation):
    """Pixels as a viewer shows them, by the field Orientation of EXIF, 1 to 8."""
    if orientation in range(5, 9):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels


def image_bytes(pixels, ending, **settings):
    """Pixels in 8 bits, or the pictures of a GIF, in the format whose names have this ending."""
    return iio.imwrite("<bytes>", pixels, extension=ending, **settings)


def write_image(path, pixels, **settings):
    """Write pixels in 8 bits in the format that the path ends with."""
    # In memory first: on a full disk imageio would leave an open file, whose end is an error, too.
    path.write_bytes(image_bytes(pixels, path.suffix, **settings))


def make_view(name, image, lens, R, T, time, color, downscale, where):
    """A view from a picture, straightened, over a colour, both sides divided by `downscale`.

    The lens is (focal [2], middle [2], k [3], p [2]): focal lengths and principal point in pixels
    from the corner of the picture, and the distortion of `hypernerf`.
    """
    if premultiplied(image):
        warn_once(
            str(where).partition(": ")[0],
            "in the partly transparent pixels of a picture no colour exceeds alpha, as if colours "
            "were multiplied by alpha; expected straight alpha",
        )
    # over the colour first: where pixels are mixed, every colour is weighted by its alpha
    pixels, alpha = (
        part if part is None else box_filter(straighten(part, *lens), downscale)
        for part in over_background(image, color)
    )
    require(pixels.size, where, f"{size_of(image)} pixels; expected at least downscale {downscale}")
    focal, middle = (lengths / downscale for lengths in lens[:2])
    camera = Camera(R, T, *focal.tolist(), *(middle - 0.5).tolist(), *pixels.shape[1::-1])  # Q20
    return View(name, pixels, alpha, camera, time)


@cache
def warn_once(file, text):
    """Warn once of the pictures that a file lists, not again for each of them."""
    warnings.warn(f"{file}: {text}")


def premultiplied(image):
    """Whether no colour exceeds alpha in partly transparent pixels, of which there are many."""
    alpha = image[..., -1]
    partly = (abs(alpha - 0.5) < 0.4) & (image.shape[2] == 4)
    return partly.sum() >= 100 and (image[partly].max(1) <= alpha[partly] + 1 / 255).all()


def straighten(image, focal, middle, k, p):
    """A picture [H, W] or [H, W, C] as the lens would show it without distortion."""
    if not np.any([*k, *p]):
        return image
    from scipy.ndimage import map_coordinates  # a tenth of a second that few scenes need

    focal, middle, p = (pair[::-1, None, None] for pair in (focal, middle, p))  # y before x
    yx = (np.indices(image.shape[:2]) + 0.5 - middle) / focal
    r2 = (yx * yx).sum(axis=0)
    bent = yx * np.polyval((*k[::-1], 1), r2)
    bent += 2 * p * yx.prod(axis=0) + p[::-1] * (r2 + 2 * yx * yx)
    seen = bent * focal + middle - 0.5
    channels = np.moveaxis(np.atleast_3d(image), -1, 0)
    return np.dstack([map_coordinates(c, seen, order=1, mode="nearest") for c in channels]).reshape(
        image.shape
    )


def box_filter(image, s):
    """The means over boxes of s by s pixels; what is left at the right and below is cut off."""
    height, width = (side // s for side in image.shape[:2])
    boxes = image[: height * s, : width * s].reshape(height, s, width, s, *image.shape[2:])
    return boxes.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


@contextmanager
def reading(file, expected, where=None, most=MAX_FILE_BYTES):
    """Any error while a file is read becomes one line that says what was expected.

    `where` names the place that the file was found through. The file has at most `most` bytes.
    """
    place = f"{where}: {file}" if where else file
    kind = "a directory, a device or a broken link" if os.path.lexists(file) else "missing"
    require(os.path.isfile(file), place, f"{kind}; expected {expected}")
    require(os.path.getsize(file) <= most, place, f"larger than {most} bytes; expected {expected}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # such as that a picture is suspiciously large
            yield
    except (SceneError, MemoryError):
        raise
    except Exception as error:  # a broken file can fail in any layer of its reader
        reason = error.__cause__ or error
        raise SceneError(place, f"cannot be read ({reason}); expected {expected}") from None


def read_points(path: str | Path) -> np.ndarray:
    """The points [A, 3] of a file as float64; SceneError where it holds something else."""
    path = Path(path)
    require(path.suffix in READERS, path, f"expected a name that ends in {', '.join(READERS)}")
    with reading(
        path,
        "points in a .npy or a binary .ply, such as COLMAP writes with `model_converter "
        "--output_type PLY`",
    ):
        points = READERS[path.suffix](path)
        require(
            points.ndim == 2 and points.shape[1] == 3 and 0 < len(points) <= MAX_ANCHORS,
            path,
            f"expected 1 to {MAX_ANCHORS} points, [A, 3]; found {list(points.shape)}",
        )
        require(
            points.dtype.kind in "fiu" and np.all(np.abs(points.astype(float)) <= MAX_COORDINATE),
            path,
            f"expected finite coordinates of at most {MAX_COORDINATE:g}",
        )
    return points.astype(float)


def read_ply(path):
    """The vertices of a binary file: a structured array [N], whose fields are their properties."""
    data = Path(path).read_bytes()
    head = PLY_HEADER.match(data[:MAX_HEADER_BYTES])
    require(
        head,
        path,
        f"begins with {data[:120]!r}; expected a .ply in binary_little_endian whose header, up to "
        f"'end_header' at most {MAX_HEADER_BYTES} bytes, has 'vertex' first and properties of one "
        "number each",
    )
    count, lines = head.groups()
    properties = re.findall(r"property (\w+) (\w+)", lines.decode())
    columns = [(name, PLY_TYPES.get(kind, kind)) for kind, name in properties]
    return np.frombuffer(data, np.dtype(columns).newbyteorder("<"), int(count), head.end())


def read_vertices(path):
    """The coordinates [A, 3] of the vertices of a PLY file."""
    vertices = read_ply(path)
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


READERS = {
    ".npy": partial(np.lib.format.open_memmap, mode="r"),  # an array; its size is known at once
    ".ply": read_vertices,
}
