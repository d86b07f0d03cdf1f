"""Vectors of level L0: single numbers on which ports differ. `scalars_coding` has those of coding.

Every subject runs an equation of the paper at its smallest. Networks are the identity, so that what
follows them shows.
"""

from collections import Counter
from types import SimpleNamespace

import numpy as np

from p4dgs_ref import EQUATIONS
from p4dgs_ref.scenes.dnerf import lens_of
from p4dgs_ref.scenes.files import make_view
from p4dgs_ref.splatting import covariance
from tests.workshop.subjects import as_published, no_pullback


def identity(y):
    """Return weights and biases of the network of one layer that returns its input (n, w)."""
    return dict(
        weights=[np.eye(y.shape[1], dtype=y.dtype)],
        biases=[np.zeros(y.shape[1], y.dtype)],
    )


# --- what follows a network ---------------------------------------------------------------------
def of_feature(key):
    """Return the vjp of an anchor network's equation as a function of the network's output y."""

    def vjp(y):
        nothing = y[:, :0]
        outputs, pullback = EQUATIONS[key].vjp(f_a=y, delta_vc=nothing, d_vc=nothing, **identity(y))
        return outputs, lambda **bars: {"y": pullback(**bars)["f_a"]}

    return vjp


# --- waves, rotations, pixels -------------------------------------------------------------------


def matrix_vjp(r):
    """Rotation matrices of unit quaternions (w, x, y, z); they turn column vectors, x' = R x."""
    return {"R": covariance.rotation_matrix(r)}, no_pullback


def pixel_vjp(x, W, T, focal, center, size):
    """Where points appear. A depth at or before 0.2 gives zeros, not visible (Q20, Q21)."""
    no_extent = np.zeros((len(x), 3, 3), x.dtype)
    outputs, pullback = EQUATIONS["projection"].vjp(
        x=x, Sigma=no_extent, W=W, T=T, focal=focal, center=center, size=size
    )
    shown = {name: outputs[name] for name in ("mean2d", "depth", "visible")}
    return shown, lambda **bars: {"x": pullback(**bars)["x"]}


def lens_vjp(downscale, **fields):
    """Focal lengths and principal point in pixels, from what a transforms file says (Q20).

    The fields are camera_angle_x, fl_x, fl_y, cx, cy, w and h. Those that the file does not give
    are None. cx and cy count from the image's corner, `center` from the centre of its first pixel:
    c_x = cx / downscale - 1/2.
    """
    if fields["fl_x"]:  # which wins; the loader refuses an angle that disagrees with it
        fields["camera_angle_x"] = None
    distortion = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    frame = SimpleNamespace(**fields, **distortion, camera_angle_y=None, where="lens")
    lens = lens_of(frame, frame.w, frame.h, f"{frame.w}x{frame.h}")
    picture = np.zeros((frame.h, frame.w, 3), np.float32)
    pose = np.eye(3), np.zeros(3)
    color, notes = np.zeros(3), Counter()  # which say nothing of a black picture
    camera = make_view("", picture, lens, *pose, 0.0, color, downscale, "lens", notes).camera
    outputs = {
        "focal": np.array([camera.f_x, camera.f_y]),
        "center": np.array([camera.c_x, camera.c_y]),
    }
    return outputs, no_pullback


SUBJECTS = (
    as_published("tanh", of_feature("opacity")),
    as_published("sigmoid", of_feature("color")),
    as_published("unit_quaternion", of_feature("rotation")),
    as_published("waves", EQUATIONS["positional_encoding"].vjp),
    as_published("rotation_matrix", matrix_vjp),
    as_published("lens", lens_vjp),
    as_published("pixel", pixel_vjp),
)
