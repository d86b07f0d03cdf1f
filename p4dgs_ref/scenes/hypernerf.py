"""Reads scenes in the layout of Nerfies, which HyperNeRF and NeRF-DS share.

    dataset.json    train_ids and val_ids, the names of the views; their order in `ids`
    metadata.json   time_id of every view; where there is none, warp_id counts the times
    scene.json      center and scale: x in the files is (x - center) scale for us
    camera/ID.json  orientation (world to camera, OpenCV axes) and position of a camera, its lens
    rgb/Nx/ID.png   its picture, both sides divided by N
    points.npy      points [A, 3] from which anchors start

A camera projects the point (x, y, 1) before it to the pixel (u, v), which counts from the corner of
the full picture. With r^2 = x^2 + y^2, radial distortion k and tangential distortion p,

    u = focal_length x' + skew y' + principal_point[0]
    v = focal_length pixel_aspect_ratio y' + principal_point[1]
    x' = x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2)
    y' = y (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_2 x y + p_1 (r^2 + 2 y^2)

Our camera has neither distortion nor skew. Pictures of a lens with one of them are resampled to
those of the lens without them, bilinearly, and repeat their border where they end. D3DGS ignores
both, and takes the principal point as the middle of the picture.
"""

import re
from types import SimpleNamespace

import numpy as np

from ..splatting.camera import Camera
from .files import read_image, read_json, read_points, shrink
from .scene import (
    FARTHEST,
    LARGEST_LENS,
    LEAST_LENS,
    View,
    check_rotation,
    is_number,
    numbers,
    require,
    size_of,
)

SPLITS = "dataset.json"
FULL = "the files of a HyperNeRF or NeRF-DS folder"
# Shape, least value and default of the fields of a camera file. Lengths are pixels of the full
# picture, counted from its corner. Older files call the last field `tangential`.
CAMERA = {
    "orientation": ((3, 3), -LARGEST_LENS, None),
    "position": ((3,), -LARGEST_LENS, None),
    "focal_length": ((), LEAST_LENS, None),
    "pixel_aspect_ratio": ((), LEAST_LENS, 1),
    "principal_point": ((2,), -LARGEST_LENS, None),
    "skew": ((), -LARGEST_LENS, 0),
    "image_size": ((2,), 1, None),
    "radial_distortion": ((3,), -LARGEST_LENS, [0, 0, 0]),
    "tangential_distortion": ((2,), -LARGEST_LENS, [0, 0]),
}


def read(folder, color, downscale):
    """The views of both splits and the points, {"train": ..., "test": ..., "points": ...}.

    `downscale` divides the sides of the largest pictures that the folder has. Smaller pictures of
    that size are taken where they exist; otherwise pixels are averaged in boxes.
    """
    splits = read_ids(folder)
    times = read_times(folder, splits["train"] + splits["test"])
    ratios = picture_sizes(folder)
    ratio, rest = ratios[0], downscale
    if ratios[0] * downscale in ratios:
        ratio, rest = ratios[0] * downscale, 1
    points = place(folder, read_points(folder / "points.npy"))
    lenses = [read_camera(folder, name) for name in times]
    centers = place(folder, np.stack([lens.position for lens in lenses]))
    views = {
        name: read_view(folder, name, lens, center, time, ratio, rest, color)
        for lens, center, (name, time) in zip(lenses, centers, times.items())
    }
    return {
        **{split: tuple(views[name] for name in names) for split, names in splits.items()},
        "points": points,
    }


def read_ids(folder):
    """The names of the views of both splits.

    They are train_ids and val_ids. Where val_ids is empty, as in scenes that test interpolation in
    time, of every four `ids` the first is for training and the third for testing.
    """
    file = folder / SPLITS
    data = read_json(file, FULL)

    def names(field):
        listed = data.get(field, [])
        require(
            isinstance(listed, list) and all(map(is_name, listed)),
            f"{file}: {field}",
            "expected a list of names of views, without slashes and control characters",
        )
        return listed

    train, test = names("train_ids"), names("val_ids")
    if not test:
        train, test = names("ids")[::4], names("ids")[2::4]
    require(train and test, file, "no views; expected train_ids and val_ids, or at least three ids")
    twice = len(train + test) - len({*train, *test})
    require(not twice, file, f"{twice} views listed twice; expected each in one split, once")
    return {"train": train, "test": test}


def is_name(value):
    """Whether a value can be the name of a view, from which the names of its files are made."""
    return (
        isinstance(value, str)
        and value.isprintable()
        and 0 < len(value) < 200
        and not {*"/\\"} & {*value}
    )


def read_times(folder, names):
    """The time in [0, 1] of every view by its name: its time_id over the largest of all."""
    file = folder / "metadata.json"
    data, counted = read_json(file, FULL), {}
    for name in names:
        entry = data.get(name)
        where = f"{file}: {name}"
        require(isinstance(entry, dict), where, "missing or not an object; expected time_id")
        field = "time_id" if "time_id" in entry else "warp_id"
        time = entry.get(field)
        require(
            is_number(time, int) and 0 <= time <= LARGEST_LENS,
            f"{where}.{field}",
            f"{time!r}; expected an integer of at least 0",
        )
        counted[name] = time
    last = max(1, *counted.values())
    return {name: time / last for name, time in counted.items()}


def picture_sizes(folder):
    """The ratios N of the folders rgb/Nx, the largest pictures first."""
    found = [re.fullmatch(r"([1-9]\d{0,3})x", path.name) for path in folder.glob("rgb/*/")]
    ratios = sorted(int(match[1]) for match in found if match)
    require(ratios, folder / "rgb", "no pictures; expected a folder 1x, 2x or the like")
    return ratios


def place(folder, x):
    """Points [A, 3] in the coordinates of a folder's files, in scene units."""
    file = folder / "scene.json"
    data = read_json(file, FULL)
    center = numbers(data.get("center"), f"{file}: center", (3,), -LARGEST_LENS, LARGEST_LENS)
    scale = numbers(data.get("scale"), f"{file}: scale", (), LEAST_LENS, LARGEST_LENS)
    placed = (x - center) * scale
    require(
        np.all(np.abs(placed) <= FARTHEST),  # False for NaN
        f"{file}: scale",
        f"puts a camera or point beyond {FARTHEST:g}; expected less",
    )
    return placed


def read_camera(folder, name):
    """The fields of a view's camera file, and `focal` [2]: the focal lengths f_x and f_y."""
    file = folder / "camera" / f"{name}.json"
    data = read_json(file, f"the camera of the view {name}")
    data = {"tangential_distortion": data.get("tangential", [0, 0]), **data}
    fields = {
        field: numbers(data.get(field, default), f"{file}: {field}", shape, least, LARGEST_LENS)
        for field, (shape, least, default) in CAMERA.items()
    }
    lens = SimpleNamespace(**fields)
    check_rotation(lens.orientation, f"{file}: orientation")
    lens.focal = lens.focal_length * np.array([1, lens.pixel_aspect_ratio])
    return lens


def read_view(folder, name, lens, center, time, ratio, downscale, color):
    """One view from its picture in rgb/<ratio>x, whose sides are then divided by `downscale`."""
    file = f"rgb/{ratio}x/{name}.png"
    where = str(folder / file)
    image = read_image(folder, file, where)
    size = np.array(image.shape[1::-1])
    require(
        np.all(np.abs(lens.image_size - ratio * size) < ratio),
        where,
        f"{size_of(image)} pixels; expected 1/{ratio} of image_size in camera/{name}.json",
    )
    stride = lens.image_size / size  # not exactly `ratio` where it does not divide the sides
    pixels, alpha = shrink(
        image, color, downscale, where, lambda plane: straighten(plane, lens, stride, where)
    )
    stride = stride * downscale
    f_x, f_y = lens.focal / stride
    c_x, c_y = lens.principal_point / stride - 0.5  # the files count from the corner (Q20)
    R = lens.orientation
    camera = Camera(
        R, -R @ center, float(f_x), float(f_y), float(c_x), float(c_y), *pixels.shape[1::-1]
    )
    return View(name, pixels, alpha, camera, time)


def straighten(plane, lens, stride, where):
    """A picture as the lens without distortion and skew would show it."""
    radial, tangential = lens.radial_distortion, lens.tangential_distortion
    if not (lens.skew or radial.any() or tangential.any()):
        return plane
    from scipy.ndimage import map_coordinates  # a tenth of a second that few scenes need

    v, u = np.indices(plane.shape[:2])
    pixel = np.stack([u, v], axis=-1) + 0.5
    x, y = np.moveaxis((pixel * stride - lens.principal_point) / lens.focal, -1, 0)
    x, y = distorted(x, y, radial, tangential)
    (f_x, f_y), (p_x, p_y) = lens.focal, lens.principal_point
    u = (f_x * x + lens.skew * y + p_x) / stride[0] - 0.5
    v = (f_y * y + p_y) / stride[1] - 0.5
    ordered = np.all(np.diff(u, axis=1) > 0) and np.all(np.diff(v, axis=0) > 0)
    require(ordered, where, "its distortion folds the picture; expected smaller coefficients")
    channels = np.moveaxis(np.atleast_3d(plane), -1, 0)
    moved = [map_coordinates(channel, (v, u), order=1, mode="nearest") for channel in channels]
    return np.stack(moved, axis=-1).reshape(plane.shape)


def distorted(x, y, k, p):
    """x' and y' of the module's docstring."""
    (k_1, k_2, k_3), (p_1, p_2) = k, p
    r2 = x * x + y * y
    radial = 1 + r2 * (k_1 + r2 * (k_2 + r2 * k_3))
    x_t = 2 * p_1 * x * y + p_2 * (r2 + 2 * x * x)
    y_t = 2 * p_2 * x * y + p_1 * (r2 + 2 * y * y)
    return x * radial + x_t, y * radial + y_t
