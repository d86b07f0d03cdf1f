"""How good a model is on test views, and how fast it renders them ("Measures" in reference.md)."""

import time
import warnings

import numpy as np

from ..equations import ssim
from ..model import Model
from ..scenes.scene import Scene, size_of
from ..splatting.settings import FAST, Settings
from ..training.objective import psnr
from .inspect import components

# D3DGS stores 3 numbers for position, 3 for scale, 4 for rotation, 1 for opacity, 48 for colour.
FLOATS_PER_GAUSSIAN = 59
FLOATS_WITHOUT_SH_REST = 14


def call_with_seconds(function, *args, **kwargs):
    """Return the result of a function and the seconds it took."""
    start = time.perf_counter()
    return function(*args, **kwargs), time.perf_counter() - start


def score(image, view):
    """Return {psnr_db, psnr_fg_db, ssim} of one view.

    psnr_fg_db is over the object alone; it is None for a view without alpha or without an object.
    """
    foreground = None
    if view.alpha is not None and (view.alpha > 0.5).any():
        foreground = psnr(image[view.alpha > 0.5], view.image[view.alpha > 0.5])
    similarity, _ = ssim.forward(np.clip(image, 0, 1).astype(float), view.image.astype(float))
    return {
        "psnr_db": psnr(image, view.image),
        "psnr_fg_db": foreground,
        "ssim": float(similarity),
    }


def names_in_training(scene):
    """Return the names of test views that are also training views: same picture, or same pose."""

    def marks(view):
        R, T = view.camera.R, view.camera.T
        return {hash(view.image.tobytes()), (R.tobytes(), T.tobytes(), view.time)}

    known = set().union(*map(marks, scene.train))
    return [view.name for view in scene.test if marks(view) & known]


def evaluate(
    model: Model, scene: Scene, settings: Settings = FAST, split: str = "test"
) -> tuple[dict, list[dict], list[np.ndarray]]:
    """Measure a model on a scene's views.

    Returns (metrics, rows, images). metrics are the means over the views, {psnr_db, psnr_fg_db,
    ssim, render_fps, anchors, gaussians} and the `size` of the pictures; there is one row
    {name, time, size, ...} and one image (H, W, 3) per view. Raises ValueError if the scene has
    no such views. Warns if the scene has another background than the model, and of test views that
    are also training views.
    """
    views = {"train": scene.train, "test": scene.test}.get(split)
    if not views:
        raise ValueError(f"scene {scene.name}: split '{split}' has no views to evaluate on")
    if np.abs(model.background - scene.background).max() > 1 / 255:
        file, here = ("{:.3g} {:.3g} {:.3g}".format(*of.background) for of in (model, scene))
        warnings.warn(
            f"the file has background {file}, scene {scene.name} has {here}; expected equal "
            "ones, set by load_scene(..., background=...) or effect `background` in scene.json",
            stacklevel=2,
        )
    seen = names_in_training(scene) if split == "test" else ()
    if seen:
        warnings.warn(
            f"scene {scene.name}: {len(seen)} of {len(views)} test views are also training "
            f"views (same picture, or same camera and time), such as {seen[0]}",
            stacklevel=2,
        )
    images, seconds = [], []
    for view in views:
        image, spent = call_with_seconds(model.render, view.camera, view.time, settings)
        images.append(image)
        seconds.append(spent)
    size = size_of(images[0])
    rows = [
        {"name": view.name, "time": view.time, "size": size, **score(image, view)}
        for view, image in zip(views, images)
    ]

    def mean(key):
        values = [row[key] for row in rows if row[key] is not None]
        return float(np.mean(values)) if values else None

    metrics = {
        "size": size,
        **{key: mean(key) for key in ("psnr_db", "psnr_fg_db", "ssim")},
        "render_fps": float(1 / np.median(seconds)),
        "anchors": model.count,
        "gaussians": int(np.median([len(model.gaussians(v.time, v.camera).alpha) for v in views])),
    }
    return metrics, rows, images


def explicit_bytes(model, gaussians, floats=FLOATS_PER_GAUSSIAN):
    """Return the bytes of the same Gaussians and of the deformation network as plain float32."""
    weights = sum(a.size for arrays in model.networks.get("psi_d", ()) for a in arrays)
    return 4 * (gaussians * floats + weights)


def compression(model, data, gaussians):
    """Return the size of a model's file: in all, by component, against plain Gaussians."""
    explicit = explicit_bytes(model, gaussians)
    return {
        "bytes": len(data),
        "explicit_bytes": explicit,
        "ratio": explicit / len(data),
        "ratio_without_sh": explicit_bytes(model, gaussians, FLOATS_WITHOUT_SH_REST) / len(data),
        "components": components(data),
    }


def json_safe(metrics):
    """Return the metrics for JSON: infinite decibels are null, and then "exact" is true."""
    metrics = {key: json_safe(a) if isinstance(a, dict) else a for key, a in metrics.items()}
    infinite = [key for key, a in metrics.items() if isinstance(a, float) and np.isinf(a)]
    return {**metrics, **dict.fromkeys(infinite), "exact": True} if infinite else metrics
