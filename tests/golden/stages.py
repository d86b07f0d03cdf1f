"""Vectors of level L2: several equations at once. Here Fig. 1; `stages_coding` has Fig. 2."""

from dataclasses import replace

import numpy as np

from p4dgs_ref import model
from p4dgs_ref.equations import deformation, deformed
from p4dgs_ref.lab.random_inputs import random_field, random_network
from p4dgs_ref.model import ANCHOR_NETWORKS, Anchors
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.splatting import factored, render
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import EXACT
from tests.golden.cases import Case
from tests.golden.flat import (
    CAMERA_SHAPES,
    EMPTY,
    camera_of,
    described,
    flat_gradients,
    flat_networks,
    networks_of,
    shapes_of,
)
from tests.golden.subjects import Subject

UNSEEN = tuple(effect for effect in MODEL_EFFECTS if not effect.startswith("view"))


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


def anchor_inputs(rng, A, d, k, hidden, effects):
    """Anchors about the origin, a camera centre, and anchor networks as the effects need them."""
    design = replace(EMPTY, d=d, k=k, hidden=hidden, effects=effects)
    networks = {
        name: random_network(rng, layers[0][0], *(columns for _, columns in layers))
        for name, layers in design.layers().items()
        if name in ANCHOR_NETWORKS
    }
    for _, biases in networks.values():
        for bias in biases[:-1]:
            bias += 0.5  # few units of a ReLU are dead
    return dict(
        x_a=rng.uniform(-0.8, 0.8, (A, 3)),
        f_a=rng.normal(size=(A, d)),
        s_a=rng.uniform(0.2, 0.6, (A, 3)),
        l_a=rng.uniform(0.1, 0.4, (A, 3)),
        O_a=rng.normal(size=(A, k, 3)),
        mask=np.ones((A, k), bool),
        x_c=np.array([1.1, -2.3, 0.9]),
        tau_alpha=0.0,
        effects=effects,
        **flat_networks(networks),
    )


def spatial_cases():
    def inputs(seed, *sizes, effects=MODEL_EFFECTS):
        return anchor_inputs(np.random.default_rng(seed), *sizes, effects)

    def masked(seed, A, d, k):
        rng = np.random.default_rng(seed)
        anchors = anchor_inputs(rng, A, d, k, (7,), MODEL_EFFECTS)
        return {**anchors, "mask": rng.random((A, k)) < 0.6}

    seeing = inputs(204, 5, 4, 2, (7,), effects=(*UNSEEN, "view_color"))
    return [
        Case("ordinary", inputs(201, 7, 6, 5, (8, 9))),
        Case("masked_children", {**masked(202, 6, 4, 5), "tau_alpha": 0.125}, ("masked",)),
        Case("masked_at_zero", masked(224, 5, 4, 3), ("masked",)),
        Case("no_view", inputs(203, 6, 5, 2, (8,), effects=UNSEEN), ("off",)),
        Case("color_sees_the_view", seeing, ("off",)),
    ]


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


def temporal_cases():
    def inputs(seed, N, hidden, t, L_x=3, L_t=2, heads=(3, 3, 4)):
        rng = np.random.default_rng(seed)
        field = random_field(rng, L_x, L_t, *hidden, heads=heads)
        weights, biases = field.pop("weights"), field.pop("biases")
        for bias in biases[:-3]:
            bias += 0.5  # few units of a ReLU are dead
        return dict(**gaussians(rng, N), t=t, **field, psi_d_weights=weights, psi_d_biases=biases)

    return [
        Case("ordinary", inputs(211, 7, (9, 8), 0.37)),
        Case("start", inputs(212, 5, (8,), 0.0, L_x=4), ("zero",)),
        Case("turns_and_moves", inputs(213, 6, (9,), 1.0, L_t=3, heads=(3, 0, 4)), ("off",)),
        Case("rests", inputs(214, 5, (6,), 0.5, heads=(0, 0, 0)), ("off",)),
    ]


def gaussians(rng, N):
    """Places, scales and unit quaternions."""
    r = rng.normal(size=(N, 4))
    return dict(
        x=rng.uniform(-0.7, 0.7, (N, 3)),
        s=rng.uniform(0.1, 0.4, (N, 3)),
        r=r / np.linalg.norm(r, axis=1, keepdims=True),
    )


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


# Neither square nor centred, with pixels that are not square.
VIEWPOINT = look_at((1.2, -2.6, 1.1), (0.05, 0, -0.1), 21.0, 18.0, 15, 11, c_x=6.1, c_y=5.7)


def projection_cases():
    view = described(VIEWPOINT)
    near = gaussians(np.random.default_rng(222), 8)
    toward = VIEWPOINT.center * np.array([[0.0], [0.2], [0.5], [0.8], [0.97], [1.0], [1.5], [3.0]])
    wide = gaussians(np.random.default_rng(223), 6)
    inside_out = gaussians(np.random.default_rng(224), 5)
    return [
        Case("ordinary", dict(**gaussians(np.random.default_rng(221), 7), **view)),
        Case("some_behind", dict(near, x=toward + 0.1 * near["x"], **view), ("behind",)),
        Case(
            "beyond_the_clamp",
            dict(wide, x=wide["x"] + 5 * VIEWPOINT.R[0] * np.array([[1], [-1]] * 3), **view),
            ("clamped", "outside"),
        ),
        Case(
            "negative_scales",
            dict(inside_out, s=inside_out["s"] * [-1, 1, -0.3], **view),
            ("negative",),
        ),
    ]


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


def compositing_cases():
    def inputs(seed, N, **changes):
        rng = np.random.default_rng(seed)
        return (
            dict(
                **gaussians(rng, N),
                alpha=rng.uniform(0.3, 0.95, N),
                color=rng.random((N, 3)),
                **described(VIEWPOINT),
                background=np.array([0.9, 0.2, 0.4]),
                occlusion=True,
            )
            | changes
        )

    some = inputs(233, 10)
    behind = np.where(np.arange(10)[:, None] % 4 == 3, 2 * VIEWPOINT.center, 0)
    return [
        Case("ordinary", inputs(231, 12)),
        Case("no_occlusion", inputs(232, 9, occlusion=False), ("off",)),
        Case("some_behind", {**some, "x": some["x"] + behind}, ("behind",)),
        Case(
            "opaque",
            inputs(234, 8, alpha=np.tile([1.0, 0.5], 4), s=np.full((8, 3), 0.7)),
            ("opaque", "clamped"),
        ),
    ]


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
        spatial_cases,
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
        temporal_cases,
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
        projection_cases,
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
        compositing_cases,
    ),
)
