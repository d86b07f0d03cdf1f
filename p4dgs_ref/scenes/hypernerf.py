"""Reads scenes in the layout of Nerfies, which HyperNeRF and NeRF-DS share.

    dataset.json    train_ids and val_ids, the names of the views; their order in `ids`
    metadata.json   time_id of every view; if there is none, warp_id counts the times
    scene.json      center and scale: x in the files is (x - center) scale for us
    camera/ID.json  orientation (world to camera, OpenCV axes) and position of a camera, its lens
    rgb/Nx/ID.png   its picture (or .jpg, .jpeg), both sides divided by N
    points.npy      points [A, 3] from which anchors start

A camera projects the point (x, y, 1) in front of it to the pixel (u, v), counted from the corner of
the full picture. With r^2 = x^2 + y^2, radial distortion k and tangential distortion p,

    u = focal_length x' + principal_point[0]
    v = focal_length pixel_aspect_ratio y' + principal_point[1]
    x' = x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2)
    y' = y (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_2 x y + p_1 (r^2 + 2 y^2)

Our camera has no distortion. Pictures of a lens with distortion are resampled bilinearly to what it
would show without distortion, with their border repeated beyond their edge. D3DGS ignores the
distortion, and takes the middle of the picture for the principal point. Cameras with a `skew` are
refused.
"""

from functools import partial

import numpy as np

from .fields import (
    MAX_COORDINATE,
    MAX_LENS,
    REQUIRED,
    fields,
    list_of,
    numbers,
    require_field,
    text,
    value_of_type,
)
from .files import make_view, read_image, read_json, read_points
from .scene import FOCAL, PRINCIPAL, rotation

SPLITS = "dataset.json"
FULL = "the files of a HyperNeRF or NeRF-DS folder"
PAIR, TRIPLE = partial(PRINCIPAL, shape=(2,)), partial(PRINCIPAL, shape=(3,))
NAMES = partial(list_of, check=text, unique=True)
COUNT = partial(numbers, low=0, high=MAX_LENS, kind=int)
DATASET = dict.fromkeys(("train_ids", "val_ids", "ids"), (NAMES, ()))
WORLD = {"center": (TRIPLE, REQUIRED), "scale": (FOCAL, REQUIRED)}
# Lengths are pixels of the full picture, counted from its corner.
CAMERA = {
    "orientation": (rotation, REQUIRED),
    "position": (TRIPLE, REQUIRED),
    "focal_length": (FOCAL, REQUIRED),
    "pixel_aspect_ratio": (FOCAL, 1.0),
    "principal_point": (PAIR, REQUIRED),
    "skew": (partial(numbers, low=0, high=0), 0.0),
    "image_size": (partial(numbers, low=1, high=MAX_LENS, shape=(2,)), REQUIRED),
    "radial_distortion": (TRIPLE, np.zeros(3)),
    "tangential_distortion": (PAIR, np.zeros(2)),
}


def find_views(folder, downscale):
    """Return {"train", "test", "points"}: the readers of both splits, as in `dnerf`, and points.

    `downscale` divides the sides of the largest pictures that the folder has.
    """
    splits = read_splits(folder)
    times = read_times(folder, splits["train"] + splits["test"])
    ratio, rest = choose_pictures(folder, downscale)
    points = place(folder, read_points(folder / "points.npy"))
    readers = {
        name: partial(read_view, folder, name, read_camera(folder, name), time, ratio, rest)
        for name, time in times.items()
    }
    return {
        **{split: [readers[name] for name in names] for split, names in splits.items()},
        "points": points,
    }


def read_splits(folder):
    """Read the names of the views of both splits.

    They are train_ids and val_ids. If val_ids is empty, as in scenes that test interpolation in
    time, the first of every four `ids` is for training and the third for testing.
    """
    file = folder / SPLITS
    listed = fields(read_json(file, FULL), file, DATASET, others=True)
    splits = [listed.train_ids, listed.val_ids]
    train, test = splits if listed.val_ids else [listed.ids[::4], listed.ids[2::4]]
    require_field(
        train and test and not {*train} & {*test},
        file,
        "expected train_ids and val_ids that share no view, or at least three ids",
    )
    return {"train": train, "test": test}


def read_times(folder, names):
    """Read the time in [0, 1] of every view by its name: its time_id over the largest of all."""
    file = folder / "metadata.json"
    moments, numbered = read_json(file, FULL), {}
    for name in names:
        moment = value_of_type(moments.get(name, REQUIRED), f"{file}: {name}", dict)
        number = moment.get("time_id", moment.get("warp_id", REQUIRED))
        numbered[name] = COUNT(number, f"{file}: {name}.time_id")
    last = max(1, *numbered.values())
    return {name: number / last for name, number in numbered.items()}


def choose_pictures(folder, downscale):
    """Return the N of the folder rgb/Nx to read, and the factor that remains for its pictures.

    The folder with the smallest suitable pictures is taken; the rest is done by averaging pixels.
    """
    names = [path.name[:-1] for path in folder.glob("rgb/[1-9]*x")]
    ratios = [int(name) for name in names if name.isdecimal()]
    require_field(ratios, folder / "rgb", "no pictures; expected a folder such as 1x or 2x")
    wanted = min(ratios) * downscale
    ratio = max(ratio for ratio in ratios if wanted % ratio == 0)
    return ratio, wanted // ratio


def place(folder, x):
    """Return points [A, 3] in the coordinates of a folder's files, in scene units."""
    file = folder / "scene.json"
    world = fields(read_json(file, FULL), file, WORLD, others=True)
    placed = (x - world.center) * world.scale
    require_field(
        np.all(np.abs(placed) <= MAX_COORDINATE),
        f"{file}: scale",
        f"puts a camera or point beyond {MAX_COORDINATE:g}; expected a smaller scale",
    )
    return placed


def read_camera(folder, name):
    """Read the fields of a view's camera file."""
    file = folder / "camera" / f"{name}.json"
    data = read_json(file, f"the camera of the view {name}")
    if "tangential" in data:  # the name in older files
        data["tangential_distortion"] = data["tangential"]
    return fields(data, file, CAMERA, others=True)


def read_view(folder, name, lens, time, ratio, downscale, color, notes):
    """Return one view from its picture in rgb/<ratio>x, with sides divided by `downscale`."""
    file = f"rgb/{ratio}x/{name}"
    where = f"{folder}: {file}"
    image, shown = read_image(folder, file, where, notes)
    size = np.array(image.shape[1::-1])
    require_field(
        np.all(np.abs(lens.image_size - ratio * size) < ratio),
        where,
        f"{shown}; expected 1/{ratio} of image_size in camera/{name}.json",
    )
    stride = lens.image_size / size  # not exactly `ratio` if it does not divide the sides
    focal = lens.focal_length * np.array([1, lens.pixel_aspect_ratio]) / stride
    middle = lens.principal_point / stride
    bent = focal, middle, lens.radial_distortion, lens.tangential_distortion
    R = lens.orientation
    T = -R @ place(folder, lens.position)
    return make_view(name, image, bent, R, T, time, color, downscale, where, notes)
