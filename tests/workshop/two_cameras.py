"""Draws the packaged scene twocams, in the layout of NeRF-DS, from two_cameras.json.

Two cameras stand still beside each other. The left one sees every moment and is trained on, the
right one is tested on. The points are where rays of the left camera meet the bodies at the first
moment. They give the depth, which one camera that stands still cannot measure.
"""

import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from p4dgs_ref.output import staged_folder
from p4dgs_ref.scenes.simulator import camera_at
from p4dgs_ref.scenes.simulator.bodies import poses
from p4dgs_ref.scenes.simulator.description import read_description
from p4dgs_ref.scenes.simulator.trace import hit, rays, trace

SOURCE = Path(__file__).with_name("two_cameras.json")
AZIMUTH = np.deg2rad(5)  # from camera to camera; 4.5 degrees, seen from their target
POINTS = 200
# The files have coordinates of their own: (x - CENTER) SCALE is in units of the description.
CENTER, SCALE = np.array([0.5, -1.5, 2.0]), 0.25


def draw(folder):
    """Draw the scene into a folder."""
    description = read_description(SOURCE)
    eyes, moments = cameras(description), description.cameras.train
    every = moments // description.cameras.test
    names = {
        "train_ids": [f"{i:06d}_left" for i in range(moments)],
        "val_ids": [f"{i:06d}_right" for i in range(every // 2, moments, every)],
    }
    ids, metadata = names["train_ids"] + names["val_ids"], {}
    with staged_folder(folder) as staging:
        for part in ("camera", "rgb/1x"):
            (staging / part).mkdir(parents=True)
        for name in ids:
            step, side = int(name[:6]), name[7:]
            pixels = over_white(trace(description, eyes[side], step / (moments - 1)))
            picture = np.rint(pixels * 255).astype(np.uint8)
            iio.imwrite(staging / f"rgb/1x/{name}.png", picture, optimize=True)
            write(staging / f"camera/{name}.json", lens_of(eyes[side]))
            camera = int(side == "right")
            metadata[name] = {"time_id": step, "warp_id": step, "camera_id": camera}
        write(staging / "dataset.json", {"count": len(ids), "ids": ids, **names})
        write(staging / "metadata.json", metadata)
        scene = {"scale": SCALE, "center": CENTER.tolist(), "near": 0.2, "far": 6.0}
        write(staging / "scene.json", {**scene, "effects": description.effects})
        points = surface(description, eyes["left"])
        np.save(staging / "points.npy", (points / SCALE + CENTER).astype(np.float32))


def cameras(description):
    """The two cameras, by the names that NeRF-DS gives them."""
    elevation = np.deg2rad(description.cameras.elevation[0])
    sides = {"left": -AZIMUTH / 2, "right": AZIMUTH / 2}
    return {name: camera_at(description, side, elevation) for name, side in sides.items()}


def write(file, value):
    """Write JSON."""
    file.write_text(json.dumps(value) + "\n", encoding="utf-8")


def over_white(rgba):
    """A picture without alpha, as photographs are."""
    return rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]


def lens_of(camera):
    """A camera in the words of the format, whose pixels count from the corner."""
    return {
        "orientation": camera.R.tolist(),
        "position": (camera.center / SCALE + CENTER).tolist(),
        "focal_length": camera.f_x,
        "principal_point": [camera.c_x + 0.5, camera.c_y + 0.5],
        "skew": 0.0,
        "pixel_aspect_ratio": camera.f_y / camera.f_x,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": [camera.width, camera.height],
    }


def surface(description, camera):
    """Points [POINTS, 3] at which rays of a camera first meet a body at the time 0."""
    viewer, directions = camera.center, rays(camera)
    where = poses(description.bodies, description.effects, 0.0)
    hits = [hit(body, where[body.name], viewer, directions) for body in description.bodies]
    depth = np.min(hits, axis=0)
    met = np.flatnonzero(np.isfinite(depth))
    drawn = np.random.default_rng(0).choice(met, POINTS, replace=False)
    return viewer + depth[drawn, None] * directions[drawn]
