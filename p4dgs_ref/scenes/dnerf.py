"""Reads scenes in the layout of D-NeRF: transforms_{train,val,test}.json beside PNG files.

The files count pixels from the corner of the image, and their cameras look along -z with y up, as
in OpenGL. Ours count from the centre of the first pixel and look along +z with y down, as in OpenCV
(Q20). Therefore c_x = cx/s - 1/2 after downscaling by s, and the second and third column of every
camera-to-world matrix change their sign.
"""

import math
import os

import numpy as np

from ..splatting.camera import Camera
from .files import read_image, read_json, shrink
from .scene import (
    LARGEST_LENS,
    LEAST_LENS,
    View,
    check_rotation,
    check_time,
    numbers,
    require,
)

# Least and largest value of the fields that describe the lens: radians, then pixels.
LENS = {
    "camera_angle_x": (1e-6, math.pi - 1e-6),
    "fl_x": (LEAST_LENS, LARGEST_LENS),
    "fl_y": (LEAST_LENS, LARGEST_LENS),
    "cx": (-LARGEST_LENS, LARGEST_LENS),
    "cy": (-LARGEST_LENS, LARGEST_LENS),
}
# Signs of the columns of a camera-to-world matrix: right stays, up becomes down, back forward.
OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])


def read(folder, color, downscale):
    """The views of every split, {"train": ..., "test": ...}; the split `val` may be absent."""
    files = {split: folder / f"transforms_{split}.json" for split in ("train", "test", "val")}
    return {
        split: read_split(folder, file, color, downscale)
        for split, file in files.items()
        if split != "val" or os.path.lexists(file)
    }


def read_split(folder, file, color, downscale):
    """The views of one transforms file; every field is checked before the first picture is read."""
    data = read_json(file)
    frames, where = data.get("frames"), f"{file}: frames"
    require(isinstance(frames, list), where, "missing or not a list; expected the list of views")
    require(frames, where, "empty; expected at least one view")
    angle, fl_x, fl_y, cx, cy = read_lens(data, file)
    posed = [read_frame(frame, f"{where}[{i}]") for i, frame in enumerate(frames)]
    views = []
    for i, (name, time, R, T) in enumerate(posed):
        place = f"{where}[{i}].file_path"
        image = read_image(folder, name, place)
        height, width = image.shape[:2]
        camera = make_camera(R, T, angle, fl_x, fl_y, cx, cy, width, height, downscale)
        shown = name.removeprefix("./").removesuffix(".png")
        views.append(View(shown, *shrink(image, color, downscale, place), camera, time))
    return tuple(views)


def read_lens(data, file):
    """The fields of LENS; None for each that is absent. One of the first two is required."""
    lens = [
        None if data.get(name) is None else float(numbers(data[name], f"{file}: {name}", (), *ends))
        for name, ends in LENS.items()
    ]
    require(
        lens[:2] != [None, None],
        f"{file}: camera_angle_x",
        "missing; expected an angle in radians, or fl_x in pixels",
    )
    return lens


def read_frame(frame, where):
    """The file_path, time, R and T of a frame, R and T from world to camera in OpenCV axes."""
    require(
        isinstance(frame, dict),
        where,
        "not an object; expected file_path, time and transform_matrix",
    )
    name = frame.get("file_path")
    require(
        isinstance(name, str) and name and name.isprintable(),
        f"{where}.file_path",
        f"{name!r}; expected the name of a picture, without control characters",
    )
    time = check_time(frame.get("time"), f"{where}.time")
    place = f"{where}.transform_matrix"
    c2w = numbers(frame.get("transform_matrix"), place, (4, 4))
    require(
        np.abs(c2w[3] - (0, 0, 0, 1)).max() <= 1e-6,
        place,
        "the last row is not 0 0 0 1; expected a rigid camera-to-world matrix",
    )
    check_rotation(c2w[:3, :3], place)
    R = (c2w[:3, :3] * OPENGL_TO_OPENCV).T
    return name, time, R, -R @ c2w[:3, 3]


def make_camera(R, T, angle, fl_x, fl_y, cx, cy, width, height, downscale):
    """The camera of the downscaled image; the fields of the file are for the full one."""
    f_x = width / 2 / math.tan(angle / 2) if fl_x is None else fl_x
    f_y = f_x if fl_y is None else fl_y  # pixels are square unless the file says otherwise
    cx = width / 2 if cx is None else cx
    cy = height / 2 if cy is None else cy
    return Camera(
        R,
        T,
        f_x / downscale,
        f_y / downscale,
        cx / downscale - 0.5,
        cy / downscale - 0.5,
        width // downscale,
        height // downscale,
    )
