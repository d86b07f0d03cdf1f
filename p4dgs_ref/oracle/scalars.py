"""Vectors of level L0: single numbers on which ports differ.  Here what rendering needs; `scalars_coding` has the rest.

Every subject runs an equation of the paper at its smallest: networks are the identity, so that what follows them shows.
"""

from typing import NamedTuple

import numpy as np

from ..equations import color, opacity, positional_encoding, rotation
from ..equations.equation import Case
from ..scenes.dnerf import make_camera
from ..splatting import covariance, projection
from .scalars_coding import SUBJECTS_CODING
from .undeclared import identity, no_gradient, undeclared


# --- what follows a network ----------------------------------------------------------------------------------------
def tanh_forward(y):
    """Opacity of a network's output.

    Shapes     y (n, w) -> alpha (n, w)
    Units      dimensionless
    Domain     all reals; +-1 where tanh rounds to them
    Gradient   y; 0 where alpha is 1 or -1
    Choice     Q4
    Reference  P-4DGS Eq. (3)
    """
    return opacity.forward(y, y[:, :0], y[:, :0], *identity(y))


def tanh_backward(res, alpha_bar):
    return {"y": opacity.backward(res, alpha_bar)["f_a"]}


def tanh_cases():
    yield Case("ordinary", dict(y=np.array([[0.3, -0.7], [1.9, -2.5], [1e-3, -4.0]])))
    yield Case("near_zero", dict(y=np.array([[1e-9, -1e-30, 0.0]])), ("zero", "extreme"))
    yield Case(
        "tails",
        dict(y=np.array([[9.0, -9.0], [18.0, -18.0], [20.0, -400.0]])),
        ("saturated", "extreme"),
    )


def sigmoid_forward(y):
    """Colour of a network's output.

    Shapes     y (n, 3) -> color (n, 1, 3)
    Units      dimensionless
    Domain     all reals; exp(-y) would overflow below -709 (in float32 -88), the colour there is 0
    Gradient   y; smooth everywhere
    Choice     Q4
    Reference  P-4DGS Eq. (3), applied to colour
    """
    return color.forward(y, y[:, :0], y[:, :0], *identity(y))


def sigmoid_backward(res, color_bar):
    return {"y": color.backward(res, color_bar)["f_a"]}


def sigmoid_cases():
    yield Case("ordinary", dict(y=np.array([[0.3, -0.7, 1.9], [-2.5, 0.0, 4.0]])))
    yield Case(
        "tails", dict(y=np.array([[17.0, -17.0, 37.0], [-37.0, 80.0, -80.0]])), ("saturated",)
    )
    yield Case(
        "beyond_exp",
        dict(y=np.array([[710.0, -1000.0, -1e4]])),
        ("saturated", "extreme"),
        cotangents={"color_bar": np.array([[[2.0, -3, 5]]])},
        expected={"color": np.array([[[1.0, 0, 0]]]), "y_bar": np.zeros((1, 3))},
    )


def unit_forward(y):
    """Unit quaternion of a network's output.

    Shapes     y (n, 4) as (w, x, y, z) -> r (n, 1, 4)
    Units      dimensionless
    Domain     all reals; 0 gives 0
    Gradient   y; orthogonal to r; slope 1e12 at y = 0
    Choice     Q4: y / sqrt(|y|^2 + 1e-24)
    Reference  P-4DGS Eq. (3), applied to rotation
    """
    return rotation.forward(y, y[:, :0], y[:, :0], *identity(y))


def unit_backward(res, r_bar):
    return {"y": rotation.backward(res, r_bar)["f_a"]}


def unit_cases():
    y = np.array([[0.9, -0.3, 0.2, 0.5], [-2.0, 1.0, 4.0, -3.0], [0.1, 0.0, -0.01, 0.02]])
    yield Case("ordinary", dict(y=y))
    yield Case(
        "long_and_short", dict(y=y * np.array([[1e25], [1e-7], [1e6]])), ("normalise", "extreme")
    )
    yield Case(
        "zero",
        dict(y=np.zeros((1, 4))),
        ("normalise", "zero", "single"),
        smooth=False,
        cotangents={"r_bar": np.array([[[3.0, -5, 7, 11]]])},
        expected={"r": np.zeros((1, 1, 4)), "y_bar": np.array([[3e12, -5e12, 7e12, 11e12]])},
    )


# --- waves, rotations, pixels ----------------------------------------------------------------------------------------
def waves_forward(p, L):
    """Sines and cosines of one number.

    Shapes     p (n, 1), L -> E (n, 1 + 2 L): p, sin p, cos p, sin 2p, cos 2p, sin 4p, ...
    Units      p: radians
    Domain     all reals; the largest angle is 2^(L-1) p
    Gradient   p; smooth everywhere
    Choice     Q2: no factor pi, raw input first
    Reference  P-4DGS section 3.2
    """
    return positional_encoding.forward(p, L)


def waves_cases():
    yield Case("ordinary", dict(p=np.array([[0.37], [-1.2], [2.9]]), L=4))
    yield Case(
        "paper_frequencies",
        dict(p=np.array([[0.0], [1.0], [-1.3], [1e-5], [12.0]]), L=10),
        ("zero", "extreme"),
    )


class Rotation(NamedTuple):
    R: np.ndarray  # (n, 3, 3)


def matrix_forward(r):
    """Rotation matrix of a unit quaternion.

    Shapes     r (n, 4) as (w, x, y, z) -> R (n, 3, 3)
    Units      dimensionless
    Domain     r of unit length
    Choice     real part first; R turns column vectors, x' = R x
    Reference  Kerbl et al. 2023
    """
    return Rotation(covariance.rotation_matrix(r)), None


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
    yield Case("ordinary", dict(r=r / np.linalg.norm(r, axis=1, keepdims=True)))
    h = np.sqrt(
        0.5
    )  # quarter turns about z (x to y) and x (y to z); half a turn about y; none, twice
    turns = np.array([[h, 0, 0, h], [h, h, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [-1, 0, 0, 0]])
    yield Case(
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
    )


class Pixel(NamedTuple):
    mean2d: np.ndarray  # (n, 2)
    depth: np.ndarray  # (n,)
    visible: np.ndarray  # (n,) bool


def pixel_forward(x, W, T, focal, center, size):
    """Where a point appears.

    Shapes     x (n, 3), camera W (3, 3), T (3,), focal, center, size (2,) -> mean2d (n, 2), depth, visible (n,)
    Units      x, T, depth: scene units; the rest pixels, centres of pixels at integers
    Domain     depth at or before 0.2: zeros, not visible
    Gradient   x; 0 where not visible
    Choice     Q20, Q21
    Reference  Kerbl et al. 2023
    """
    seen, res = projection.forward(x, np.zeros((len(x), 3, 3), x.dtype), W, T, focal, center, size)
    return Pixel(seen.mean2d, seen.depth, seen.visible), res


def pixel_backward(res, mean2d_bar=None, depth_bar=None):
    return {"x": projection.backward(res, mean2d_bar=mean2d_bar, depth_bar=depth_bar)["x"]}


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
    yield Case("ordinary", dict(x=rng.normal(size=(5, 3)), **view))
    plain = dict(
        W=np.eye(3),
        T=np.zeros(3),
        focal=np.array([8.0, 4]),
        center=np.array([2.5, 1.5]),
        size=np.array([6, 4]),
    )
    # 6 x 4 pixels: the axis meets (2.5, 1.5), between four of them; the outermost centres are (0, 0) and (5, 3)
    seen = np.array([[0, 0, 1.0], [-2.5 / 8, -1.5 / 4, 1], [5 / 8, 0.75, 2]])
    yield Case(
        "pixel_centres",
        dict(x=seen, **plain),
        ("zero",),
        expected={"mean2d": np.array([[2.5, 1.5], [0, 0], [5, 3]]), "depth": np.array([1.0, 1, 2])},
    )
    # u = 8 x / z, v = 4 y / z: du/dx = 32, du/dz = -16, dv/dy = 16, dv/dz = -4 in the last row; 0.2 itself is culled
    near = np.array(
        [[0.125, 0.0625, 0.1875], [0.125, 0.0625, 0], [0.125, 0.0625, -1], [0.125, 0.0625, 0.25]]
    )
    bars = {
        "mean2d_bar": np.array([[2.0, -3], [5, 7], [-11, 13], [17, -19]]),
        "depth_bar": np.array([1.0, -2, 3, 4]),
    }
    yield Case(
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
    )
    yield Case(
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
    )


class Lens(NamedTuple):
    focal: np.ndarray  # (2,)
    center: np.ndarray  # (2,)


def lens_forward(camera_angle_x, fl_x, fl_y, cx, cy, w, h, downscale):
    """Focal lengths and principal point from what a transforms file says; null where the file is silent.

    Shapes     settings alone -> focal, center (2,)
    Units      pixels; cx and cy from the image's corner, center from the centre of its first pixel
    Domain     camera_angle_x or fl_x given; w and h divisible by downscale
    Choice     Q20: c_x = cx / downscale - 1/2
    Reference  the transforms files of NeRF and D-NeRF
    """
    camera = make_camera(
        np.eye(3), np.zeros(3), camera_angle_x, fl_x, fl_y, cx, cy, w, h, downscale
    )
    return Lens(np.array([camera.f_x, camera.f_y]), np.array([camera.c_x, camera.c_y])), None


def lens_cases():
    given = dict(
        camera_angle_x=0.7, fl_x=113.0, fl_y=96.5, cx=36.25, cy=28.0, w=64, h=48, downscale=1
    )
    yield Case(
        "ordinary",
        given,
        expected={"center": np.array([35.75, 27.5]), "focal": np.array([113.0, 96.5])},
    )
    yield Case(
        "halved",
        {**given, "downscale": 2},
        expected={"center": np.array([17.625, 13.5]), "focal": np.array([56.5, 48.25])},
    )
    silent = dict.fromkeys(("fl_x", "fl_y", "cx", "cy"))
    yield Case(
        "angle_alone", {**given, **silent}, ("off",), expected={"center": np.array([31.5, 23.5])}
    )


SUBJECTS_L0 = [
    (
        "opacity",
        undeclared(
            "tanh",
            "3",
            "alpha = tanh y",
            {"y": "n w", "alpha": "n w"},
            ("y",),
            tanh_forward,
            tanh_backward,
            tanh_cases,
        ),
    ),
    (
        "color",
        undeclared(
            "sigmoid",
            "3'",
            "color = sigmoid y",
            {"y": "n 3", "color": "n 1 3"},
            ("y",),
            sigmoid_forward,
            sigmoid_backward,
            sigmoid_cases,
        ),
    ),
    (
        "rotation",
        undeclared(
            "unit_quaternion",
            "3'",
            "r = y / sqrt(|y|^2 + 1e-24)",
            {"y": "n 4", "r": "n 1 4"},
            ("y",),
            unit_forward,
            unit_backward,
            unit_cases,
        ),
    ),
    (
        "positional_encoding",
        undeclared(
            "waves",
            "",
            "E = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1",
            {"p": "n 1", "L": "", "E": "n I"},
            ("p",),
            waves_forward,
            positional_encoding.backward,
            waves_cases,
        ),
    ),
    (
        "covariance",
        undeclared(
            "rotation_matrix",
            "",
            "R(r), r = (w, x, y, z)",
            {"r": "n 4", "R": "n 3 3"},
            (),
            matrix_forward,
            no_gradient,
            matrix_cases,
        ),
    ),
    (
        "projection",
        undeclared(
            "lens",
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
            lens_forward,
            no_gradient,
            lens_cases,
        ),
    ),
    (
        "projection",
        undeclared(
            "pixel",
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
            pixel_forward,
            pixel_backward,
            pixel_cases,
        ),
    ),
    *SUBJECTS_CODING,
]
