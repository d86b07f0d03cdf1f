"""Finds a scene by path or name, recognises its format by its files, and reads it."""

import os
import warnings
from pathlib import Path

from numpy.typing import ArrayLike

from ..effects import MOTION
from . import dnerf, hypernerf
from .fields import MAX_LENS, numbers, require
from .files import read_json, read_points
from .scene import WHITE, Scene, background_color, model_effects

DESCRIPTION = "scene.json"


def load_scene(
    path: str | Path,
    background: ArrayLike = WHITE,
    downscale: int = 1,
    progress=lambda done, total: None,
) -> Scene:
    """Read a scene from a folder, or one of the packaged scenes by its name.

    A folder of the same name is preferred to a packaged scene. RGBA pictures are laid over the
    colour `background` [3]. `downscale` divides both sides of the images: pixels are averaged in
    boxes, and less than a box at the right and below is cut off. `progress(done, total)` is called
    before every picture. A scene.json in the folder may list the scene's `effects`; without that
    list a scene has all of the model's, or none of motion where no picture has a time. `dnerf` and
    `hypernerf` describe the layouts that are read. Raises SceneError with one line that names the
    file, the field and what was expected. Warns of fields that are not read, of colours that look
    as if they were multiplied by alpha, and where no picture has a time.
    """
    folder = find_scene(path)
    downscale = numbers(downscale, "downscale", 1, MAX_LENS, kind=int)
    effects = model_effects(
        read_scene_json(folder).get("effects"), f"{folder / DESCRIPTION}: effects"
    )
    color = background_color(background, effects, folder)
    read = hypernerf.read if is_hypernerf(folder) else dnerf.read
    views = read(folder, color, downscale, progress)
    if views.pop("still", False):
        warnings.warn(f"{folder}: no picture has a time: all times are 0, and nothing moves")
        effects = {*effects} - {*MOTION}
    return Scene(folder.resolve().name, effects=effects, background=color, source=folder, **views)


def is_hypernerf(folder):
    """Whether a folder has the files of HyperNeRF and NeRF-DS rather than those of D-NeRF."""
    return not os.path.lexists(folder / "transforms_train.json") and os.path.lexists(
        folder / hypernerf.SPLITS
    )


def read_points_for(scene, path):
    """The points of a file, in the units of a scene.

    A file for a HyperNeRF or NeRF-DS scene has the coordinates of that scene's own files.
    """
    points = read_points(path)
    return hypernerf.place(scene.source, points) if is_hypernerf(scene.source) else points


def read_scene_json(folder: Path) -> dict:
    """The scene.json of a scene's folder; empty where there is none."""
    file = folder / DESCRIPTION
    return read_json(file) if os.path.lexists(file) else {}


def packaged_folder() -> Path:
    """The folder of the packaged scenes: package data, or tiny_scenes at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "tiny_scenes"
    return installed if installed.is_dir() else package.parent / "tiny_scenes"


def packaged_scenes() -> list[str]:
    """The names of the packaged scenes."""
    return sorted(file.parent.name for file in packaged_folder().glob("*/scene.json"))


def find_scene(path):
    """The folder that a path or the name of a packaged scene stands for."""
    folder = Path(path)
    if folder.is_dir():
        return folder
    names = packaged_scenes()
    require(
        str(path) in names,
        folder,
        f"no such folder; expected one, or a packaged scene: {', '.join(names)}",
    )
    return packaged_folder() / str(path)
