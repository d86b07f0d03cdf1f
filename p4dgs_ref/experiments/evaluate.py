"""How good a model is on views it has not seen, and how fast it renders them (README, Measures)."""
import time

import numpy as np

from ..equations import ssim
from ..splatting.settings import FAST

FLOATS_PER_GAUSSIAN = 59       # as D3DGS stores one: 3 position, 3 scale, 4 rotation, 1 opacity, 48 SH
FLOATS_WITHOUT_SH_REST = 14


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
    foreground = None if covered is None or not covered.any() else decibel(squared_error(image, view.image, covered))
    clipped = np.clip(image, 0, 1).astype(float)
    return {"psnr_db": decibel(squared_error(image, view.image)), "psnr_fg_db": foreground,
            "ssim": float(ssim.forward(clipped, view.image.astype(float))[0].ssim)}


def evaluate(model, scene, settings=FAST, split="test"):
    """Scores of a model on a scene's views and the time it takes to render them.

    Returns    (metrics, rows, images): metrics {psnr_db, psnr_fg_db, ssim, render_fps, anchors, gaussians}, the means
               over views; one row {name, time, ...} and one image (H, W, 3) a view
    Raises     ValueError where the scene has no such views
    """
    views = getattr(scene, split)
    if not views:
        raise ValueError(f"scene {scene.name}: split '{split}' has no views to evaluate on")
    model.render(views[0].camera, views[0].time, settings)            # warm up
    rows, images, seconds, counts = [], [], [], []
    for view in views:
        start = time.perf_counter()
        image = model.render(view.camera, view.time, settings)
        seconds.append(time.perf_counter() - start)
        counts.append(len(model.gaussians(view.time, view.camera).alpha))
        rows.append({"name": view.name, "time": view.time, **score(image, view), "ms": 1e3 * seconds[-1]})
        images.append(image)

    def mean(key):
        values = [row[key] for row in rows if row[key] is not None]
        return float(np.mean(values)) if values else None

    metrics = {"psnr_db": mean("psnr_db"), "psnr_fg_db": mean("psnr_fg_db"), "ssim": mean("ssim"),
               "render_fps": float(1 / np.median(seconds)), "anchors": len(model.anchors.mask),
               "gaussians": int(np.median(counts))}
    return metrics, rows, images


def explicit_bytes(model, gaussians, floats=FLOATS_PER_GAUSSIAN):
    """Bytes of the same Gaussians at one time as plain float32, with the deformation network in float32."""
    weights = sum(a.size for arrays in model.networks.get("psi_d", ()) for a in arrays)
    return 4 * (gaussians * floats + weights)


def json_safe(metrics):
    """Infinite decibels become null beside "exact": true; everything else as it is."""
    exact = any(isinstance(v, float) and np.isinf(v) for v in metrics.values())
    safe = {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in metrics.items()}
    return {**safe, "exact": True} if exact else safe
