"""Vectors of level L2: several equations at once. Here Fig. 1; `stages_coding` has Fig. 2."""

from dataclasses import replace

import numpy as np

from p4dgs_ref import model
from p4dgs_ref.equations import deformation, deformed
from p4dgs_ref.model import Anchors
from p4dgs_ref.splatting import factored, render
from p4dgs_ref.splatting.settings import EXACT
from tests.workshop.flat import (
    EMPTY,
    camera_of,
    flat_gradients,
    networks_of,
)
from tests.workshop.subjects import as_published


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


# --- Fig. 1: Gaussians at t -> image ------------------------------------------------------------
def projected(x, s, r, camera, settings):
    """Return the splats of some Gaussians, {name: array}, and their pullback.

    r is taken as it is: its gradient is the plain derivative of the printed matrix.
    """
    (*floats, visible), saved = render.project(x, s, r, camera, settings)
    cast = (a.astype(x.dtype, copy=False) for a in floats)

    def pullback(mean2d_bar=None, conic_bar=None, depth_bar=None):
        bars = factored.backward(
            saved, mean2d_bar, np.zeros((len(x), 3)) if conic_bar is None else conic_bar, depth_bar
        )
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
    as_published("spatial_prediction", spatial_vjp),
    as_published("temporal_prediction", temporal_vjp),
    as_published("projection_stage", projection_vjp),
    as_published("compositing_stage", compositing_vjp),
)
