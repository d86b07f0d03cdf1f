"""Subjects that stay as they were published, and the flat inputs of stages and of the pipeline.

A network is two inputs, psi_c_weights [(I, J), ...] and psi_c_biases [(J,), ...]. A camera is five:
W (3, 3) and T (3,) from world to camera, and focal, center, size (2,) in pixels, x before y.
"""

import numpy as np

from p4dgs_ref.model import Design
from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.compare import cast, expected
from p4dgs_ref.splatting.camera import Camera
from tests.golden.cases import Case
from tests.golden.subjects import Subject

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


def as_published(key, vjp, cases=None, **more):
    """Return a Subject whose declaration, and cases where none are given, are the published ones.

    Those inputs were drawn once by random numbers that mean nothing; the vectors hold them.
    """
    row = published.subjects()[key]

    def frozen():
        dtype = np.float64 if more.get("single") else None
        for case in published.cases(key):
            inputs, cotangents = (cast(a, dtype) for a in (case.inputs(), case.cotangents()))
            flags = tuple(case.record["flags"])
            yield Case(case.name, inputs, flags, True, cotangents, closed_form(case))

    return Subject(
        **{name: row[name] for name in ("key", "level", "equation", "number", "formula", "shapes")},
        gradients=tuple(row["differentiable"]),
        vjp=vjp,
        cases=cases or frozen,
        constants=row["constants"],
        group=row.get("group", ""),
        **more,
    )


def closed_form(case):
    """Return the outputs and gradients of a published case that are closed forms, {name: array}."""
    if case.record["provenance"] != "closed form":
        return {}
    others = case.record.get("reference", ())
    known = {name: a for name, a in expected(case.tensors).items() if name not in others}
    return {n.split(".")[1] + "_bar" * n.startswith("in_bar."): a for n, a in known.items()}
