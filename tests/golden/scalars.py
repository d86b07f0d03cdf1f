"""Vectors of level L0: single numbers on which ports differ. `scalars_coding` has those of coding.

Every subject runs an equation of the paper at its smallest. Networks are the identity, so that what
follows them shows.
"""

from types import SimpleNamespace

import numpy as np

from p4dgs_ref import EQUATIONS
from p4dgs_ref.scenes.dnerf import make_camera
from p4dgs_ref.splatting import covariance
from tests.golden.cases import Case
from tests.golden.subjects import CONSTANTS, Subject, no_pullback


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


def tanh_cases():
    return [
        Case("ordinary", dict(y=np.array([[0.3, -0.7], [1.9, -2.5], [1e-3, -4.0]]))),
        Case("near_zero", dict(y=np.array([[1e-9, -1e-30, 0.0]])), ("zero", "extreme")),
        Case(
            "tails",
            dict(y=np.array([[9.0, -9.0], [18.0, -18.0], [20.0, -400.0]])),
            ("saturated", "extreme"),
        ),
    ]


def sigmoid_cases():
    return [
        Case("ordinary", dict(y=np.array([[0.3, -0.7, 1.9], [-2.5, 0.0, 4.0]]))),
        Case(
            "tails", dict(y=np.array([[17.0, -17.0, 37.0], [-37.0, 80.0, -80.0]])), ("saturated",)
        ),
        Case(
            "beyond_exp",
            dict(y=np.array([[710.0, -1000.0, -1e4]])),
            ("saturated", "extreme"),
            cotangents={"color_bar": np.array([[[2.0, -3, 5]]])},
            expected={"color": np.array([[[1.0, 0, 0]]]), "y_bar": np.zeros((1, 3))},
        ),
    ]


def unit_cases():
    y = np.array([[0.9, -0.3, 0.2, 0.5], [-2.0, 1.0, 4.0, -3.0], [0.1, 0.0, -0.01, 0.02]])
    return [
        Case("ordinary", dict(y=y)),
        Case(
            "long_and_short",
            dict(y=y * np.array([[1e25], [1e-7], [1e6]])),
            ("normalise", "extreme"),
        ),
        Case(
            "zero",
            dict(y=np.zeros((1, 4))),
            ("normalise", "zero", "single"),
            smooth=False,
            cotangents={"r_bar": np.array([[[3.0, -5, 7, 11]]])},
            expected={"r": np.zeros((1, 1, 4)), "y_bar": np.array([[3e12, -5e12, 7e12, 11e12]])},
        ),
    ]


# --- waves, rotations, pixels -------------------------------------------------------------------
def waves_cases():
    return [
        Case("ordinary", dict(p=np.array([[0.37], [-1.2], [2.9]]), L=4)),
        Case(
            "paper_frequencies",
            dict(p=np.array([[0.0], [1.0], [-1.3], [1e-5], [12.0]]), L=10),
            ("zero", "extreme"),
        ),
    ]


def matrix_vjp(r):
    """Rotation matrices of unit quaternions (w, x, y, z); they turn column vectors, x' = R x."""
    return {"R": covariance.rotation_matrix(r)}, no_pullback


def matrix_cases():
    r = np.array(
        [
            [0.9, -0.3, 0.2, 0.5],
            [-2, 1, 4, -3],
            [0.1, 0.7, -0.6, 0.2],
            [0.5, 0, 0.3, 0],
            [-0.2, 0.8, 0.9, 1],
        ]
    )
    h = np.sqrt(
        0.5
    )  # quarter turns about z (x to y) and x (y to z); half a turn about y; none, twice
    turns = np.array([[h, 0, 0, h], [h, h, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [-1, 0, 0, 0]])
    return [
        Case("ordinary", dict(r=r / np.linalg.norm(r, axis=1, keepdims=True))),
        Case(
            "turns",
            dict(r=turns),
            expected={
                "R": np.array(
                    [
                        [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]],
                        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
                        np.diag([-1, 1, -1]),
                        np.eye(3),
                        np.eye(3),
                    ]
                )
            },
        ),
    ]


def pixel_vjp(x, W, T, focal, center, size):
    """Where points appear. A depth at or before 0.2 gives zeros, not visible (Q20, Q21)."""
    no_extent = np.zeros((len(x), 3, 3), x.dtype)
    outputs, pullback = EQUATIONS["projection"].vjp(
        x=x, Sigma=no_extent, W=W, T=T, focal=focal, center=center, size=size
    )
    shown = {name: outputs[name] for name in ("mean2d", "depth", "visible")}
    return shown, lambda **bars: {"x": pullback(**bars)["x"]}


def pixel_cases():
    rng = np.random.default_rng(101)
    W = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    W = W * np.linalg.det(W)  # a rotation, not a mirror
    view = dict(
        W=W,
        T=np.array([0.1, -0.2, 4.0]),
        focal=np.array([80.0, 65.0]),
        center=np.array([30.2, 24.9]),
        size=np.array([64, 48]),
    )
    plain = dict(
        W=np.eye(3),
        T=np.zeros(3),
        focal=np.array([8.0, 4]),
        center=np.array([2.5, 1.5]),
        size=np.array([6, 4]),
    )
    # The axis meets the image of 6 x 4 pixels at (2.5, 1.5), between four of them. The outermost
    # centres are (0, 0) and (5, 3).
    on_pixels = np.array([[0, 0, 1.0], [-2.5 / 8, -1.5 / 4, 1], [5 / 8, 0.75, 2]])
    # u = 8 x / z, v = 4 y / z: in the last row du/dx = 32, du/dz = -16, dv/dy = 16, dv/dz = -4.
    near = np.array(
        [[0.125, 0.0625, 0.1875], [0.125, 0.0625, 0], [0.125, 0.0625, -1], [0.125, 0.0625, 0.25]]
    )
    bars = {
        "mean2d_bar": np.array([[2.0, -3], [5, 7], [-11, 13], [17, -19]]),
        "depth_bar": np.array([1.0, -2, 3, 4]),
    }
    return [
        Case("ordinary", dict(x=rng.normal(size=(5, 3)), **view)),
        Case(
            "pixel_centres",
            dict(x=on_pixels, **plain),
            ("zero",),
            expected={
                "mean2d": np.array([[2.5, 1.5], [0, 0], [5, 3]]),
                "depth": np.array([1.0, 1, 2]),
            },
        ),
        Case(
            "near_plane",
            dict(x=near, **plain),
            ("behind", "zero"),
            smooth=False,
            cotangents=bars,
            expected={
                "visible": np.array([False, False, False, True]),
                "mean2d": np.array([[0.0, 0]] * 3 + [[6.5, 2.5]]),
                "x_bar": np.array([[0.0, 0, 0]] * 3 + [[544, -304, 4 - 16 * 17 + 4 * 19]]),
            },
        ),
        Case(
            "on_the_near_plane",
            dict(x=np.array([[0.125, 0.0625, 0.2]]), **plain),
            ("behind", "kink", "single"),
            smooth=False,
            cotangents={name: a[:1] for name, a in bars.items()},
            expected={
                "visible": np.array([False]),
                "mean2d": np.zeros((1, 2)),
                "x_bar": np.zeros((1, 3)),
            },
        ),
    ]


def lens_vjp(downscale, **fields):
    """Focal lengths and principal point in pixels, from what a transforms file says (Q20).

    The fields are camera_angle_x, fl_x, fl_y, cx, cy, w and h. Those that the file does not give
    are None. cx and cy count from the image's corner, `center` from the centre of its first pixel:
    c_x = cx / downscale - 1/2.
    """
    lens = SimpleNamespace(**fields, camera_angle_y=None)
    camera = make_camera(np.eye(3), np.zeros(3), lens, lens.w, lens.h, downscale)
    outputs = {
        "focal": np.array([camera.f_x, camera.f_y]),
        "center": np.array([camera.c_x, camera.c_y]),
    }
    return outputs, no_pullback


def lens_cases():
    given = dict(
        camera_angle_x=0.7, fl_x=113.0, fl_y=96.5, cx=36.25, cy=28.0, w=64, h=48, downscale=1
    )
    silent = dict.fromkeys(("fl_x", "fl_y", "cx", "cy"))
    return [
        Case(
            "ordinary",
            given,
            expected={"center": np.array([35.75, 27.5]), "focal": np.array([113.0, 96.5])},
        ),
        Case(
            "halved",
            {**given, "downscale": 2},
            expected={"center": np.array([17.625, 13.5]), "focal": np.array([56.5, 48.25])},
        ),
        Case(
            "angle_alone",
            {**given, **silent},
            ("off",),
            expected={"center": np.array([31.5, 23.5])},
        ),
    ]


SUBJECTS = (
    Subject(
        "tanh",
        "L0",
        "opacity",
        "3",
        "alpha = tanh y",
        {"y": "n w", "alpha": "n w"},
        ("y",),
        of_feature("opacity"),
        tanh_cases,
    ),
    Subject(
        "sigmoid",
        "L0",
        "color",
        "3'",
        "color = sigmoid y",
        {"y": "n 3", "color": "n 1 3"},
        ("y",),
        of_feature("color"),
        sigmoid_cases,
    ),
    Subject(
        "unit_quaternion",
        "L0",
        "rotation",
        "3'",
        "r = y / sqrt(|y|^2 + 1e-24)",
        {"y": "n 4", "r": "n 1 4"},
        ("y",),
        of_feature("rotation"),
        unit_cases,
        CONSTANTS["rotation"],
    ),
    Subject(
        "waves",
        "L0",
        "positional_encoding",
        "",
        "E = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1",
        {"p": "n 1", "L": "", "E": "n I"},
        ("p",),
        EQUATIONS["positional_encoding"].vjp,
        waves_cases,
    ),
    Subject(
        "rotation_matrix",
        "L0",
        "covariance",
        "",
        "R(r), r = (w, x, y, z)",
        {"r": "n 4", "R": "n 3 3"},
        (),
        matrix_vjp,
        matrix_cases,
    ),
    Subject(
        "lens",
        "L0",
        "projection",
        "",
        "center = (cx, cy) / downscale - 1/2",
        {
            **dict.fromkeys(
                ("camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h", "downscale"), ""
            ),
            "focal": "2",
            "center": "2",
        },
        (),
        lens_vjp,
        lens_cases,
    ),
    Subject(
        "pixel",
        "L0",
        "projection",
        "",
        "(u, v) = focal (X, Y) / Z + center, (X, Y, Z) = W x + T",
        {
            "x": "n 3",
            "W": "3 3",
            "T": "3",
            "focal": "2",
            "center": "2",
            "size": "2",
            "mean2d": "n 2",
            "depth": "n",
            "visible": "n",
        },
        ("x",),
        pixel_vjp,
        pixel_cases,
        {"near": CONSTANTS["projection"]["near"]},
    ),
)
