"""Finds a scene by path or name, recognises its format by its files, and reads it."""

import os
import warnings
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..effects import MOTION
from . import dnerf, hypernerf
from .fields import MAX_LENS, numbers, require_field
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

    A folder of the same name is preferred to a packaged scene; a .json in a folder stands for the
    folder. RGBA pictures are laid over the colour `background` [3]. `downscale` divides both sides
    of the images: pixels are averaged in boxes, and incomplete boxes at the right or bottom are cut
    off. `progress(done, total)` is called before every picture. A scene.json in the folder may list
    the scene's `effects`; without that list a scene has all of the model's, or none of motion if no
    picture has a time. `dnerf` and `hypernerf` describe the layouts that are read. Raises
    SceneError with one line that names the file, the field and what was expected. Warns, once for
    all pictures, of ignored fields, of frames without a picture, of orientations in EXIF, of
    colours that look as if they were multiplied by alpha, and if no picture has a time.
    """
    return find_views(path, background, downscale).read(progress)


@dataclass
class SceneFiles:
    """A scene whose files are found and checked, and whose pictures are not read yet."""

    folder: Path
    effects: Collection[str]
    background: np.ndarray
    train: list  # of functions that read a View
    test: list
    points: np.ndarray | None = None

    def read(self, progress):
        """Read all pictures and return the Scene."""
        notes, total, views = Counter(), len(self.train) + len(self.test), []
        for done, read_view in enumerate([*self.train, *self.test]):
            progress(done, total)
            views.append(read_view(self.background, notes))
        for sentence, count in notes.items():
            if count:
                warnings.warn(f"{self.folder}: {count} of {total} pictures {sentence}")
        train, test = views[: len(self.train)], views[len(self.train) :]
        name = self.folder.resolve().name
        return Scene(name, train, test, self.effects, self.background, self.folder, self.points)


def find_views(path, background=WHITE, downscale=1):
    """Return the SceneFiles of a path or of the name of a packaged scene; see `load_scene`."""
    folder = find_scene(path)
    downscale = numbers(downscale, "downscale", 1, MAX_LENS, kind=int)
    effects = model_effects(
        read_scene_json(folder).get("effects"), f"{folder / DESCRIPTION}: effects"
    )
    color = background_color(background, effects, folder)
    layout = hypernerf if is_hypernerf(folder) else dnerf
    views = layout.find_views(folder, downscale)
    if views.pop("still", False):
        warnings.warn(f"{folder}: no picture has a time: all times are 0, and nothing moves")
        effects = {*effects} - {*MOTION}
    return SceneFiles(folder, effects, color, **views)


def is_hypernerf(folder):
    """Return whether a folder has the files of HyperNeRF and NeRF-DS rather than of D-NeRF."""
    return not os.path.lexists(folder / "transforms_train.json") and os.path.lexists(
        folder / hypernerf.SPLITS
    )


def read_points_for(folder, path):
    """Return the points of a file, in the units of the scene in a folder.

    A file for a HyperNeRF or NeRF-DS scene has coordinates like those in that scene's own files.
    """
    points = read_points(path)
    return hypernerf.place(folder, points) if is_hypernerf(folder) else points


def read_scene_json(folder: Path) -> dict:
    """Read the scene.json of a scene's folder; empty if there is none."""
    file = folder / DESCRIPTION
    return read_json(file) if os.path.lexists(file) else {}


def packaged_folder() -> Path:
    """Return the folder of the packaged scenes: package data, or tiny_scenes of a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "tiny_scenes"
    return installed if installed.is_dir() else package.parent / "tiny_scenes"


def packaged_scenes() -> list[str]:
    """Return the names of the packaged scenes."""
    return sorted(file.parent.name for file in packaged_folder().glob("*/scene.json"))


def find_scene(path):
    """Return the folder that a path or the name of a packaged scene stands for."""
    folder = Path(path)
    if folder.suffix == ".json" and folder.is_file():
        folder = folder.parent
    if folder.is_dir():
        return folder
    names = packaged_scenes()
    require_field(
        str(path) in names,
        folder,
        f"no such folder; expected one, or a packaged scene: {', '.join(names)}",
    )
    return packaged_folder() / str(path)
