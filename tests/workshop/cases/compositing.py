"""Cases of compositing."""

import numpy as np

from . import Case


def random_splats(rng, n, height, width, sigma=(1.5, 4.0), alpha=(0.05, 0.9)):
    """Return inputs of compositing: n splats of a size in pixels, spread over an image."""
    angle, radii = rng.uniform(0, np.pi, n), rng.uniform(*sigma, size=(2, n))
    c, s, (p, q) = np.cos(angle), np.sin(angle), radii**-2.0
    center = ((width - 1) / 2, (height - 1) / 2)
    return dict(
        mean2d=rng.uniform(-0.5, 0.5, (n, 2)) * (width, height) + center,
        conic=np.stack([c * c * p + s * s * q, c * s * (p - q), s * s * p + c * c * q], axis=1),
        alpha=rng.uniform(*alpha, size=n),
        color=rng.uniform(size=(n, 3)),
        depth=rng.uniform(1, 5, size=n),
        visible=np.ones(n, bool),
    )


def cases():
    rng = np.random.default_rng(33)
    view = dict(background=np.array([0.9, 0.5, 0.2]), height=5, width=6, occlusion=True)
    splats = random_splats(rng, 7, 5, 6)
    yield Case("ordinary", dict(**splats, **view))
    yield Case("no_occlusion", dict(**splats, **{**view, "occlusion": False}), ("off",))
    hidden = {**splats, "visible": np.arange(7) % 3 > 0}
    yield Case("culled_rows", dict(**hidden, **view), ("behind",))
    yield Case(
        "no_gaussians",
        dict(**{name: a[:0] for name, a in splats.items()}, **view),
        ("empty",),
        expected={
            "image": np.broadcast_to(view["background"], (5, 6, 3)),
            "transmittance": np.ones((5, 6)),
        },
    )
    one = {name: a[:1] for name, a in splats.items()}
    yield Case("one_pixel", dict(**one, **{**view, "height": 1, "width": 1}), ("single",))
    flat = dict(
        mean2d=np.zeros((2, 2)),
        conic=np.zeros((2, 3)),
        alpha=np.array([0.5, 0.25]),
        color=np.eye(3)[:2],
        depth=np.ones(2),
        visible=np.ones(2, bool),
        background=np.zeros(3),
        height=1,
        width=1,
    )
    yield Case("equal_depths", flat, ("order",), expected={"image": np.array([[[0.5, 0.125, 0]]])})
    limit = {
        **{name: a[:1] for name, a in flat.items() if name in splats},
        "alpha": np.array([0.75]),
        "color": np.array([[1.0, 0.5, 0.25]]),
    }  # on the end of the clamp the gradient is that of the inside
    yield Case(
        "on_the_clamp",
        dict(
            **limit,
            **{name: flat[name] for name in ("background", "height", "width")},
            alpha_max=0.75,
        ),
        ("kink", "clamped"),
        smooth=False,
        cotangents={"image_bar": np.array([[[1.0, 2.0, -4.0]]])},
        expected={
            "image": 0.75 * limit["color"][None],
            "alpha_bar": np.ones(1),
            "color_bar": 0.75 * np.array([[1.0, 2.0, -4.0]]),
        },
    )
    # Opacities above 0.99, of which only the pixels next to a mean exceed it after the falloff.
    bright = dict(
        mean2d=np.array([[1.0, 1.0625], [3.0, 2.0]]),
        conic=np.array([[0.4, 0.1, 0.5], [0.2, -0.05, 0.3]]),
        alpha=np.array([0.9990234375, 0.99609375]),
        color=np.array([[0.9, 0.2, 0.4], [0.1, 0.8, 0.6]]),
        depth=np.array([1.0, 2.0]),
        visible=np.ones(2, bool),
    )
    yield Case("clamp_of_the_product", dict(**bright, **view), ("clamped",))
    # By hand: the exponents are -ln 2 and ln 2, and the second one, which only a conic has that
    # rounding spoilt, counts as 0. What its gradient is, the cotangents do not ask.
    reach, g = 2 * np.log(2), np.array([1.0, 2.0, -4.0])
    yield Case(
        "positive_exponent",
        dict(
            mean2d=np.array([[0.5, reach]]),
            conic=np.array([[0.0, 1.0, 0.0]]),
            alpha=np.array([0.5]),
            color=limit["color"],
            depth=np.ones(1),
            visible=np.ones(1, bool),
            background=np.zeros(3),
            height=1,
            width=2,
        ),
        ("clamped", "single"),
        smooth=False,
        cotangents={
            "image_bar": np.array([[g, 0 * g]]),
            "transmittance_bar": np.array([[0.5, 0.0]]),
        },
        expected={
            "image": np.array([[[0.25], [0.5]]]) * limit["color"],
            "transmittance": np.array([[0.75, 0.5]]),
            "alpha_bar": np.array([0.25]),
            "color_bar": 0.25 * g[None],
            "mean2d_bar": np.array([[-reach / 8, -0.0625]]),
            "conic_bar": np.array([[-0.015625, -reach / 16, -(reach**2) / 16]]),
            "background_bar": 0.75 * g,
        },
    )
    n = 200  # alpha 0.99 each: the second layer shows 1 %, the third 1e-4
    wall = dict(
        mean2d=np.zeros((n, 2)),
        conic=np.zeros((n, 3)),
        alpha=np.ones(n),
        color=np.ones((n, 3)),
        depth=np.arange(1.0, n + 1),
        visible=np.ones(n, bool),
        background=np.zeros(3),
        height=1,
        width=1,
    )
    yield Case(
        "opaque_wall",
        wall,
        ("opaque", "clamped"),
        smooth=False,
        cotangents={"image_bar": np.array([[[1.0, 2.0, -4.0]]])},
        expected={
            "image": np.ones((1, 1, 3)),
            "alpha_bar": np.zeros(n),
            "color_bar": 0.99 * 0.01 ** np.arange(n)[:, None] * np.array([1.0, 2.0, -4.0]),
        },
    )
