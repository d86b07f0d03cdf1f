"""Hard cases of covariance, projection and compositing: rows H-G1 to H-G11."""

import numpy as np

from . import literals
from .entry import hard, single

VIEW = dict(
    W=np.eye(3),
    T=np.zeros(3),
    focal=np.array([64.0, 48.0]),
    center=np.array([15.5, 11.5]),
    size=np.array([32, 24]),
)
NEAR = dict(
    W=np.eye(3),
    T=np.array([0, 0, 1.0]),
    focal=np.ones(2),
    center=np.zeros(2),
    size=np.array([9, 5]),
)
FLAT = np.diag([0.5, 0.25, 1])


def depth_entries():
    """H-G1, H-G2: depths at which the projection divides by nothing, and the Jacobian's clamp."""
    edge = np.float32(0.2)
    depths = np.array([0.0, 1e-12, -1e-12, np.nextafter(edge, np.float32(0)), -3.0])
    culled = {
        "mean2d": np.zeros((5, 2)),
        "cov2d": np.zeros((5, 3)),
        "conic": np.zeros((5, 3)),
        "depth": np.zeros(5),
        "visible": np.zeros(5, bool),
        "x_bar": np.zeros((5, 3)),
        "Sigma_bar": np.zeros((5, 3, 3)),
    }
    yield hard(
        "H-G1.culled",
        "projection",
        "at the camera, at depths +-1e-12, one ulp before the near plane, behind: 1/z^2",
        dict(
            x=np.stack([np.full(5, 0.1), np.full(5, -0.2), depths], axis=1),
            Sigma=np.tile(FLAT, (5, 1, 1)),
            **VIEW,
        ),
        ("mean2d", (0, 0)),
        lambda v: v["x"][0, 0] / v["x"][0, 2],
        ("behind", "zero"),
        smooth=False,
        expected=culled,
    )
    beyond = float(np.nextafter(edge, np.float32(1)))
    yield hard(
        "H-G1.beyond_near",
        "projection",
        "one ulp beyond the near plane",
        dict(x=np.array([[0.0625, -0.125, beyond]]), Sigma=FLAT[None], **VIEW),
        ("mean2d", (0, 0)),
        lambda v: v["x"][0, 0] / v["x"][0, 2] * v["focal"][0] + v["center"][0],
        ("behind",),
    )
    far = np.array([[40.0, 0.25, 2], [-40, 0.25, 2], [0.25, -90, 4], [50, 60, 0.5]])
    L = np.random.default_rng(2).normal(size=(4, 3, 3)) * 0.5
    yield hard(
        "H-G2.beyond_the_clamp",
        "projection",
        "far outside the view, where the Jacobian's x/z is clamped; literal forgets its gradient",
        dict(x=far, Sigma=L @ L.transpose(0, 2, 1), **VIEW),
        ("x_bar", (0, 2)),
        literals.gradient_of_the_mean_alone,
        ("clamped", "outside"),
        value=(1e-12, 1e-5),
        grad=(1e-11, 1e-5),
    )


def shape_entries():
    """H-G3, H-G4 as far as they are projection: needles, and scales that are 0 or huge."""
    c, s = np.cos(np.deg2rad(40)), np.sin(np.deg2rad(40))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    for name, long, short in (("1e4", 1e8, 0.25), ("1e3", 1e6, 0.25), ("100", 1e4, 1e-4)):
        yield hard(
            f"H-G3.{name}px",
            "projection",
            f"a splat {name} px long, {short**0.5:g} px thin, at 40 degrees: a c - b^2 in float32",
            dict(x=np.zeros((1, 3)), Sigma=_symmetric((R * [long, short, 1]) @ R.T)[None], **NEAR),
            ("conic", (0, 0)),
            literals.conic_by_determinant,
            ("extreme",),
            value=(1e-7, 1e-6),
            grad=(1e-7, 1e-6),
            each=False,
        )
    for name, scale in (("0", 0.0), ("1e-30", 1e-30), ("1e30", 1e30)):
        Sigma = np.diag([scale * scale] * 3)
        yield hard(
            f"H-G4.scale{name}",
            "projection",
            f"a scale of {name}: the splat is the blur alone, or overflows and is culled",
            dict(x=np.zeros((1, 3)), Sigma=np.where(Sigma < 3e38, Sigma, 3e38)[None], **NEAR),
            ("conic", (0, 0)),
            literals.conic_by_determinant,
            ("extreme", "zero"),
            value=(1e-12, 1e-6),
            grad=(1e-12, 1e-6),
            each=False,
        )


def _symmetric(Sigma):
    Sigma = single(Sigma)
    return (Sigma + Sigma.T) / 2


def turned_entries():
    """H-G4, H-G5 as far as they are covariance and quaternions."""
    for s in (0.0, 1e-15, 1e15):
        yield hard(
            f"H-G4.covariance{s:g}",
            "covariance",
            f"scales of {s:g} beside 2 and 3",
            dict(s=np.array([[s, 2, 3]]), r=np.array([[0.5, 0.5, -0.5, 0.5]])),
            ("Sigma", (0, 0, 0)),
            lambda v: v["s"][0, 1] ** 2,
            ("extreme", "zero"),
            each=False,
        )
    still = dict(
        x=np.zeros((1, 3)), s=np.ones((1, 3)), delta_x=np.zeros((1, 3)), delta_s=np.zeros((1, 3))
    )
    for name, r, delta in (
        ("undone", [0.5, 0.5, 0.5, 0.5], [-0.5, -0.5, -0.5, -0.5]),
        ("1e-30", [0, 1e-30, 0, 0], [0, 0, 0, 0]),
        ("1e-12", [0, 1e-12, 2e-12, 0], [0, 0, 0, 0]),
        ("1000", [400.0, 800, 400, 200], [0, 0, 0, 0]),
        ("1e25", [1e25, 2e25, -1e25, 0], [0, 0, 0, 0]),
        ("nearly_w", [1.0, 2.0**-13, 0, -(2.0**-15)], [0, 0, 0, 0]),
    ):
        yield hard(
            f"H-G5.{name}",
            "deformed",
            "a quaternion that is 0, tiny, long, or nearly an axis; literal is r / sqrt(sum r^2)",
            dict(**still, r=np.array([r], float), delta_r=np.array([delta], float)),
            ("r_t", (0, 1)),
            literals.plainly_normalised,
            ("normalise", "extreme"),
        )


def _layers(alpha, n=1, depth=None):
    """n splats that cover one pixel."""
    return dict(
        mean2d=np.zeros((n, 2)),
        conic=np.zeros((n, 3)),
        alpha=np.full(n, 1.0) * alpha,
        color=np.full((n, 3), 0.5),
        depth=np.arange(1.0, n + 1) if depth is None else depth,
        visible=np.ones(n, bool),
        background=np.array([0.25, 0.5, 1]),
        height=1,
        width=1,
    )


def layer_entries():
    """H-G6, H-G7, H-G8 on one pixel."""
    clamp = np.float32(0.99)
    for name, alpha in (
        ("below_clamp", float(np.nextafter(clamp, np.float32(0)))),
        ("above_clamp", float(np.nextafter(clamp, np.float32(1)))),
        ("one", 1.0),
        ("zero", 0.0),
    ):
        yield hard(
            f"H-G6.{name}",
            "compositing",
            "an opacity on either side of its clamp, 0 or 1; literal is the gradient without clamp",
            _layers(alpha),
            ("alpha_bar", (0,)),
            literals.gradient_without_clamp,
            ("clamped", "opaque"),
            value=(1e-13, 2e-5),
            grad=(1e-13, 2e-5),
        )
    for name, alpha, n in (("0.99", 0.9899999, 200), ("0.5", 0.5, 60)):
        yield hard(
            f"H-G7.{name}",
            "compositing",
            f"{n} layers of alpha {name}: T underflows; literal recovers each T by division",
            {**_layers(alpha, n), "color": np.linspace(0, 1, 3 * n).reshape(n, 3)},
            ("alpha_bar", (0,)),
            literals.gradient_by_division,
            ("opaque",),
            value=(1e-13, 1e-4),
            grad=(1e-12, 1e-4),
        )
    colors = np.random.default_rng(5).random((5, 3))
    yield hard(
        "H-G8.equal_depths",
        "compositing",
        "equal depths: front to back by index; literal sorts unstably, here last first",
        {**_layers(0.5, 5, np.array([2.0, 1, 2, 1, 2])), "color": colors},
        ("image", (0, 0, 0)),
        literals.ties_in_reverse,
        ("order",),
        value=(1e-13, 1e-5),
        grad=(1e-13, 1e-5),
    )


def entries():
    """All of them, in the order of the table."""
    yield from depth_entries()
    yield from shape_entries()
    yield from turned_entries()
    yield from layer_entries()
