"""Reads scenes in the layout of D-NeRF: transforms_{train,val,test}.json beside PNG files.

The files count pixels from the corner of the image, and their cameras look along -z with y up, as
in OpenGL. Ours count from the centre of the first pixel and look along +z with y down, as in OpenCV
(Q20). Therefore c_x = cx/s - 1/2 after downscaling by s, and the second and third column of every
camera-to-world matrix change their sign.
"""

import math
import os
from functools import partial

import numpy as np

from ..splatting.camera import Camera
from .fields import REQUIRED, fields, list_of, numbers, require, text
from .files import read_image, read_json, shrink
from .scene import FOCAL, NUMBER, PRINCIPAL, SHARE, View, rotation

# Signs of the columns of a camera-to-world matrix: right stays, up becomes down, back forward.
OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])


def world_to_camera(value, where):
    """R and T from world to camera in OpenCV axes, from the matrix of a file."""
    c2w = NUMBER(value, where, shape=(4, 4))
    require(
        np.abs(c2w[3] - (0, 0, 0, 1)).max() <= 1e-6,
        where,
        "the last row is not 0 0 0 1; expected a rigid camera-to-world matrix",
    )
    R = (rotation(c2w[:3, :3], where) * OPENGL_TO_OPENCV).T
    return R, -R @ c2w[:3, 3]


FRAME = {
    "file_path": (text, REQUIRED),
    "time": (SHARE, REQUIRED),
    "transform_matrix": (world_to_camera, REQUIRED),
}
TRANSFORMS = {
    "camera_angle_x": (partial(numbers, low=1e-6, high=math.pi - 1e-6), None),  # radians
    **dict.fromkeys(("fl_x", "fl_y"), (FOCAL, None)),  # pixels
    **dict.fromkeys(("cx", "cy"), (PRINCIPAL, None)),
    "frames": (partial(list_of, check=partial(fields, table=FRAME, others=True)), REQUIRED),
}


def read(folder, color, downscale):
    """The views of every split, {"train": ..., "test": ...}; the split `val` may be absent."""
    return {
        split: read_split(folder, file, color, downscale)
        for split in ("train", "test", "val")
        for file in [folder / f"transforms_{split}.json"]
        if split != "val" or os.path.lexists(file)
    }


def read_split(folder, file, color, downscale):
    """The views of one transforms file; every field is checked before the first picture is read."""
    data = fields(read_json(file), file, TRANSFORMS, others=True)
    require(data.frames, f"{file}: frames", "empty; expected at least one view")
    require(
        data.camera_angle_x or data.fl_x,
        f"{file}: camera_angle_x",
        "missing; expected an angle in radians, or fl_x in pixels",
    )
    lens = data.camera_angle_x, data.fl_x, data.fl_y, data.cx, data.cy
    views = []
    for i, frame in enumerate(data.frames):
        name, where = frame.file_path, f"{file}: frames[{i}].file_path"
        image = read_image(folder, name, where)
        camera = make_camera(*frame.transform_matrix, *lens, *image.shape[1::-1], downscale)
        shown = name.removeprefix("./").removesuffix(".png")
        views.append(View(shown, *shrink(image, color, downscale, where), camera, frame.time))
    return tuple(views)


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
