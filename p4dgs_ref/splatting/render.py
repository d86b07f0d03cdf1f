"""From 3D Gaussians to an image and back: covariance, projection, compositing, as one settings object asks."""

from typing import NamedTuple

import numpy as np

from . import compositing, covariance, fast, projection


class Out(NamedTuple):
    image: np.ndarray  # (H, W, 3)
    transmittance: np.ndarray  # (H, W)


class Res(NamedTuple):
    covariance: covariance.Res
    projection: projection.Res
    compositing: object  # of the exact twin or of the fast renderer
    splats: projection.Out
    exact: bool


def project(x, s, r, camera, settings):
    """Covariance and projection alone: (N, 3), (N, 3), (N, 4) -> projection.Out and both residuals."""
    out, res_c = covariance.forward(s.astype(float), r.astype(float))
    splats, res_p = projection.forward(
        x.astype(float),
        out.Sigma,
        camera.R,
        camera.T,
        np.array([camera.f_x, camera.f_y]),
        np.array([camera.c_x, camera.c_y]),
        np.array([camera.width, camera.height]),
        settings.near,
        settings.blur,
        settings.tan_clamp,
    )
    return splats, res_c, res_p


def forward(x, s, r, alpha, color, camera, background, settings, occlusion=True):
    """Render Gaussians.

    Shapes     x, s (N, 3), r (N, 4) unit, alpha (N,), color (N, 3), background (3,) -> image (H, W, 3), transmittance (H, W)
    Units      scene units; colors in [0, 1]
    Domain     as in `covariance`, `projection`, `compositing`
    Raises     nothing
    Gradient   x, s, r, alpha, color, background
    Choice     Q21: settings.footprint "all" takes the exact twin, anything else the fast renderer; projection is
               float64 in both, compositing has settings.dtype
    Reference  Kerbl et al. 2023
    """
    splats, res_c, res_p = project(x, s, r, camera, settings)
    exact = settings.footprint == "all"
    alpha, color, background = (np.asarray(a, float) for a in (alpha, color, background))
    shared = dict(
        alpha=alpha,
        color=color,
        depth=splats.depth,
        visible=splats.visible,
        background=background,
        height=camera.height,
        width=camera.width,
        occlusion=occlusion,
    )
    if exact:
        out, res = compositing.forward(
            splats.mean2d, splats.conic, **shared, alpha_max=settings.alpha_max
        )
    else:
        out, res = fast.forward(
            splats.mean2d, splats.cov2d, splats.conic, **shared, settings=settings
        )
    return Out(*out), Res(res_c, res_p, res, splats, exact)


def backward(res, image_bar):
    """Gradients of x, s, r, alpha, color, background, and of mean2d for the statistics of growing."""
    bars = (compositing if res.exact else fast).backward(res.compositing, image_bar)
    places = projection.backward(res.projection, mean2d_bar=bars["mean2d"], conic_bar=bars["conic"])
    shapes = covariance.backward(res.covariance, places["Sigma"])
    return {
        "x": places["x"],
        **shapes,
        "alpha": bars["alpha"],
        "color": bars["color"],
        "background": bars["background"],
        "mean2d": bars["mean2d"],
    }
