"""Vectors of level L2: several equations at once. Here Fig. 1; `stages_coding` has Fig. 2."""

from dataclasses import replace

import numpy as np

from p4dgs_ref import model
from p4dgs_ref.equations import deformation, deformed
from p4dgs_ref.model import ANCHOR_NETWORKS, Anchors
from p4dgs_ref.splatting import covariance, projection, render
from p4dgs_ref.splatting.settings import EXACT
from tests.golden.flat import (
    CAMERA_SHAPES,
    EMPTY,
    as_published,
    camera_of,
    flat_gradients,
    networks_of,
    shapes_of,
)
from tests.golden.subjects import Subject


# --- Fig. 1: anchors -> canonical Gaussians -----------------------------------------------------
def spatial_vjp(x_a, f_a, s_a, l_a, O_a, mask, x_c, tau_alpha, effects, **networks):
    """Spatial prediction: view, networks, offsets, masking (Eqs. 1 to 4).

    `effects` lists view_geometry, view_color or neither; without them networks do not see the view.
    """
    design = replace(EMPTY, effects=effects, tau_alpha=tau_alpha)
    anchors = Anchors(x_a, f_a, s_a, l_a, O_a, mask)
    gaussians, _, back = model.predict(design, networks_of(networks), anchors, x_c)

    def pullback(x_bar, s_bar, r_bar, alpha_bar, color_bar):
        anchors_bar, bars = back(x_bar, s_bar, r_bar, alpha_bar, color_bar)
        return {**anchors_bar, **flat_gradients(bars)}

    return gaussians._asdict(), pullback


def spatial_surrogate(**base):
    """Spatial prediction of the Gaussians that are kept at `base`, whatever their opacities."""
    kept = spatial_vjp(**base)[0]["index"]
    mask = np.isin(np.arange(base["mask"].size), kept).reshape(base["mask"].shape)

    def smooth(**moved):
        return spatial_vjp(**{**moved, "mask": mask, "tau_alpha": -1.0})[0]

    return smooth


# --- Fig. 1: canonical Gaussians -> Gaussians at t ----------------------------------------------
def temporal_vjp(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    """Temporal prediction: deformation, then its use (Eqs. 5 and 6).

    No gradient flows from E(x) back into x, in contrast to Eq. (5) by itself (Q10).
    """
    delta, saved_deltas = deformation.forward(x, t, psi_d_weights, psi_d_biases, L_x, L_t)
    at_t, saved = deformed.forward(x, s, r, *delta)

    def pullback(x_t_bar, s_t_bar, r_t_bar):
        bars = deformed.backward(saved, x_t_bar, s_t_bar, r_t_bar)
        network = deformation.backward(
            saved_deltas, bars["delta_x"], bars["delta_s"], bars["delta_r"], needs_x=False
        )
        direct = {name: bars[name] for name in ("x", "s", "r")}
        return {**direct, **flat_gradients({"psi_d": network})}

    return dict(zip(("x_t", "s_t", "r_t"), at_t)), pullback


def temporal_surrogate(**base):
    """Temporal prediction in which E(x) stays that of `base`."""

    def smooth(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
        delta, _ = deformation.forward(base["x"], t, psi_d_weights, psi_d_biases, L_x, L_t)
        return dict(zip(("x_t", "s_t", "r_t"), deformed.forward(x, s, r, *delta)[0]))

    return smooth


# --- Fig. 1: Gaussians at t -> image ------------------------------------------------------------
def projected(x, s, r, camera, settings):
    """Return the splats of some Gaussians, {name: array}, and their pullback.

    r is taken as it is: its gradient is the plain derivative of the printed matrix.
    """
    (Sigma, R), saved_axes = covariance.axes(s.astype(float), r.astype(float))
    (*floats, visible), saved = render.project(x, Sigma, camera, settings, R)
    cast = (a.astype(x.dtype, copy=False) for a in floats)

    def pullback(mean2d_bar=None, conic_bar=None, depth_bar=None):
        places = projection.backward(
            saved, mean2d_bar=mean2d_bar, conic_bar=conic_bar, depth_bar=depth_bar
        )
        axes_bars = covariance.axes_backward(saved_axes, places["Sigma"], places["R"])
        bars = {"x": places["x"], **axes_bars}
        return {name: bar.astype(x.dtype, copy=False) for name, bar in bars.items()}

    return {**dict(zip(("mean2d", "cov2d", "conic", "depth"), cast)), "visible": visible}, pullback


def projection_vjp(x, s, r, W, T, focal, center, size):
    """From Gaussians to splats: covariance, then projection. Rows that are culled are zeros."""
    splats, pullback = projected(x, s, r, camera_of(W, T, focal, center, size), EXACT)
    del splats["cov2d"]
    return splats, pullback


def compositing_vjp(x, s, r, alpha, color, W, T, focal, center, size, background, occlusion):
    """From Gaussians to an image: covariance, projection, depth order, compositing.

    Nothing is skipped, and the clamp of 0.99 is kept (Q21). Without occlusion the order of the
    splats does not matter.
    """
    camera = camera_of(W, T, focal, center, size)
    (image, *_), saved = render.forward(x, s, r, alpha, color, camera, background, EXACT, occlusion)

    def pullback(image_bar):
        bars = render.backward(saved, image_bar.astype(float))
        names = ("x", "s", "r", "alpha", "color", "background")
        return {name: bars[name].astype(x.dtype, copy=False) for name in names}

    return {"image": image.astype(x.dtype, copy=False)}, pullback


SUBJECTS = (
    Subject(
        "spatial_prediction",
        "L2",
        "masking",
        "1 to 4",
        "anchors -> canonical Gaussians",
        {
            "x_a": "A 3",
            "f_a": "A d",
            "s_a": "A 3",
            "l_a": "A 3",
            "O_a": "A k 3",
            "mask": "A k",
            "x_c": "3",
            "tau_alpha": "",
            "effects": "",
            **shapes_of(*ANCHOR_NETWORKS),
            "x": "N 3",
            "s": "N 3",
            "r": "N 4",
            "alpha": "N",
            "color": "N 3",
            "index": "N",
        },
        ("x_a", "f_a", "s_a", "l_a", "O_a", *shapes_of(*ANCHOR_NETWORKS)),
        spatial_vjp,
        as_published("spatial_prediction"),
        surrogate=spatial_surrogate,
    ),
    Subject(
        "temporal_prediction",
        "L2",
        "deformed",
        "5, 6",
        "canonical Gaussians -> Gaussians at t",
        {
            "x": "N 3",
            "s": "N 3",
            "r": "N 4",
            "t": "",
            "L_x": "",
            "L_t": "",
            **shapes_of("psi_d"),
            "x_t": "N 3",
            "s_t": "N 3",
            "r_t": "N 4",
        },
        ("x", "s", "r", *shapes_of("psi_d")),
        temporal_vjp,
        as_published("temporal_prediction"),
        surrogate=temporal_surrogate,
    ),
    Subject(
        "projection_stage",
        "L2",
        "projection",
        "",
        "Gaussians at t -> splats",
        {
            "x": "N 3",
            "s": "N 3",
            "r": "N 4",
            **CAMERA_SHAPES,
            "mean2d": "N 2",
            "conic": "N 3",
            "depth": "N",
            "visible": "N",
        },
        ("x", "s", "r"),
        projection_vjp,
        as_published("projection_stage"),
    ),
    Subject(
        "compositing_stage",
        "L2",
        "compositing",
        "",
        "Gaussians at t -> image",
        {
            "x": "N 3",
            "s": "N 3",
            "r": "N 4",
            "alpha": "N",
            "color": "N 3",
            **CAMERA_SHAPES,
            "background": "3",
            "occlusion": "",
            "image": "H W 3",
        },
        ("x", "s", "r", "alpha", "color", "background"),
        compositing_vjp,
        as_published("compositing_stage"),
    ),
)
