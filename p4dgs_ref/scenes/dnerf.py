"""Reads D-NeRF (Blender) folders: transforms_{train,val,test}.json beside PNG files; also the packaged scenes.

A file counts pixels from the image's corner and its cameras look along -z with y up (OpenGL); ours count
from the first pixel's centre and look along +z with y down (Q20).  Hence c_x = cx/s - 1/2 after downscaling
by s, and the second and third column of every camera-to-world matrix change sign.
"""

import json
import math
import os
from importlib import resources
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from ..splatting.camera import Camera
from .scene import (
    Scene,
    SceneError,
    View,
    as_array,
    as_float,
    background_color,
    check_effects,
    check_rotation,
    check_time,
    model_effects,
    over_background,
)

OPENGL_TO_OPENCV = np.array(
    [1.0, -1.0, -1.0]
)  # signs of the columns right, up -> down, back -> forward


def load_scene(path, background="white", downscale=1):
    """Read a scene from a D-NeRF folder, or one of the packaged scenes by its name.

    Shapes     path: a folder (it wins over a name); background: "white", "black" or three numbers
    Units      downscale: an integer that divides both sides of the images; pixels are averaged in boxes
    Domain     RGBA (laid over the background) or RGB files, time in [0, 1]; the split `val` may be absent
    Raises     SceneError, one line: file, field, expectation
    Choice     Q20; a scene.json beside the images may list `effects`; without `background` in it, black
    """
    folder = find_scene(path)
    if isinstance(downscale, bool) or not isinstance(downscale, (int, np.integer)) or downscale < 1:
        raise SceneError("downscale", f"{downscale!r}; expected an integer of at least 1")
    effects = model_effects(read_effects(folder), f"{folder / 'scene.json'}: effects")
    color = background_color(background, effects, folder)
    splits = {}
    for split in ("train", "test", "val"):
        file = folder / f"transforms_{split}.json"
        if split != "val" or file.is_file():
            splits[split] = read_split(folder, file, color, int(downscale))
    first = splits["train"][0]
    for view in (view for views in splits.values() for view in views):
        if view.image.shape != first.image.shape:
            raise SceneError(
                f"{folder}: {view.name}",
                f"{size_of(view.image)} pixels; expected {size_of(first.image)} as {first.name}",
            )
    return Scene(folder.resolve().name, effects=effects, background=color, source=folder, **splits)


def size_of(image):
    return f"{image.shape[1]}x{image.shape[0]}"


def packaged_folder():
    """Where the packaged scenes are: package data once installed, the top-level tiny_scenes in a checkout."""
    try:
        return Path(str(resources.files("p4dgs_ref.tiny_scenes")))
    except ModuleNotFoundError:
        return Path(__file__).resolve().parents[2] / "tiny_scenes"


def packaged_scenes():
    """The names that `load_scene` knows, sorted."""
    return sorted(file.parent.name for file in packaged_folder().glob("*/scene.json"))


def find_scene(path):
    """The folder that a path or the name of a packaged scene means."""
    folder = Path(path)
    if folder.is_dir():
        return folder
    if folder.exists():
        raise SceneError(folder, "a file; expected a folder with transforms_train.json")
    if str(path) in packaged_scenes():
        return packaged_folder() / str(path)
    raise SceneError(
        folder, f"no such folder; expected one, or a packaged scene: {', '.join(packaged_scenes())}"
    )


def read_json(file):
    """A JSON object; anything else is a mistake that names the file."""
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SceneError(
            file,
            "missing; expected a D-NeRF folder with transforms_train.json and transforms_test.json",
        ) from None
    except OSError as error:
        raise SceneError(file, f"cannot be read ({error.strerror}); expected a JSON file") from None
    except json.JSONDecodeError as error:
        raise SceneError(
            file, f"line {error.lineno}, column {error.colno}: malformed JSON ({error.msg})"
        ) from None
    except (UnicodeDecodeError, RecursionError):
        raise SceneError(file, "malformed; expected JSON in UTF-8") from None
    if not isinstance(data, dict):
        raise SceneError(file, f"a {type(data).__name__}; expected a JSON object")
    return data


def read_effects(folder):
    """What an optional scene.json lists; None, which means all of the model's, without file or list."""
    file = folder / "scene.json"
    return (
        check_effects(read_json(file).get("effects"), f"{file}: effects")
        if file.is_file()
        else None
    )


def read_split(folder, file, color, downscale):
    """The views of one transforms file; every field is checked before the first picture is opened."""
    data = read_json(file)
    frames = data.get("frames")
    if not isinstance(frames, list):
        raise SceneError(f"{file}: frames", "missing or not a list; expected the list of views")
    if not frames:
        raise SceneError(f"{file}: frames", "empty; expected at least one view")
    focal = read_focal(data, file)
    posed = [read_frame(frame, f"{file}: frames[{i}]") for i, frame in enumerate(frames)]
    views = []
    for i, (name, time, R, T) in enumerate(posed):
        image = read_image(folder, name, f"{file}: frames[{i}].file_path")
        height, width = image.shape[:2]
        if height % downscale or width % downscale:
            raise SceneError(
                f"{file}: frames[{i}].file_path",
                f"{name} has {size_of(image)} pixels; expected "
                f"sides divisible by downscale {downscale}",
            )
        pixels, alpha = over_background(
            image, color
        )  # before the filter: colour is weighted by its alpha
        views.append(
            View(
                name.removeprefix("./").removesuffix(".png"),
                box_filter(pixels, downscale),
                None if alpha is None else box_filter(alpha, downscale),
                make_camera(R, T, *focal, width, height, downscale),
                time,
            )
        )
    return tuple(views)


def read_focal(data, file):
    """(camera_angle_x, fl_x, fl_y, cx, cy): the angle or fl_x is required; what is absent is None."""

    def number(name, low, high, expected):
        value = data.get(name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low < value < high:
            raise SceneError(f"{file}: {name}", f"{value!r}; expected {expected}")
        return float(value)

    angle = number("camera_angle_x", 0, math.pi, "an angle in radians between 0 and pi")
    fl_x, fl_y = (number(name, 0, 1e9, "a positive number of pixels") for name in ("fl_x", "fl_y"))
    cx, cy = (number(name, -1e9, 1e9, "a finite number of pixels") for name in ("cx", "cy"))
    if angle is None and fl_x is None:
        raise SceneError(
            f"{file}: camera_angle_x", "missing; expected an angle in radians, or fl_x in pixels"
        )
    return angle, fl_x, fl_y, cx, cy


def read_frame(frame, where):
    """(file_path, time, R, T) of one frame, R and T from world to camera in OpenCV axes."""
    if not isinstance(frame, dict):
        raise SceneError(where, "not an object; expected file_path, time and transform_matrix")
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise SceneError(f"{where}.file_path", f"{name!r}; expected the name of a picture")
    time = check_time(frame.get("time"), f"{where}.time")
    c2w = as_array(frame.get("transform_matrix"))
    if c2w is None or c2w.shape != (4, 4):
        raise SceneError(
            f"{where}.transform_matrix", "missing or of another shape; expected 4 rows of 4 numbers"
        )
    if not np.all(np.isfinite(c2w)) or np.abs(c2w[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise SceneError(
            f"{where}.transform_matrix",
            "not finite, or the last row is not 0 0 0 1; expected a rigid camera-to-world matrix",
        )
    check_rotation(c2w[:3, :3], f"{where}.transform_matrix")
    R = (c2w[:3, :3] * OPENGL_TO_OPENCV).T
    return name, time, R, -R @ c2w[:3, 3]


def make_camera(R, T, angle, fl_x, fl_y, cx, cy, width, height, downscale):
    """A camera for the downscaled image from what the file says about the full one."""
    f_x = width / 2 / math.tan(angle / 2) if fl_x is None else fl_x
    f_y = f_x if fl_y is None else fl_y  # square pixels unless the file says otherwise
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
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


def read_image(folder, name, where):
    """Pixels as float32 (H, W, 3 or 4); the original files name pictures without their extension."""
    file = folder / name
    if not os.path.isfile(file):
        file = folder / f"{name}.png"
    if not os.path.isfile(file):  # also false for a name that no file can bear
        raise SceneError(where, f"no picture {name!r}; expected {file}")
    try:
        image = iio.imread(file)
    except Exception:  # a broken file can fail in any layer of the decoder
        raise SceneError(
            where, f"{file} cannot be read; expected a PNG of RGB or RGBA pixels"
        ) from None
    return as_float(image, f"{where}: {file}")


def box_filter(image, s):
    """Means over boxes of s by s pixels."""
    if s == 1:
        return image
    height, width = image.shape[0] // s, image.shape[1] // s
    return (
        image.reshape(height, s, width, s, *image.shape[2:])
        .mean(axis=(1, 3), dtype=np.float64)
        .astype(np.float32)
    )
