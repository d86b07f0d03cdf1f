"""Vectors of level L4: frames of a trained model, and ten steps of an optimisation.

The model is published beside the vectors as `model.p4dgs`: a short training of `bouncing` before a
blue background, with all effects. Nobody has to repeat it: the vectors hold the decoded arrays.
"""

import re
from dataclasses import replace
from functools import cache

import numpy as np

from p4dgs_ref import decode, model
from p4dgs_ref.equations.grid_nodes import locate
from p4dgs_ref.model import Anchors
from p4dgs_ref.oracle.published import FOLDER
from p4dgs_ref.scenes.scene import View
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import EXACT, KERNEL
from p4dgs_ref.training import objective
from p4dgs_ref.training.parameters import Adam, Parameters
from p4dgs_ref.training.trainer import LEARNING_RATES
from tests.workshop.flat import (
    EMPTY,
    NETWORKS,
    camera_of,
    flat_networks,
    networks_of,
)
from tests.workshop.subjects import as_published, no_pullback

MODEL = FOLDER / "model.p4dgs"
STEPS = 10
RENDERING = NETWORKS[:5]  # the networks of Fig. 1


# --- frames -------------------------------------------------------------------------------------
def frames_vjp(
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
    """An image of a decoded model: Fig. 1 from end to end, Eqs. (1) to (6).

    x_c of Eq. (2) is -W^T T. `renderer` names settings of Q21, of which the published cases call
    `kernel` "paper"; the arithmetic is float64 whatever they say.
    """
    camera = camera_of(W, T, focal, center, size)
    design = replace(EMPTY, L_x=L_x, L_t=L_t, tau_alpha=tau_alpha, effects=effects)
    anchors = Anchors(x_a, f_a, s_a, l_a, O_a, mask)
    g, *_ = model.predict(design, networks_of(networks), anchors, camera.center, t)
    settings = {"exact": EXACT, "paper": KERNEL}[renderer]._replace(dtype="float64")
    (image, *_), _ = render.forward(
        g.x, g.s, g.r, g.alpha, g.color, camera, background, settings, "occlusion" in effects
    )
    return {"image": image.astype(x_a.dtype, copy=False)}, no_pullback


@cache
def golden_model():
    """The trained model, decoded."""
    return decode(MODEL.read_bytes())


def drawn_from(m):
    """The inputs of `frames_vjp` that a decoded model gives."""
    return dict(
        **m.anchors._asdict(),
        background=m.background,
        **flat_networks({name: a for name, a in m.networks.items() if name in RENDERING}),
        **{name: getattr(m.design, name) for name in ("tau_alpha", "effects", "L_x", "L_t")},
    )


# --- trace --------------------------------------------------------------------------------------
def traced(
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
    W,  # [V, 3, 3]  V cameras
    T,
    focal,
    center,
    size,  # [2]  the same for all
    times,
    truth,  # [V, H, W, 3]
    background,
    views,  # [S]  the view of every step
    u,  # [S, A, n]  the noise of every step
    learning_rates,  # [P]  of the parameters that `arrays` names
    arrays,
    tau_alpha,
    effects,
    L_x,
    L_t,
    lambda_rate,
    lambda_ssim,
    **networks,
):
    """Yield the parameters after every step of stage 4, its losses and its gradients.

    One view and one noise per step, gradients of L_total, Adam. Adam's n-th step, g being the
    gradient: m = 0.9 m + 0.1 g, v = 0.999 v + 0.001 g^2, both 0 at first; then the parameter moves
    by -rate (m / (1 - 0.9^n)) / (sqrt(v / (1 - 0.999^n)) + e), e = 1e-15 / sqrt(1 - 0.999^n)
    (Kingma and Ba 2015). x_a does not move: its learning rate is 0, because the grid has located
    it. There is no volume term.
    """
    p = gather(
        dict(x_a=x_a, f_a=f_a, log_s=log_s, log_l=log_l, O_a=O_a), networks_of(networks), grids
    )
    nets = {name: p.network(name) for name in networks_of(networks)}
    levels = p.arrays_of("grid")
    design = replace(
        EMPTY,
        d=f_a.shape[1],
        k=O_a.shape[1],
        L_x=L_x,
        L_t=L_t,
        Q_0=tuple(Q_0),
        tau_alpha=tau_alpha,
        effects=effects,
    )
    located = locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids])
    inputs = objective.StepInputs(mask, located, background, 4, lambda_rate, lambda_ssim, EXACT)
    rates = dict(zip(map(parameter_name, arrays), learning_rates.tolist(), strict=True))
    adam = Adam(p)
    for v, noise in zip(views, u):
        camera = camera_of(W[v], T[v], focal[v], center[v], size)
        view = View("", truth[v], None, camera, times[v])
        losses, _, back = objective.loss(p, design, nets, levels, inputs, view, noise)
        gradients, _ = back()
        adam.step(p, gradients, rates.get)
        yield p, losses, gradients


def trace_vjp(arrays, **inputs):
    """Steps of stage 4: the losses, and what they leave of the parameters.

    Returns the losses of every step [S] before the step; `gradient_norm` [S, P] before the step;
    `total` and `ramp` [S, P] after the step, the sum of every parameter array and the sum of its
    elements times cos 0, cos 1, cos 2, ...; and `final`, all parameters after the last step, the
    arrays row by row, one after the other.
    """
    names = [parameter_name(name) for name in arrays]
    rows = {name: [] for name in TRACED}
    for p, losses, gradients in traced(arrays=arrays, **inputs):
        for name in LOSSES:
            rows[name].append(getattr(losses, name))
        rows["gradient_norm"].append([np.linalg.norm(gradients[name]) for name in names])
        rows["total"].append([p[name].sum() for name in names])
        rows["ramp"].append([ramp(p[name]) for name in names])
    outputs = {name: np.array(values, p.vector.dtype) for name, values in rows.items()}
    return {**outputs, "final": np.concatenate([p[name].ravel() for name in names])}, no_pullback


def trace_steps_vjp(**inputs):
    """The same steps: the loss of each of them and the parameters after it, array by array."""
    states = [
        {"L_total": p.vector.dtype.type(losses.L_total), **{n: joined(p, n) for n in ARRAYS}}
        for p, losses, _ in traced(**inputs)
    ]
    return by_step(states), no_pullback


ARRAYS = tuple(LEARNING_RATES)  # the parameters: anchors, networks, grid


def joined(parameters, stem):
    """Return the arrays of a Parameters that belong to an array of the vectors, as one."""
    if stem in parameters.arrays:
        return parameters[stem].copy()
    parts = [a.ravel() for name, a in parameters.arrays.items() if name.split(".")[0] == stem]
    return np.concatenate(parts)


def by_step(states):
    """Return {"x_a.0": array, ...}, the arrays of a list of states, state by state."""
    return {f"{name}.{i}": a for i, state in enumerate(states) for name, a in state.items()}


LOSSES = ("L1", "D_SSIM", "L_render", "L_rate", "bits", "L_total")
TRACED = (*LOSSES, "gradient_norm", "total", "ramp")


def ramp(a):
    """Return the sum of the elements of `a` times cos 0, cos 1, cos 2, ..."""
    return a.ravel() @ np.cos(np.arange(a.size, dtype=a.dtype))


def gather(attributes, networks, grids):
    """All parameters in one Parameters, copied, as `objective` names them."""
    arrays = dict(attributes)
    for name, pair in networks.items():
        for i, (W, b) in enumerate(zip(*pair)):
            arrays.update({f"{name}.W{i}": W, f"{name}.b{i}": b})
    arrays.update({f"grid.{i}": grid for i, grid in enumerate(grids)})
    return Parameters(arrays, attributes["x_a"].dtype)


def parameter_name(tensor):
    """The name in Parameters of a flat input: psi_c_weights.0 -> psi_c.W0, grids.1 -> grid.1."""
    name = re.sub(r"_weights\.", ".W", re.sub(r"_biases\.", ".b", tensor))
    return name.replace("grids.", "grid.")


SUBJECTS = (
    as_published("frames", frames_vjp),
    as_published("trace_steps", trace_steps_vjp),
    as_published("trace", trace_vjp),
)
