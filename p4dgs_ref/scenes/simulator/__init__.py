"""Draws a described scene into a D-NeRF folder, from cameras on a sphere at different times.

`description` reads what is drawn, `bodies` has its shapes and motions, `trace` draws a picture.
"""

import json
import math
from pathlib import Path

import numpy as np

from ...output import new_file, staged_folder
from ...splatting.camera import look_at
from ..dnerf import OPENGL_TO_OPENCV
from ..files import write_image
from . import trace
from .description import read_description

# Multiples of these two, modulo 1, spread evenly and never fall in step with each other.
GOLDEN, PLASTIC = 0.6180339887498949, 0.7548776662466927


def simulate(
    scene_json: str | Path,
    out_dir: str | Path,
    progress=lambda done, total: None,
) -> None:
    """Draw all views of a scene.json into a folder.

    The same description gives the same pixels. `progress(done, total)` is called after every
    picture. Nothing reaches the folder before everything is drawn. Raises SceneError for a
    description that cannot be drawn, OutputError for a folder that cannot be written to or whose
    scene.json is the one that is drawn.
    """
    description = read_description(scene_json)
    views = {split: place_cameras(description, split) for split in ("train", "test")}
    total, done = sum(map(len, views.values())), 0
    with new_file(Path(out_dir) / "scene.json", scene_json), staged_folder(out_dir) as folder:
        (folder / "scene.json").write_bytes(Path(scene_json).read_bytes())
        for split, posed in views.items():
            (folder / split).mkdir()
            (folder / f"transforms_{split}.json").write_text(
                transforms(split, posed), encoding="utf-8"
            )
            for i, (camera, t) in enumerate(posed):
                pixels = np.rint(trace.trace(description, camera, t) * 255).astype(np.uint8)
                write_image(folder / split / f"r_{i:03d}.png", pixels, optimize=True)
                done += 1
                progress(done, total)


def place_cameras(description, split):
    """Return the (camera, time) of every view of a split, in the order of time.

    Training views are at evenly spaced times from 0 to 1, test views half-way between such times.
    Cameras of the kind `scattered` advance by the golden angle, so that neighbours in time see the
    scene from very different sides. The kind `orbit` moves the training camera smoothly and
    scatters the test cameras.
    """
    paths, n = description.cameras, getattr(description.cameras, split)
    low, high = paths.elevation
    posed = []
    for i in range(n):
        step, t = (i, i / max(n - 1, 1)) if split == "train" else (i + 0.5, (i + 0.5) / n)
        azimuth, height = GOLDEN * step % 1, (0.5 + PLASTIC * step) % 1
        if paths.kind == "orbit" and split == "train":
            azimuth, height = paths.turns * t, 0.5 + 0.5 * math.sin(4 * math.pi * t)
        elevation = math.radians(low + (high - low) * height)
        posed.append((camera_at(description, 2 * math.pi * azimuth, elevation), t))
    return posed


def camera_at(description, azimuth, elevation):
    """Return a camera on the sphere about the target that looks at it, with z up."""
    paths, lens = description.cameras, description.lens
    outward = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    return look_at(
        paths.target + paths.radius * outward,
        paths.target,
        lens.fl_x,
        lens.fl_y,
        *map(int, description.resolution),
        lens.cx - 0.5,
        lens.cy - 0.5,
    )


def transforms(split, posed):
    """Return the text of a transforms file.

    Its matrices are camera-to-world in OpenGL axes; its principal point counts from the corner.
    """
    camera = posed[0][0]
    head = {
        "camera_angle_x": 2 * math.atan(camera.width / 2 / camera.f_x),
        "fl_x": camera.f_x,
        "fl_y": camera.f_y,
        "cx": camera.c_x + 0.5,
        "cy": camera.c_y + 0.5,
        "w": camera.width,
        "h": camera.height,
    }
    frames = [
        {
            "file_path": f"./{split}/r_{i:03d}",
            "time": t,
            "transform_matrix": [
                *np.column_stack([camera.R.T * OPENGL_TO_OPENCV, camera.center]).tolist(),
                [0.0, 0.0, 0.0, 1.0],
            ],
        }
        for i, (camera, t) in enumerate(posed)
    ]
    rows = ",\n  ".join(map(json.dumps, frames))
    return f'{json.dumps(head)[:-1]},\n "frames": [\n  {rows}]}}\n'
