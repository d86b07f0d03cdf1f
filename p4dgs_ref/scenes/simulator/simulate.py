"""Draws a described scene into a D-NeRF folder: cameras on a sphere, one time each, RGBA pictures, transforms."""

import json
import math
import os
import tempfile
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from ...splatting.camera import look_at
from ..dnerf import OPENGL_TO_OPENCV
from ..scene import SceneError
from .description import describe
from .trace import trace

GOLDEN, PLASTIC = (
    0.6180339887498949,
    0.7548776662466927,
)  # two spreads that never fall in step with each other


def simulate(scene_json, out_dir, progress=None):
    """Draw all views of a scene; the same description gives the same pixels.

    Shapes     scene_json: a path or a dict; out_dir: a folder, made if absent; progress(done, total) or None
    Raises     SceneError for a description that cannot be drawn; then nothing is written
    Choice     everything is drawn beside the folder and moved into it at the end, transforms last
    """
    description, out = describe(scene_json), Path(out_dir)
    if out.exists() and not out.is_dir():
        raise SceneError(out, "a file; expected a folder, or nothing yet")
    views = {split: place_cameras(description, split) for split in ("train", "test")}
    total, done = sum(map(len, views.values())), 0
    text = (
        json.dumps(scene_json, indent=1) + "\n"
        if isinstance(scene_json, dict)
        else Path(scene_json).read_text(encoding="utf-8")
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as beside:
        folder = Path(beside)
        (folder / "scene.json").write_text(text, encoding="utf-8")
        for split, posed in views.items():
            (folder / split).mkdir()
            for i, (camera, t) in enumerate(posed):
                pixels = np.rint(trace(description, camera, t) * 255).astype(np.uint8)
                picture = folder / split / f"r_{i:03d}.png"
                iio.imwrite(picture, pixels, extension=".png", optimize=True)
                done += 1
                if progress:
                    progress(done, total)
            (folder / f"transforms_{split}.json").write_text(
                transforms(split, posed), encoding="utf-8"
            )
        move(folder, out)


def move(folder, out):
    """Rename every file to its place, the transforms after the pictures that they name."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    for file in sorted(files, key=lambda file: file.name.startswith("transforms")):
        target = out / file.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, target)


def place_cameras(description, split):
    """[(camera, time)] of one split, in the order of time.

    Training views stand at even times from 0 to 1, test views half-way between even ones.  `scattered` steps
    on by the golden angle, so that neighbours in time see the scene from quite different sides; `orbit` moves
    the training camera smoothly and leaves the test cameras scattered.
    """
    paths, n = description.cameras, getattr(description.cameras, split)
    low, high = paths.elevation
    posed = []
    for i in range(n):
        t = i / max(n - 1, 1) if split == "train" else (i + 0.5) / n
        if paths.kind == "orbit" and split == "train":
            azimuth, height = paths.turns * t, 0.5 + 0.5 * math.sin(4 * math.pi * t)
        else:
            step = i if split == "train" else i + 0.5
            azimuth, height = GOLDEN * step % 1, (0.5 + PLASTIC * step) % 1
        posed.append(
            (
                camera_at(
                    description, 2 * math.pi * azimuth, math.radians(low + (high - low) * height)
                ),
                t,
            )
        )
    return posed


def camera_at(description, azimuth, elevation):
    """A camera on the sphere about the target, looking at it, z up."""
    away = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    paths, lens, (width, height) = (
        description.cameras,
        description.lens,
        map(int, description.resolution),
    )
    return look_at(
        paths.target + paths.radius * away,
        paths.target,
        lens.fl_x,
        lens.fl_y,
        width,
        height,
        lens.cx - 0.5,
        lens.cy - 0.5,
    )


def transforms(split, posed):
    """The text of a transforms file: OpenGL camera-to-world matrices, the principal point from the corner."""
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
    frames = []
    for i, (camera, t) in enumerate(posed):
        c2w = np.eye(4)
        c2w[:3, :3], c2w[:3, 3] = camera.R.T * OPENGL_TO_OPENCV, camera.center
        frames.append(
            json.dumps(
                {
                    "file_path": f"./{split}/r_{i:03d}",
                    "time": t,
                    "transform_matrix": [[float(x) for x in row] for row in c2w],
                }
            )
        )
    return json.dumps(head)[:-1] + ',\n "frames": [\n  ' + ",\n  ".join(frames) + "]}\n"
