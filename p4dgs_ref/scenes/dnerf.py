"""Reads scenes in the layout of D-NeRF: transforms_{train,val,test}.json beside PNG files.

The files count pixels from the corner of the image, and their cameras look along -z with y up, as
in OpenGL. Ours count from the centre of the first pixel and look along +z with y down, as in OpenCV
(Q20). Therefore c_x = cx/s - 1/2 after downscaling by s, and the second and third column of every
camera-to-world matrix change their sign.
"""

import json
import math
import os
import warnings
from importlib import resources
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import ArrayLike

from ..splatting.camera import Camera
from .output import write_atomically
from .scene import (
    FARTHEST,
    LARGEST_LENS,
    MODEL_EFFECTS,
    SIMULATOR_EFFECTS,
    Scene,
    SceneError,
    View,
    as_array,
    as_float,
    background_color,
    check_rotation,
    check_time,
    is_number,
    model_effects,
    over_background,
    require,
    size_of,
)

# Signs of the columns of a camera-to-world matrix: right stays, up becomes down, back forward.
OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])
DESCRIPTION = "scene.json"
LARGEST_JSON = 2**27  # bytes; a view takes about 500


def load_scene(
    path: str | Path, background: str | ArrayLike = "white", downscale: int = 1
) -> Scene:
    """Read a scene from a folder, or one of the packaged scenes by its name.

    A folder of the same name is preferred to a packaged scene. `background` is "white", "black" or
    three numbers; RGBA pictures are laid over it. `downscale` divides both sides of the images:
    pixels are averaged in boxes. The split `val` may be absent. A scene.json in the folder may list
    the scene's `effects`; without that list a scene has all of the model's. Raises SceneError with
    one line that names the file, the field and what was expected.
    """
    folder = find_scene(path)
    require(
        is_number(downscale, int, np.integer) and downscale >= 1,
        "downscale",
        f"{downscale!r}; expected an integer of at least 1",
    )
    effects = model_effects(
        read_description(folder).get("effects"), f"{folder / DESCRIPTION}: effects"
    )
    color = background_color(background, effects, folder)
    files = {split: folder / f"transforms_{split}.json" for split in ("train", "test", "val")}
    splits = {
        split: read_split(folder, file, color, int(downscale))
        for split, file in files.items()
        if split != "val" or os.path.lexists(file)
    }
    return Scene(folder.resolve().name, effects=effects, background=color, source=folder, **splits)


def read_description(folder: Path) -> dict:
    """The scene.json of a scene's folder; empty where there is none."""
    file = folder / DESCRIPTION
    return read_json(file) if os.path.lexists(file) else {}


def list_effects(folder: Path, effects: list[str]) -> Path:
    """Write a scene's list of effects to its scene.json and return that file.

    Everything else in the file stays, and so do effects of the simulator alone.
    """
    file, description = folder / DESCRIPTION, read_description(folder)
    listed = description.get("effects") or []
    drawn = [name for name in listed if name in SIMULATOR_EFFECTS and name not in MODEL_EFFECTS]
    text = json.dumps({**description, "effects": [*effects, *drawn]}, indent=1) + "\n"
    write_atomically(file, lambda opened: opened.write(text.encode()))
    return file


def packaged_folder() -> Path:
    """The folder of the packaged scenes: package data, or tiny_scenes at the top of a checkout."""
    try:
        return Path(str(resources.files("p4dgs_ref.tiny_scenes")))
    except ModuleNotFoundError:
        return Path(__file__).resolve().parents[2] / "tiny_scenes"


def packaged_scenes() -> list[str]:
    """The names of the packaged scenes."""
    return sorted(file.parent.name for file in packaged_folder().glob("*/scene.json"))


def find_scene(path):
    """The folder that a path or the name of a packaged scene stands for."""
    folder = Path(path)
    if folder.is_dir():
        return folder
    require(not folder.exists(), folder, "a file; expected a folder with transforms_train.json")
    names = packaged_scenes()
    require(
        str(path) in names,
        folder,
        f"no such folder; expected one, or a packaged scene: {', '.join(names)}",
    )
    return packaged_folder() / str(path)


def read_json(file, expected="a D-NeRF folder with transforms_train.json and transforms_test.json"):
    """The JSON object in a file; `expected` ends the message about a missing file."""
    require(
        not file.exists() or file.is_file() and file.stat().st_size <= LARGEST_JSON,
        file,
        f"a directory, a device or larger than {LARGEST_JSON} bytes; expected a JSON file",
    )
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SceneError(file, f"missing; expected {expected}") from None
    except OSError as error:
        raise SceneError(file, f"cannot be read ({error.strerror}); expected a JSON file") from None
    except (ValueError, RecursionError) as error:
        raise SceneError(file, f"malformed ({error}); expected JSON in UTF-8") from None
    require(isinstance(data, dict), file, f"a {type(data).__name__}; expected a JSON object")
    return data


def read_split(folder, file, color, downscale):
    """The views of one transforms file; every field is checked before the first picture is read."""
    data = read_json(file)
    frames, where = data.get("frames"), f"{file}: frames"
    require(isinstance(frames, list), where, "missing or not a list; expected the list of views")
    require(frames, where, "empty; expected at least one view")
    focal = read_focal(data, file)
    posed = [read_frame(frame, f"{where}[{i}]") for i, frame in enumerate(frames)]
    views = []
    for i, (name, time, R, T) in enumerate(posed):
        place = f"{where}[{i}].file_path"
        image = read_image(folder, name, place)
        height, width = image.shape[:2]
        require(
            height % downscale == 0 and width % downscale == 0,
            place,
            f"{name} has {size_of(image)} pixels; "
            f"expected sides divisible by downscale {downscale}",
        )
        # before the averaging, so that every colour is weighted by its alpha
        pixels, alpha = over_background(image, color)
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
    """The fields camera_angle_x, fl_x, fl_y, cx and cy; None for each that is absent.

    One of the first two is required.
    """

    def number(name, low, high, expected):
        value = data.get(name)
        if value is None:
            return None
        require(
            is_number(value, int, float) and low < value < high,
            f"{file}: {name}",
            f"{value!r}; expected {expected}",
        )
        return float(value)

    angle = number("camera_angle_x", 0, math.pi, "an angle in radians between 0 and pi")
    most, expected = LARGEST_LENS, "number of pixels"
    fl_x, fl_y = (number(name, 0, most, f"a positive {expected}") for name in ("fl_x", "fl_y"))
    cx, cy = (number(name, -most, most, f"a finite {expected}") for name in ("cx", "cy"))
    require(
        angle is not None or fl_x is not None,
        f"{file}: camera_angle_x",
        "missing; expected an angle in radians, or fl_x in pixels",
    )
    return angle, fl_x, fl_y, cx, cy


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
    c2w, place = as_array(frame.get("transform_matrix")), f"{where}.transform_matrix"
    require(
        c2w.shape == (4, 4),
        place,
        "missing or of another shape; expected 4 rows of 4 numbers",
    )
    require(
        np.all(np.abs(c2w) <= FARTHEST) and np.abs(c2w[3] - (0, 0, 0, 1)).max() <= 1e-6,
        place,
        f"not finite or beyond {FARTHEST:g}, or the last row is not 0 0 0 1; expected a rigid "
        "camera-to-world matrix",
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


def read_image(folder, name, where):
    """The pixels of a picture as float32 [H, W, 3 or 4]; the name may leave out .png."""
    file = folder / name
    if not os.path.isfile(file):  # unlike Path.is_file, also False for an impossible name
        file = folder / f"{name}.png"
    require(os.path.isfile(file), where, f"no picture {name!r}; expected {file}")
    inside = file.resolve().is_relative_to(folder.resolve())
    require(inside, where, f"{name!r} is outside; expected a picture in the folder {folder}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a picture so large that it could be an attack
            with iio.imopen(file, "r", plugin="pillow") as picture:
                clear = "transparency" in picture.metadata()  # a palette or a colour with an alpha
                image = picture.read(mode="RGBA" if clear else None)
    except Exception:  # a broken file can fail in any layer of the decoder
        raise SceneError(
            where, f"{file} cannot be read; expected a PNG of RGB or RGBA pixels"
        ) from None
    return as_float(image, f"{where}: {file}")


def box_filter(image, s):
    """The means over boxes of s by s pixels."""
    if s == 1:
        return image
    height, width = image.shape[0] // s, image.shape[1] // s
    boxes = image.reshape(height, s, width, s, *image.shape[2:])
    return boxes.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
