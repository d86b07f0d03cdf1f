"""Reads scenes in the layout of D-NeRF and of instant-ngp: transforms*.json beside pictures.

D-NeRF has transforms_train.json and transforms_test.json; without the latter, the views of
transforms_val.json are for testing. A capture has only one file, transforms.json or one of these:
of its pictures, sorted by name, the first and every eighth after it are for testing, the others for
training. Frames of a capture whose picture is missing are left out; if more than half are missing,
the capture is refused. If no frame has a time, nothing moves: all times are 0.

The files count pixels from the corner of the image, and their cameras look along -z with y up, as
in OpenGL. Ours count from the centre of the first pixel and look along +z with y down, as in OpenCV
(Q20). Therefore c_x = cx/s - 1/2 after downscaling by s, and the second and third column of every
camera-to-world matrix change their sign.

The fields that are used are those of HEAD and FRAME, and `time`. Other fields get a warning, unless
their value changes nothing (`is_neutral`). A frame may have a lens of its own. Focal lengths and
the principal point are in pixels of an image of w x h; if the pictures have another size, they are
scaled. Distortion by k1, k2, p1 and p2 is removed from the pictures, by the formula in `hypernerf`;
other lenses are refused.
"""

import math
import os
import warnings
from contextlib import suppress
from functools import partial

import numpy as np

from .fields import (
    MAX_LENS,
    REQUIRED,
    choice,
    fields,
    list_of,
    numbers,
    require_field,
    shown,
    text,
    value_of_type,
)
from .files import CAPTURE, find_picture, make_view, read_image, read_json
from .scene import FOCAL, NUMBER, PRINCIPAL, SHARE, rotation

# Signs of the columns of a camera-to-world matrix: right stays, up becomes down, back forward.
OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])


def world_to_camera(value, where):
    """Return R and T from world to camera in OpenCV axes, from the matrix of a file."""
    c2w = NUMBER(value, where, shape=(4, 4))
    require_field(
        np.allclose(c2w[3], (0, 0, 0, 1)),
        where,
        "the last row is not 0 0 0 1; expected a rigid camera-to-world matrix",
    )
    R = (rotation(c2w[:3, :3], where) * OPENGL_TO_OPENCV).T
    return R, -R @ c2w[:3, 3]


def is_neutral(value):
    """Return whether a field changes nothing: 0, false, null, empty, zeros or an identity."""
    with suppress(ValueError, TypeError, OverflowError):  # texts, objects, integers of 400 digits
        entries = np.array(value or 0, float)
        # For a matrix this is eye(n, m, 0); for a list it is eye(n, 0), which is empty, not n x n.
        return not entries.any() or np.array_equal(entries, np.eye(*entries.shape, 0))
    return False


def require_neutral(value, where):
    """Refuse a field of another lens."""
    require_field(
        is_neutral(value),
        where,
        f"{shown(value)}; expected 0 or no such field; undistort the pictures of such a lens first",
    )


def optional(names, check, default=None, **settings):
    """Return the rows of fields that may be missing."""
    return dict.fromkeys(names.split(), (partial(check, **settings), default))


PINHOLES = "SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV".split()
LENS = {
    **optional("camera_angle_x camera_angle_y", numbers, low=1e-6, high=math.pi - 1e-6),  # radians
    **optional("fl_x fl_y", FOCAL),  # pixels of an image of w x h
    **optional("cx cy", PRINCIPAL),
    **optional("w h", numbers, low=1, high=MAX_LENS),
    **optional("k1 k2 p1 p2", PRINCIPAL, default=0.0),
    **optional("camera_model", choice, words=PINHOLES),
    **optional(
        "k3 k4 k5 k6 distortion_params skew is_fisheye latlong equirectangular", require_neutral
    ),
}
FRAME = {"file_path": (text, REQUIRED), "transform_matrix": (world_to_camera, REQUIRED)}
HEAD = {"frames": (partial(list_of, check=partial(value_of_type, kind=dict)), REQUIRED), **LENS}
USED = {*HEAD, *FRAME, "time", "rotation"}  # D-NeRF writes a rotation that nobody reads


def find_views(folder, downscale):
    """Return {"train", "test", "still"}: the readers of both splits, and whether nothing moves.

    Every field is checked. A reader is called with the background and with notes (`read_image`),
    and returns the View.
    """
    files = find_files(folder)
    heads = [read_head(file) for file in files]
    still = not any("time" in frame for head in heads for frame in head.frames)
    frames = [
        [
            read_frame(frame, f"{file}: frames[{i}]", head, still)
            for i, frame in enumerate(head.frames)
        ]
        for file, head in zip(files, heads)
    ]
    if len(files) == 1:
        kept = sorted(
            frames_with_picture(folder, files[0], *frames), key=lambda frame: frame.file_path
        )
        frames = [[frame for i, frame in enumerate(kept) if i % 8], kept[::8]]
    train, test = (
        [partial(read_view, folder, frame, downscale) for frame in split] for split in frames
    )
    return {"train": train, "test": test, "still": still}


def find_files(folder):
    """Return the transforms files of training and testing, or the only file that there is."""
    splits = [folder / f"transforms_{split}.json" for split in ("train", "test", "val")]
    present = [file for file in splits if os.path.lexists(file)]
    if splits[0] in present:
        return present[:2]
    if os.path.lexists(folder / CAPTURE):
        return [folder / CAPTURE]
    return present if len(present) == 1 else splits[:2]  # the first is missing: reading it says so


def frames_with_picture(folder, file, frames):
    """Return the frames of a capture whose pictures exist; one warning says how many do not."""
    kept = [frame for frame in frames if find_picture(folder, frame.file_path, frame.where)]
    missing = f"{len(frames) - len(kept)} of {len(frames)} frames have no picture in {folder}"
    require_field(2 * len(kept) >= len(frames), file, f"{missing}; expected one for at least half")
    if len(kept) < len(frames):
        warnings.warn(f"{file}: {missing} and are left out")
    return kept


def read_head(file):
    """Read and check the fields of a transforms file, except those of its frames."""
    content = read_json(file)
    head = fields(content, file, HEAD, others=True)
    require_field(head.frames, f"{file}: frames", "empty; expected at least one view")
    unread = {
        shown(name)
        for entries in (content, *head.frames)
        for name, value in entries.items()
        if name not in USED and not is_neutral(value)
    }
    if unread:
        warnings.warn(f"{file}: these fields are ignored: {', '.join(sorted(unread))}")
    return head


def read_frame(frame, where, head, still):
    """Return the checked fields of a frame, and `where` it is; the file's replace missing ones."""
    lens = {name: (check, getattr(head, name)) for name, (check, _) in LENS.items()}
    time = {"time": (SHARE, 0.0 if still else REQUIRED)}
    values = fields(frame, where, {**FRAME, **time, **lens}, others=True)
    require_field(
        values.camera_angle_x or values.fl_x,
        f"{where}.camera_angle_x",
        "missing; expected an angle in radians, or fl_x in pixels",
    )
    values.where, values.file_path = where, values.file_path.replace("\\", "/")
    return values


def read_view(folder, frame, downscale, color, notes):
    """Return one view from its picture."""
    name, where = frame.file_path, f"{frame.where}.file_path"
    image, size = read_image(folder, name, where, notes)
    lens = lens_of(frame, *image.shape[1::-1], size)
    name = name.removeprefix("./").removesuffix(".png")
    return make_view(
        name, image, lens, *frame.transform_matrix, frame.time, color, downscale, where, notes
    )


def lens_of(frame, width, height, size):
    """Return the lens of a frame in pixels of its picture, as `make_view` takes it.

    `size` is the size of the picture in words.
    """
    w, h = frame.w or width, frame.h or height
    f_x = frame.fl_x or w / 2 / math.tan(frame.camera_angle_x / 2)
    f_y = frame.fl_y or (frame.camera_angle_y and h / 2 / math.tan(frame.camera_angle_y / 2))
    cx, cy = frame.cx or w / 2, frame.cy or h / 2
    angle = 2 * math.atan(w / 2 / f_x)
    require_field(
        math.isclose(frame.camera_angle_x or angle, angle, rel_tol=0.01),
        f"{frame.where}.camera_angle_x",
        f"{frame.camera_angle_x}; expected {angle:.6g}, from fl_x and pictures of width {w:g} (w "
        "and h give the image size that fl_x and fl_y refer to)",
    )
    require_field(
        abs(w * height - h * width) < max(w, h)  # less than a pixel of the shorter side
        and (0 < cx < w and 0 < cy < h),
        f"{frame.where}: w, h, cx, cy",
        f"{w:g}x{h:g}, {cx:g}, {cy:g}; expected the proportions of the picture, {size}, and a "
        "point inside it",
    )
    # Pixels are square unless the file says otherwise.
    focal, middle = np.array([(f_x, f_y or f_x), (cx, cy)]) / (w / width, h / height)
    return focal, middle, np.array([frame.k1, frame.k2, 0]), np.array([frame.p1, frame.p2])
