"""The flat inputs of stages and of the pipeline: networks and cameras as arrays.

A network is two inputs, psi_c_weights [(I, J), ...] and psi_c_biases [(J,), ...]. A camera is five:
W (3, 3) and T (3,) from world to camera, and focal, center, size (2,) in pixels, x before y.
"""

import numpy as np

from p4dgs_ref.model import Design
from p4dgs_ref.splatting.camera import Camera

NETWORKS = ("psi_alpha", "psi_c", "psi_r", "psi_s", "psi_d", "psi_p", "psi_q")
CAMERA_SHAPES = {"W": "3 3", "T": "3", "focal": "2", "center": "2", "size": "2"}
# The fields of a Design that a stage does not read stay empty.
EMPTY = Design(
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


def networks_of(flat):
    """Return {"psi_c": (weights, biases), ...} of the flat inputs that belong to networks."""
    return {
        name: (flat[f"{name}_weights"], flat[f"{name}_biases"])
        for name in NETWORKS
        if f"{name}_weights" in flat
    }


def flat_networks(networks):
    """Undo `networks_of`."""
    flat = {}
    for name, (weights, biases) in networks.items():
        flat[f"{name}_weights"], flat[f"{name}_biases"] = weights, biases
    return flat


def flat_gradients(networks):
    """Return gradients {"psi_c": {"weights": [...], "biases": [...], ...}} by flat names."""
    return flat_networks(
        {name: (bars["weights"], bars["biases"]) for name, bars in networks.items()}
    )


def shapes_of(*networks):
    """Return the axes of networks by flat names."""
    shapes = {}
    for name in networks:
        shapes[f"{name}_weights"], shapes[f"{name}_biases"] = "*I J", "*J"
    return shapes


def camera_of(W, T, focal, center, size):
    """Return the Camera that five flat inputs describe."""
    return Camera(W, T, *(float(n) for n in (*focal, *center)), *(int(n) for n in size))


def described(camera):
    """Undo `camera_of`, as keyword arguments."""
    return dict(
        W=camera.R,
        T=camera.T,
        focal=np.array([camera.f_x, camera.f_y]),
        center=np.array([camera.c_x, camera.c_y]),
        size=np.array([camera.width, camera.height]),
    )
