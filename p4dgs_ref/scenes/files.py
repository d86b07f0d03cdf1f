"""Reads the files that scenes consist of: JSON objects, pictures and point clouds.

The first anchors of a real scene are the points of a .npy, an array of shape [A, 3], or of a binary
.ply, x, y and z of its element `vertex`, as 3DGS writes it, and COLMAP with
`model_converter --output_type PLY`.
"""

import json
import math
import os
import re
import warnings
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from imageio.plugins.pillow import PillowPlugin

from ..limits import MAX_ANCHORS, MAX_FILE_BYTES, MAX_HEADER_BYTES
from ..splatting.camera import Camera
from .fields import MAX_COORDINATE, SceneError, require_field
from .scene import View, as_float, over_background, size_of

MAX_JSON_BYTES = 2**27  # a view takes about 500
MAX_PICTURE = 2**27  # pixels times channels of a picture
CAPTURE = "transforms.json"
FOLDERS = (
    "a D-NeRF folder with transforms_train.json and transforms_test.json, a capture with "
    f"{CAPTURE} (colmap2nerf.py of instant-ngp makes one of a COLMAP project), or a HyperNeRF or "
    "NeRF-DS folder with dataset.json"
)
ENDINGS = (".png", ".PNG", ".jpg", ".JPG", ".jpeg", ".JPEG")
# The types of a PLY file that NumPy knows by another name, or that have another size there.
PLY_TYPES = {"char": "i1", "uchar": "u1", "int": "i4", "uint": "u4", "float": "f4"}
PLY_COMMENTS = "comment", "obj_info"
PLY_LINES = re.compile(rb"ply\s*\n(.*?\n)end_header[ \t]*\r?\n", re.DOTALL)  # of its header
# The header without comments and spare blanks: the number of vertices, and their properties.
PLY_HEADER = re.compile(
    r"format binary_little_endian \S+\n"
    r"element vertex ([0-9]+)\n((?:property \S+ \S+\n)*)(?:element (?s:.*))?"
)
PIXELS = "RGB, RGBA, a palette or grey of 8 bits"
MODES = ("RGB", "RGBA", "P", "L", "LA", "1")  # these kinds, in the words of Pillow
MIN_GROWTH = 0.2  # least d(radius in the picture) / d(radius without distortion) up to the corner
# Warnings about some of a scene's pictures, given once with their number.
TURNED = (
    "have an EXIF orientation, which is not applied: cameras belong to the pixels as they are "
    "stored"
)
PREMULTIPLIED = (
    "have partly transparent pixels in which no colour exceeds alpha and colours fade with alpha, "
    "as if they were multiplied by it; expected straight alpha"
)


def read_json(file, expected=FOLDERS):
    """Read the JSON object in a file; messages say that `expected` is what the file should be."""
    with one_line_errors(file, f"JSON in UTF-8, {expected}", most=MAX_JSON_BYTES):
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    require_field(isinstance(data, dict), file, f"a {type(data).__name__}; expected a JSON object")
    return data


def find_picture(folder, name, where):
    """Return the file of a picture, whose name may lack its ending; None if there is no file."""
    files = [folder / f"{name}{ending}" for ending in ("", *ENDINGS)]
    # unlike Path.is_file, isfile is also False for an impossible name
    file = next(filter(os.path.isfile, files), None)
    require_field(
        file is None or file.resolve().is_relative_to(folder.resolve()),
        where,
        f"{name!r} is outside; expected a picture in the folder {folder}",
    )
    return file


def read_image(folder, name, where, notes):
    """Return the pixels of a picture as stored, float32 [H, W, 3 or 4], and their size in words.

    An orientation in EXIF is not applied; `notes` counts the pictures that have one.
    """
    file = find_picture(folder, name, where)
    expected = folder / (name if Path(name).suffix else f"{name}.png, .jpg or .jpeg")
    require_field(file, where, f"no picture {name!r}; expected {expected}")
    place = f"{where}: {file}"
    with one_line_errors(file, f"a .png or .jpg, a picture of {PIXELS}", where):
        # Given a path, imageio would expand its ~ and read inside its .zip.
        with iio.imopen(file.read_bytes(), "r", plugin=PillowPlugin) as opened:
            shape = opened.properties().shape
            require_field(
                math.prod(shape) <= MAX_PICTURE,
                place,
                f"{shape} numbers; expected a picture of at most {MAX_PICTURE}",
            )
            described = opened.metadata(exclude_applied=False)  # this decodes the pixels
            mode = described["mode"]
            # Pillow would give other kinds, such as CMYK, as if their numbers were RGB or RGBA.
            require_field(mode in MODES, place, f"pixels of kind {mode}; expected {PIXELS}")
            clear = mode in ("RGBA", "LA") or "transparency" in described
            image = as_float(opened.read(mode="RGBA" if clear else "RGB"), place)
    size, orientation = f"{size_of(image)} pixels", described.get("Orientation")
    if orientation in range(2, 9):
        notes[TURNED] += 1
        size += f" as stored (EXIF orientation {orientation} is not applied)"
    return image, size


def image_bytes(pixels, ending, **settings):
    """Return pixels in 8 bits, or the pictures of a GIF, in the format of an ending."""
    return iio.imwrite("<bytes>", pixels, extension=ending, **settings)


def write_image(path, pixels, **settings):
    """Write pixels in 8 bits in the format that the path ends with."""
    # In memory first: on a full disk imageio would leave an open file, and closing it fails again.
    path.write_bytes(image_bytes(pixels, path.suffix, **settings))


def make_view(name, image, lens, R, T, time, color, downscale, where, notes):
    """Return a view from a picture: undistorted, over a colour, sides divided by `downscale`.

    The lens is (focal [2], middle [2], k [3], p [2]): focal lengths and principal point in pixels
    from the corner of the picture, and the distortion of `hypernerf`.
    """
    check_lens(image, *lens[:3], where)
    notes[PREMULTIPLIED] += is_premultiplied(image)
    # over the colour first, so that pixels are averaged with every colour weighted by its alpha
    pixels, alpha = (
        part if part is None else box_filter(straighten(part, *lens), downscale)
        for part in over_background(image, color)
    )
    require_field(
        pixels.size, where, f"{size_of(image)} pixels; expected at least downscale {downscale}"
    )
    focal, middle = (lengths / downscale for lengths in lens[:2])
    camera = Camera(R, T, *focal.tolist(), *(middle - 0.5).tolist(), *pixels.shape[1::-1])  # Q20
    return View(name, pixels, alpha, camera, time)


def check_lens(image, focal, middle, k, where):
    """Refuse a principal point in units other than pixels, and a lens that folds the picture."""
    size = np.array(image.shape[1::-1])
    require_field(
        middle.max() > 1 or size.min() <= 16,
        where,
        f"principal point {middle[0]:.3g}, {middle[1]:.3g}; expected pixels of {size_of(image)}, "
        "not fractions of the sides",
    )
    radius = np.hypot(*(np.maximum(middle, size - middle) / focal))  # of the farthest corner
    r2 = np.linspace(0, radius, 256) ** 2
    growth = np.polyval([7 * k[2], 5 * k[1], 3 * k[0], 1], r2).min()
    require_field(
        growth > MIN_GROWTH,
        where,
        f"lens distortion {', '.join(f'{c:g}' for c in k)}: towards the corner the radius in the "
        f"picture grows only {growth:.3g} times as fast as without distortion; expected at least "
        f"{MIN_GROWTH:g}; calibrate again, or undistort the pictures",
    )


def is_premultiplied(image):
    """Return whether an image looks as if its colours were multiplied by alpha.

    Then no colour exceeds alpha in partly transparent pixels, of which there must be many, and
    colours fade with alpha. For a dark object with straight alpha only the first is true.
    """
    alpha, brightest = image[..., -1], image[..., :3].max(axis=2)
    faint, dense = (alpha > 0.1) & (alpha < 0.5), (alpha > 0.5) & (alpha < 0.9)
    return (
        image.shape[2] == 4
        and min(faint.sum(), dense.sum()) >= 50
        and (brightest <= alpha + 1 / 255)[faint | dense].all()
        and brightest[faint].mean() < 0.7 * brightest[dense].mean()
    )


def straighten(image, focal, middle, k, p):
    """Return a picture [H, W] or [H, W, C] as the lens would show it without distortion."""
    if not np.any([*k, *p]):
        return image
    from scipy.ndimage import map_coordinates  # takes a tenth of a second, and few scenes need it

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
    """Return means over boxes of s by s pixels; a rest at the right or at the bottom is cut off."""
    height, width = (side // s for side in image.shape[:2])
    boxes = image[: height * s, : width * s].reshape(height, s, width, s, *image.shape[2:])
    return boxes.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


@contextmanager
def one_line_errors(file, expected, where=None, most=MAX_FILE_BYTES):
    """Turn any error while a file is read into one line that says what was expected.

    `where` names the place that refers to the file. The file has at most `most` bytes.
    """
    place = f"{where}: {file}" if where else file
    kind = "a directory, a device or a broken link" if os.path.lexists(file) else "missing"
    require_field(os.path.isfile(file), place, f"{kind}; expected {expected}")
    require_field(
        os.path.getsize(file) <= most, place, f"larger than {most} bytes; expected {expected}"
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # for example of a suspiciously large picture
            yield
    except (SceneError, MemoryError):
        raise
    except Exception as error:  # a broken file can fail in any layer of its reader
        reason = error.__cause__ or error
        raise SceneError(place, f"cannot be read ({reason}); expected {expected}") from None


def read_points(path: str | Path) -> np.ndarray:
    """Read the points [A, 3] of a file as float64; SceneError if it contains something else."""
    path = Path(path)
    require_field(
        path.suffix in READERS, path, f"expected a name that ends in {', '.join(READERS)}"
    )
    with one_line_errors(
        path,
        "points in a .npy or a binary .ply, such as COLMAP writes with `model_converter "
        "--output_type PLY`",
    ):
        points = READERS[path.suffix](path)
        require_field(
            points.ndim == 2 and points.shape[1] == 3 and 0 < len(points) <= MAX_ANCHORS,
            path,
            f"expected 1 to {MAX_ANCHORS} points, [A, 3]; found {list(points.shape)}",
        )
        require_field(
            points.dtype.kind in "fiu" and np.all(np.abs(points.astype(float)) <= MAX_COORDINATE),
            path,
            f"expected finite coordinates of at most {MAX_COORDINATE:g}",
        )
    return points.astype(float)


def read_ply(path):
    """Return the vertices of a binary file, a structured array [N] with a field per property."""
    data = Path(path).read_bytes()
    whole = PLY_LINES.match(data[:MAX_HEADER_BYTES])
    lines = [line.split() for line in (whole[1].decode("latin-1").split("\n") if whole else ())]
    text = "".join(
        f"{' '.join(words)}\n" for words in lines if words and words[0] not in PLY_COMMENTS
    )
    head = PLY_HEADER.fullmatch(text)
    require_field(
        head,
        path,
        f"begins with {data[:120]!r}; expected a .ply in binary_little_endian whose header, up to "
        f"'end_header' at most {MAX_HEADER_BYTES} bytes, has 'vertex' first and properties of one "
        "number each",
    )
    count, properties = head.groups()
    columns = [
        (name, PLY_TYPES.get(kind, kind))
        for _, kind, name in map(str.split, properties.splitlines())
    ]
    return np.frombuffer(data, np.dtype(columns).newbyteorder("<"), int(count), whole.end())


def read_vertices(path):
    """Return the coordinates [A, 3] of the vertices of a PLY file."""
    vertices = read_ply(path)
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


READERS = {
    ".npy": partial(np.lib.format.open_memmap, mode="r"),  # an array; its size is known at once
    ".ply": read_vertices,
}
