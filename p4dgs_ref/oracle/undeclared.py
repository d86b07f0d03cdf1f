"""How the oracle makes subjects that are no equations of the paper: single numbers, stages, the pipeline.

Their inputs are flat.  A network comes as two of them, psi_c_weights [(I, J), ...] and psi_c_biases [(J,), ...]; a
camera as W (3, 3) and T (3,) from world to camera, and focal, center, size (2,) in pixels, x before y: see `projection`.
"""

import numpy as np

from ..equations.equation import Equation
from ..model import Design
from ..splatting.camera import Camera

NETWORKS = ("psi_alpha", "psi_c", "psi_r", "psi_s", "psi_d", "psi_p", "psi_q")
CAMERA_SHAPES = {"W": "3 3", "T": "3", "focal": "2", "center": "2", "size": "2"}
# What a stage does not read of a Design stays empty.
SILENT = Design(
    d=0,
    k=0,
    hidden=(),
    deformation=(),
    L_x=0,
    L_t=0,
    context=(),
    grid=(),
    table=(),
    F=0,
    Q_0=(),
    tau_alpha=0.0,
    effects=(),
)


def undeclared(
    key, number, formula, shapes, differentiable, forward, backward, cases, surrogate=None
):
    """An Equation that stands in no table: vectors are made of it, nothing else."""
    return Equation(
        key,
        number,
        formula,
        shapes,
        differentiable,
        forward,
        backward,
        cases,
        surrogate,
        {},
        forward.__module__,
    )


def no_gradient(res, **cotangents):
    """The backward of what has no differentiable input."""
    return {}


def identity(y):
    """Weights and biases of the network of one layer that returns its input (n, w)."""
    return [np.eye(y.shape[1], dtype=y.dtype)], [np.zeros(y.shape[1], y.dtype)]


def networks_of(flat):
    """{"psi_c_weights": [...], "psi_c_biases": [...], ...} -> {"psi_c": (weights, biases), ...}; drops the others."""
    return {
        name: (flat[f"{name}_weights"], flat[f"{name}_biases"])
        for name in NETWORKS
        if f"{name}_weights" in flat
    }


def flat_networks(networks):
    """The inverse of `networks_of`."""
    return {
        f"{name}_{kind}": part
        for name, pair in networks.items()
        for kind, part in zip(("weights", "biases"), pair)
    }


def flat_gradients(networks):
    """Gradients {"psi_c": {"weights": [...], "biases": [...], ...}, ...} under the names of the inputs."""
    return flat_networks(
        {name: (bars["weights"], bars["biases"]) for name, bars in networks.items()}
    )


def shapes_of(*networks):
    """Declared axes of these networks."""
    return {
        f"{name}_{kind}": axes
        for name in networks
        for kind, axes in (("weights", "*I J"), ("biases", "*J"))
    }


def camera_of(W, T, focal, center, size):
    """The Camera that these five describe."""
    return Camera(W, T, *(float(n) for n in (*focal, *center)), *(int(n) for n in size))


def described(camera):
    """The inverse of `camera_of`, as keyword arguments."""
    return dict(
        W=camera.R,
        T=camera.T,
        focal=np.array([camera.f_x, camera.f_y]),
        center=np.array([camera.c_x, camera.c_y]),
        size=np.array([camera.width, camera.height]),
    )
