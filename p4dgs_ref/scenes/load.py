"""Finds a scene by path or name, recognises its format by its files, and reads it."""

import json
import os
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from ..output import write_atomically
from . import dnerf, hypernerf
from .fields import MAX_LENS, numbers, require
from .files import read_json, read_points
from .scene import MODEL_EFFECTS, Scene, background_color, model_effects

DESCRIPTION = "scene.json"


def load_scene(
    path: str | Path, background: str | ArrayLike = "white", downscale: int = 1
) -> Scene:
    """Read a scene from a folder, or one of the packaged scenes by its name.

    A folder of the same name is preferred to a packaged scene. `background` is "white", "black" or
    three numbers; RGBA pictures are laid over it. `downscale` divides both sides of the images:
    pixels are averaged in boxes. A scene.json in the folder may list the scene's `effects`; without
    that list a scene has all of the model's. `dnerf` and `hypernerf` describe the two layouts that
    are read. Raises SceneError with one line that names the file, the field and what was expected.
    """
    folder = find_scene(path)
    downscale = numbers(downscale, "downscale", 1, MAX_LENS, kind=int)
    effects = model_effects(
        read_scene_json(folder).get("effects"), f"{folder / DESCRIPTION}: effects"
    )
    color = background_color(background, effects, folder)
    read = hypernerf.read if is_hypernerf(folder) else dnerf.read
    views: dict[str, Any] = read(folder, color, downscale)
    return Scene(folder.resolve().name, effects=effects, background=color, source=folder, **views)


def is_hypernerf(folder):
    """Whether a folder has the files of HyperNeRF and NeRF-DS rather than those of D-NeRF."""
    is_dnerf = os.path.lexists(folder / "transforms_train.json")
    return os.path.lexists(folder / hypernerf.SPLITS) and not is_dnerf


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


def list_effects(folder: Path, effects: list[str]) -> Path:
    """Write a scene's list of effects to its scene.json and return that file.

    Everything else in the file stays, and so do effects of the simulator alone.
    """
    file, description = folder / DESCRIPTION, read_scene_json(folder)
    drawn = [name for name in description.get("effects") or () if name not in MODEL_EFFECTS]
    text = json.dumps({**description, "effects": [*effects, *drawn]}, indent=1) + "\n"
    write_atomically(file, lambda opened: opened.write(text.encode()))
    return file


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
