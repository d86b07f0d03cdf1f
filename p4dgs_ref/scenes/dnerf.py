"""Reads scenes in the layout of D-NeRF: transforms_{train,test}.json beside PNG files.

The files count pixels from the corner of the image, and their cameras look along -z with y up, as
in OpenGL. Ours count from the centre of the first pixel and look along +z with y down, as in OpenCV
(Q20). Therefore c_x = cx/s - 1/2 after downscaling by s, and the second and third column of every
camera-to-world matrix change their sign.

instant-ngp and nerfstudio write such files with more fields. The tables LENS, FRAME and TRANSFORMS
have a row for every field that is read. A field that would change pictures or cameras in another
way is refused unless it is 0, false or empty (`off`). HARMLESS names the fields that only tell
another program how to train. Any other field is named in a warning.

Focal lengths and the principal point are pixels of an image of w x h. Where the pictures have
another size, they are scaled. All views of a file have one lens.
"""

import math
import warnings
from functools import partial

import numpy as np

from ..splatting.camera import Camera
from .fields import MAX_LENS, REQUIRED, choice, fields, list_of, numbers, require, shown, text
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


def off(value, where, expected):
    """Check that a field is 0, false, null, empty, or a list of these."""
    require(
        not (any(value) if isinstance(value, list) else value),
        where,
        f"{shown(value)}; expected {expected}",
    )


def optional(names, check, **settings):
    """The rows of fields that may be missing."""
    return dict.fromkeys(names.split(), (partial(check, **settings), None))


PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
LENS = {
    **optional("camera_angle_x camera_angle_y", numbers, low=1e-6, high=math.pi - 1e-6),  # radians
    **optional("fl_x fl_y", FOCAL),  # pixels of an image of w x h
    **optional("cx cy", PRINCIPAL),
    **optional("w h", numbers, low=1, high=MAX_LENS),
    **optional("camera_model", choice, words=PINHOLES),
    **optional(
        "k1 k2 k3 k4 k5 k6 p1 p2 distortion distortion_params skew is_fisheye fisheye_crop_radius "
        "ftheta_p0 ftheta_p1 ftheta_p2 ftheta_p3 ftheta_p4 latlong equirectangular",
        off,
        expected="0 or no such field; undistort the pictures of such a lens first",
    ),
    **optional(
        "x_fov y_fov fov horizontal_fov vertical_fov intrinsic_matrix intrinsics K",
        off,
        expected="camera_angle_x in radians, or fl_x, fl_y, cx and cy in pixels",
    ),
    **optional("rolling_shutter", off, expected="pictures that were taken at one moment"),
}
FRAME = {
    "file_path": (text, REQUIRED),
    "time": (SHARE, REQUIRED),
    "transform_matrix": (world_to_camera, REQUIRED),
    **optional(" ".join(LENS), off, expected="one lens of all views, beside `frames`"),
    **optional(
        "transform_matrix_start transform_matrix_end",
        off,
        expected="one transform_matrix, of a picture that was taken at one moment",
    ),
    **optional("mask_path", off, expected="pictures with alpha, without a mask beside them"),
}
TRANSFORMS = {
    "frames": (partial(list_of, check=partial(fields, table=FRAME, others=True)), REQUIRED),
    **LENS,
    **optional("from_na normal_mts_args", off, expected="matrices in the axes of OpenGL"),
    **optional(
        "white_transparent black_transparent fix_premult",
        off,
        expected="pictures whose own alpha says what is transparent",
    ),
    **optional("envmap", off, expected="a background of one colour"),
    **optional(
        "train_filenames val_filenames test_filenames",
        off,
        expected="the views of one split in every file",
    ),
}
HARMLESS = (
    "aabb aabb_scale scale offset render_aabb up n_frames n_extra_learnable_dims sharpen "
    "sharpness_discard_threshold importance_sampling integer_depth_scale enable_depth_loading "
    "enable_ray_loading applied_transform applied_scale orientation_override ply_file_path "
    "rotation sharpness depth_path depth_file_path colmap_im_id driver_parameters"
).split()


def read(folder, color, downscale):
    """The views of both splits, {"train": ..., "test": ...}; a split `val` is not read."""
    return {
        split: read_split(folder, folder / f"transforms_{split}.json", color, downscale)
        for split in ("train", "test")
    }


def read_split(folder, file, color, downscale):
    """The views of one transforms file; every field is checked before the first picture is read."""
    data = read_transforms(file)
    views = []
    for i, frame in enumerate(data.frames):
        name, where = frame.file_path.replace("\\", "/"), f"{file}: frames[{i}].file_path"
        image = read_image(folder, name, where)
        size = image.shape[1::-1]
        check_lens(data, *size, file)
        camera = make_camera(*frame.transform_matrix, data, *size, downscale)
        pixels, alpha = shrink(image, color, downscale, where)
        name = name.removeprefix("./").removesuffix(".png")
        views.append(View(name, pixels, alpha, camera, frame.time))
    return tuple(views)


def read_transforms(file):
    """The checked fields of a transforms file."""
    content = read_json(file)
    values = fields(content, file, TRANSFORMS, others=True)
    require(values.frames, f"{file}: frames", "empty; expected at least one view")
    require(
        values.camera_angle_x or values.fl_x,
        f"{file}: camera_angle_x",
        "missing; expected an angle in radians, or fl_x in pixels",
    )
    unknown = {*content}.union(*content["frames"]) - {*TRANSFORMS, *FRAME, *HARMLESS}
    if unknown:
        warnings.warn(f"{file}: fields that are not known are not read: {shown(sorted(unknown))}")
    return values


def check_lens(lens, width, height, file):
    """Refuse fields of a lens that contradict each other, or the size of a picture."""
    w, h = lens.w or width, lens.h or height
    require(
        abs(w * height - h * width) < max(w, h),  # less than a pixel of the shorter side
        f"{file}: w, h",
        f"{w:g}x{h:g}; expected the proportions of the pictures, {width}x{height} pixels",
    )
    for axis, side in (("x", w), ("y", h)):
        focal, angle = getattr(lens, f"fl_{axis}"), getattr(lens, f"camera_angle_{axis}")
        middle = getattr(lens, f"c{axis}")
        require(
            middle is None or 0 < middle < side,
            f"{file}: c{axis}",
            f"{middle}; expected a place inside pictures of {side:g} pixels (w and h say the size "
            "that cx and cy are for)",
        )
        found = 2 * math.atan(side / 2 / focal) if focal else angle or 0.0
        require(
            not angle or abs(found - angle) <= 0.01 * angle,
            f"{file}: camera_angle_{axis}",
            f"{angle}; expected {found:.6g}, by fl_{axis} and pictures of {side:g} pixels (w and h "
            "say the size that fl_x and fl_y are for)",
        )


def make_camera(R, T, lens, width, height, downscale):
    """The camera of a picture of this size after downscaling; the lens is that of w x h."""
    w, h = lens.w or width, lens.h or height
    s_x, s_y = w / width * downscale, h / height * downscale
    f_x = lens.fl_x or w / 2 / math.tan(lens.camera_angle_x / 2)
    f_y = lens.fl_y or (lens.camera_angle_y and h / 2 / math.tan(lens.camera_angle_y / 2))
    cx = w / 2 if lens.cx is None else lens.cx
    cy = h / 2 if lens.cy is None else lens.cy
    return Camera(
        R,
        T,
        f_x / s_x,
        (f_y or f_x) / s_y,  # pixels are square unless the file says otherwise
        cx / s_x - 0.5,
        cy / s_y - 0.5,
        width // downscale,
        height // downscale,
    )
