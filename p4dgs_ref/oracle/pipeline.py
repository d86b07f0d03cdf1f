"""Vectors of level L4: frames of a trained model, and ten steps of an optimisation with every number on the way.

The model lies beside the vectors as `model.p4dgs`.  `python -m p4dgs_ref.oracle.pipeline` trains it anew in seconds:
the scene `bouncing` before a blue background, all effects switched on, small networks, one seed.  Nobody has to: the
vectors hold its decoded arrays, and a training on another machine ends elsewhere.
"""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import model
from ..codec.file import decode, encode
from ..equations import hash_grid
from ..equations.equation import Case
from ..model import Anchors
from ..scenes import load_scene
from ..scenes.scene import MODEL_EFFECTS, View
from ..splatting import render
from ..splatting.camera import look_at
from ..splatting.settings import EXACT, SETTINGS
from ..training import objective
from ..training.adam import Adam
from ..training.fit import train
from ..training.parameters import Parameters
from ..training.presets import TINY
from .undeclared import (
    CAMERA_SHAPES,
    NETWORKS,
    SILENT,
    camera_of,
    described,
    flat_networks,
    networks_of,
    no_gradient,
    shapes_of,
    undeclared,
)

MODEL = Path(__file__).with_name("v1") / "model.p4dgs"
STEPS = 10
RENDERING = NETWORKS[:5]  # the networks of Fig. 1


# --- frames ----------------------------------------------------------------------------------------------------------
class Image(NamedTuple):
    image: np.ndarray  # (H, W, 3)


def frames_forward(
    x_a,
    f_a,
    s_a,
    l_a,
    O_a,
    mask,
    W,
    T,
    focal,
    center,
    size,
    t,
    background,
    tau_alpha,
    effects,
    L_x,
    L_t,
    renderer,
    **networks,
):
    """An image of a decoded model: Fig. 1 from end to end.

    Shapes     anchors, networks and camera as in the stages, background (3,) -> image (H, W, 3)
    Units      as in the equations; t: normalised time; x_c of Eq. (2) is -W^T T
    Domain     renderer: the name of settings of Q21, their arithmetic in float64 whatever they say
    Choice     Q10, Q20 to Q22
    Reference  P-4DGS Fig. 1, Eqs. (1) to (6)
    """
    camera = camera_of(W, T, focal, center, size)
    design = SILENT._replace(L_x=L_x, L_t=L_t, tau_alpha=tau_alpha, effects=effects)
    g, _ = model.predict(
        design, networks_of(networks), Anchors(x_a, f_a, s_a, l_a, O_a, mask), camera.center, t
    )
    out, _ = render.forward(
        g.x,
        g.s,
        g.r,
        g.alpha,
        g.color,
        camera,
        background,
        SETTINGS[renderer]._replace(dtype="float64"),
        "occlusion" in effects,
    )
    return Image(out.image.astype(x_a.dtype, copy=False)), None


@cache
def golden_model():
    """The trained model, decoded."""
    return decode(MODEL.read_bytes())


def train_golden_model():
    """Bytes of a small model that moves, shines and hides parts of itself."""
    scene = replace(load_scene("bouncing", background=(0.35, 0.6, 0.85)), effects=MODEL_EFFECTS)
    preset = TINY._replace(
        name="golden",
        anchors=60,
        d=6,
        k=5,
        hidden=(14, 12),
        deformation=(20, 18),
        L_x=3,
        L_t=2,
        context=(10,),
        grid_3d=(5,),
        grid_2d=(9,),
        stage_ends=(60, 90, 700, 1000),
        decay_from=90,
        grow_from=30,
        grow_every=30,
        grow_until=500,
        mask_from=700,
    )
    return encode(train(scene, preset, seed=1))


# Neither is square, centred or has square pixels.
FRONT = look_at((1.1, -1.9, 0.9), (0.05, 0, -0.45), 38.0, 33.0, 40, 28, c_x=21.3, c_y=12.1)
SIDE = look_at((-1.6, -1.2, 0.4), (0, 0.05, -0.4), 33.0, 37.0, 40, 28, c_x=17.2, c_y=14.6)


def frames_cases():
    m = golden_model()
    networks = flat_networks({name: m.networks[name] for name in RENDERING})
    common = dict(
        **m.anchors._asdict(),
        background=m.background,
        **networks,
        **{name: getattr(m.design, name) for name in ("tau_alpha", "effects", "L_x", "L_t")},
    )
    for name, camera in (("front", FRONT), ("side", SIDE)):
        for t in (0.0, 0.35, 1.0):
            yield Case(
                f"{name}_{100 * t:03.0f}",
                dict(**common, **described(camera), t=t, renderer="exact"),
            )
    yield Case("paper_settings", dict(**common, **described(FRONT), t=0.35, renderer="paper"))


# --- trace -----------------------------------------------------------------------------------------------------------
class Trace(NamedTuple):
    L1: np.ndarray  # (S,), before the step; so too the other losses
    D_SSIM: np.ndarray
    L_render: np.ndarray
    L_rate: np.ndarray
    bits: np.ndarray
    L_total: np.ndarray
    gradient_norm: np.ndarray  # (S, P), before the step
    total: np.ndarray  # (S, P) sum of every parameter array, after the step
    ramp: np.ndarray  # (S, P) sum of its elements times cos 0, cos 1, cos 2, ..., after the step
    final: (
        np.ndarray
    )  # (M,) all parameters after the last step: the arrays row by row, one after the other


def trace_forward(
    x_a,
    f_a,
    log_s,
    log_l,
    O_a,
    mask,
    lo,
    hi,
    grids,
    resolutions,
    Q_0,
    W,
    T,
    focal,
    center,
    size,
    times,
    truth,
    background,
    views,
    u,
    learning_rates,
    arrays,
    tau_alpha,
    effects,
    L_x,
    L_t,
    lambda_rate,
    lambda_ssim,
    **networks,
):
    """Steps of stage 4, everything given: one view and one noise a step, gradients of L_total, Adam.

    Adam's n-th step, g being the gradient: m = 0.9 m + 0.1 g, v = 0.999 v + 0.001 g^2, both 0 at first; then the
    parameter moves by -rate (m / (1 - 0.9^n)) / (sqrt(v / (1 - 0.999^n)) + e), e = 1e-15 / sqrt(1 - 0.999^n).

    Shapes     parameters x_a, log_s, log_l (A, 3), f_a (A, d), O_a (A, k, 3), networks, grids; mask (A, k); cameras
               W (V, 3, 3), T (V, 3), focal, center (V, 2), size (2,), times (V,), truth (V, H, W, 3); views (S,),
               u (S, A, n); learning_rates (P,) of the P names in `arrays`
    Units      log_s, log_l: logarithms of s_a, l_a; times normalised
    Domain     x_a stands still, its learning rate is 0, for the grid has located it; no volume term
    Choice     Q5, Q10, Q12, Q13, Q21 `exact`, Q23; noise (Q23) in stage 4 (Q24)
    Reference  P-4DGS Eqs. (1) to (9) and (11) to (17); Kingma and Ba 2015
    """
    p = gather(
        dict(x_a=x_a, f_a=f_a, log_s=log_s, log_l=log_l, O_a=O_a), networks_of(networks), grids
    )
    nets, levels = {name: p.network(name) for name in networks_of(networks)}, p.listed("grid")
    design = SILENT._replace(
        d=f_a.shape[1],
        k=O_a.shape[1],
        L_x=L_x,
        L_t=L_t,
        Q_0=tuple(Q_0),
        tau_alpha=tau_alpha,
        effects=effects,
    )
    located = hash_grid.locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids])
    fixed = objective.Fixed(
        mask, located, background, True, True, lambda_rate, lambda_ssim, 0.0, EXACT
    )
    names = [own_name(name) for name in arrays]
    rates, adam, rows = dict(zip(names, learning_rates.tolist(), strict=True)), Adam(p), []
    for v, noise in zip(views, u):
        camera = camera_of(W[v], T[v], focal[v], center[v], size)
        view = View("", truth[v], None, camera, times[v])
        losses, _, res = objective.forward(p, design, nets, levels, fixed, view, noise)
        gradients, _ = objective.backward(res)
        adam.step(p, gradients, rates.get)
        rows.append(
            (
                losses.L1,
                losses.D_SSIM,
                losses.L_render,
                losses.L_rate,
                losses.bits,
                losses.L_total,
                [np.linalg.norm(gradients[name]) for name in names],
                [p[name].sum() for name in names],
                [
                    p[name].ravel() @ np.cos(np.arange(p[name].size, dtype=p.vector.dtype))
                    for name in names
                ],
            )
        )
    columns = (np.array(column, p.vector.dtype) for column in zip(*rows))
    return Trace(*columns, np.concatenate([p[name].ravel() for name in names])), None


def gather(attributes, networks, grids):
    """All parameters in one Parameters, copied, as `objective` names them."""
    arrays = dict(attributes)
    for name, pair in networks.items():
        for kind, layers in zip("Wb", pair):
            arrays.update({f"{name}.{kind}{i}": layer for i, layer in enumerate(layers)})
    arrays.update({f"grid.{i}": grid for i, grid in enumerate(grids)})
    return Parameters(arrays, attributes["x_a"].dtype)


def own_name(tensor):
    """The name in Parameters of a flat input: psi_c_weights.0 -> psi_c.W0, grids.1 -> grid.1."""
    name = re.sub(r"_weights\.", ".W", re.sub(r"_biases\.", ".b", tensor))
    return name.replace("grids.", "grid.")


def trace_cases():
    yield Case("ten_steps", trace_inputs(np.random.default_rng(440)))


def trace_inputs(rng, A=9, k=5, d=7, V=6):
    """Anchors, networks and grids wide awake; views of another, smoother model; noise; all drawn by `rng`."""
    resolutions = (("xyz", 3), ("xy", 5), ("xz", 4), ("yz", 4))
    design = SILENT._replace(
        d=d,
        k=k,
        hidden=(7,),
        deformation=(8,),
        L_x=2,
        L_t=1,
        context=(6,),
        grid=resolutions,
        F=1,
        table=(27, 19),
        Q_0=(0.3, 0.02, 0.02, 0.2),
        effects=MODEL_EFFECTS,
    )
    p, teacher = (draw(rng, design, A) for _ in range(2))
    teacher["psi_c.W1"][...] *= 4  # strong colours
    places = [
        2.6 * np.array([np.cos(a), np.sin(a), 0.3 + 0.1 * i])
        for i, a in enumerate(np.linspace(0, 5, V))
    ]
    cameras = [
        look_at(place, (0.05, 0, 0), 14.0, 12.5, 13, 11, c_x=6.4, c_y=4.8) for place in places
    ]
    times, background = np.linspace(0.05, 0.95, V), np.array([0.9, 0.75, 0.3])
    f, s, l, O = (
        teacher["f_a"],
        np.exp(teacher["log_s"]),
        np.exp(teacher["log_l"]),
        teacher["O_a"],
    )
    seen = model.Model(
        design,
        Anchors(teacher["x_a"], f, s, l, O, np.ones((A, k), bool)),
        {name: teacher.network(name) for name in design.layers()},
        [],
        None,
        background,
    )
    posed = [described(camera) for camera in cameras]
    truth = np.stack([seen.render(camera, t, EXACT) for camera, t in zip(cameras, times)])
    flat = {name: p[name] for name in ("x_a", "f_a", "log_s", "log_l", "O_a")}
    flat |= flat_networks({name: p.network(name) for name in NETWORKS}) | {
        "grids": p.listed("grid")
    }
    arrays = tuple(
        name if not isinstance(a, list) else f"{name}.{i}"
        for name, a in flat.items()
        for i in range(len(a) if isinstance(a, list) else 1)
    )
    rate_of = {"x_a": 0.0, "O_a": 0.01, "psi_d": 0.002, "grids": 0.02}
    rates = [rate_of.get(re.split(r"_weights|_biases|\.", name)[0], 0.005) for name in arrays]
    return dict(
        flat,
        mask=rng.random((A, k)) < 0.85,
        lo=p["x_a"].min(axis=0),
        hi=p["x_a"].max(axis=0),
        resolutions=resolutions,
        Q_0=np.array(design.Q_0),
        size=posed[0]["size"],
        times=times,
        truth=truth,
        **{
            name: np.stack([camera[name] for camera in posed])
            for name in ("W", "T", "focal", "center")
        },
        background=background,
        views=rng.integers(0, V, STEPS),
        arrays=arrays,
        learning_rates=np.array(rates),
        u=rng.random((STEPS, A, sum(design.widths))) - 0.5,
        tau_alpha=0.0,
        effects=MODEL_EFFECTS,
        L_x=design.L_x,
        L_t=design.L_t,
        lambda_rate=0.02,
        lambda_ssim=0.2,
    )


def draw(rng, design, A):
    """Parameters with nothing at zero, so that every one of them has a gradient."""
    arrays = {
        "x_a": rng.uniform(-0.7, 0.7, (A, 3)),
        "f_a": rng.normal(size=(A, design.d)),
        "log_s": rng.uniform(-1.6, -0.6, (A, 3)),
        "log_l": rng.uniform(-1.6, -0.6, (A, 3)),
        "O_a": rng.normal(size=(A, design.k, 3)),
    }
    for name, layers in design.layers().items():
        for i, (rows, columns) in enumerate(layers):
            arrays[f"{name}.W{i}"] = rng.normal(size=(rows, columns)) / np.sqrt(rows)
            arrays[f"{name}.b{i}"] = rng.uniform(
                0, 0.5, columns
            )  # above 0: few units of a ReLU are dead
    for i, shape in enumerate(design.levels()):
        arrays[f"grid.{i}"] = rng.uniform(-0.9, 0.9, shape)
    return Parameters(arrays, np.float64)


ANCHOR_SHAPES = {"x_a": "A 3", "f_a": "A d", "O_a": "A k 3", "mask": "A k", "background": "3"}
NUMBERS = dict.fromkeys(("tau_alpha", "effects", "L_x", "L_t"), "")
SUBJECTS_L4 = [
    (
        "compositing",
        undeclared(
            "frames",
            "1 to 6",
            "decoded model -> image",
            {
                **ANCHOR_SHAPES,
                "s_a": "A 3",
                "l_a": "A 3",
                **CAMERA_SHAPES,
                "t": "",
                **NUMBERS,
                "renderer": "",
                **shapes_of(*RENDERING),
                "image": "H W 3",
            },
            (),
            frames_forward,
            no_gradient,
            frames_cases,
        ),
    ),
    (
        "total_loss",
        undeclared(
            "trace",
            "1 to 9, 11 to 17",
            "parameters, views, noise -> losses, gradient norms, checksums, final parameters",
            {
                **ANCHOR_SHAPES,
                "log_s": "A 3",
                "log_l": "A 3",
                "lo": "3",
                "hi": "3",
                "grids": "*T F",
                "resolutions": "",
                "Q_0": "4",
                "W": "V 3 3",
                "T": "V 3",
                "focal": "V 2",
                "center": "V 2",
                "size": "2",
                "times": "V",
                "truth": "V H W 3",
                "views": "S",
                "u": "S A n",
                "learning_rates": "P",
                "arrays": "",
                **NUMBERS,
                "lambda_rate": "",
                "lambda_ssim": "",
                **shapes_of(*NETWORKS),
                **dict.fromkeys(Trace._fields[:6], "S"),
                **dict.fromkeys(Trace._fields[6:9], "S P"),
                "final": "M",
            },
            (),
            trace_forward,
            no_gradient,
            trace_cases,
        ),
    ),
]

if __name__ == "__main__":
    MODEL.write_bytes(train_golden_model())
