"""How good a model is on views it has not seen, and how fast it renders them (README, Measures)."""

import time

import numpy as np

from ..codec.inspect import components
from ..equations import ssim
from ..splatting.settings import FAST

FLOATS_PER_GAUSSIAN = 59  # as D3DGS stores one: 3 position, 3 scale, 4 rotation, 1 opacity, 48 SH
FLOATS_WITHOUT_SH_REST = 14


def timed(function, *args):
    """A function's value and the seconds it took."""
    start = time.perf_counter()
    return function(*args), time.perf_counter() - start


def squared_error(image, truth, where=None):
    """Mean squared error of images clipped to [0, 1], over all pixels or those in `where`."""
    difference = (np.clip(image, 0, 1).astype(float) - truth) ** 2
    return float(difference.mean() if where is None else difference[where].mean())


def decibel(error):
    """-10 log10 of a mean squared error in dB; infinite for equal images."""
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def score(image, view):
    """{psnr_db, psnr_fg_db, ssim} of one view; psnr_fg_db is None without an alpha or without an object."""
    covered = None if view.alpha is None else view.alpha > 0.5
    foreground = (
        None
        if covered is None or not covered.any()
        else decibel(squared_error(image, view.image, covered))
    )
    clipped = np.clip(image, 0, 1).astype(float)
    return {
        "psnr_db": decibel(squared_error(image, view.image)),
        "psnr_fg_db": foreground,
        "ssim": float(ssim.forward(clipped, view.image.astype(float))[0].ssim),
    }


def evaluate(model, scene, settings=FAST, split="test"):
    """Scores of a model on a scene's views and the time it takes to render them.

    Takes      a Model and a Scene; `settings` of the renderer; which `split` of the scene
    Returns    (metrics, rows, images): metrics {psnr_db, psnr_fg_db, ssim, render_fps, anchors, gaussians}, the means
               over views; one row {name, time, ...} and one image (H, W, 3) a view
    Raises     ValueError where the scene has no such views
    Choice     images are clipped to [0, 1]; equal ones have infinite PSNR; the README's Measures defines the rest
    """
    views = getattr(scene, split)
    if not views:
        raise ValueError(f"scene {scene.name}: split '{split}' has no views to evaluate on")
    model.render(views[0].camera, views[0].time, settings)  # warm up
    rows, images, seconds, counts = [], [], [], []
    for view in views:
        image, spent = timed(model.render, view.camera, view.time, settings)
        seconds.append(spent)
        counts.append(len(model.gaussians(view.time, view.camera).alpha))
        rows.append({"name": view.name, "time": view.time, **score(image, view)})
        images.append(image)

    def mean(key):
        values = [row[key] for row in rows if row[key] is not None]
        return float(np.mean(values)) if values else None

    metrics = {
        "psnr_db": mean("psnr_db"),
        "psnr_fg_db": mean("psnr_fg_db"),
        "ssim": mean("ssim"),
        "render_fps": float(1 / np.median(seconds)),
        "anchors": len(model.anchors.mask),
        "gaussians": int(np.median(counts)),
    }
    return metrics, rows, images


def explicit_bytes(model, gaussians, floats=FLOATS_PER_GAUSSIAN):
    """Bytes of the same Gaussians at one time as plain float32, with the deformation network in float32."""
    weights = sum(a.size for arrays in model.networks.get("psi_d", ()) for a in arrays)
    return 4 * (gaussians * floats + weights)


def compression(model, data, gaussians):
    """How large the file `data` of a model is, in all, by component, and beside the same Gaussians uncompressed."""
    explicit = explicit_bytes(model, gaussians)
    return {
        "bytes": len(data),
        "explicit_bytes": explicit,
        "ratio": explicit / len(data),
        "ratio_without_sh": explicit_bytes(model, gaussians, FLOATS_WITHOUT_SH_REST) / len(data),
        "components": components(data),
    }


def json_safe(metrics):
    """Infinite decibels become null beside "exact": true; everything else as it is."""
    infinite = [
        key for key, value in metrics.items() if isinstance(value, float) and np.isinf(value)
    ]
    return {**metrics, **dict.fromkeys(infinite), "exact": True} if infinite else metrics
