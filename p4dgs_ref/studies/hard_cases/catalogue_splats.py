"""Hard cases of covariance, projection and compositing: rows H-G1 to H-G11."""

import numpy as np

from ...splatting import compositing, covariance, fast, projection
from ...splatting.settings import EXACT, FAST
from .entry import DTYPES, FEW, Entry, Measured, hard, number, relative, single

VIEW = dict(
    W=np.eye(3),
    T=np.zeros(3),
    focal=np.array([64.0, 48.0]),
    center=np.array([15.5, 11.5]),
    size=np.array([32.0, 24.0]),
)
NEAR = dict(
    W=np.eye(3),
    T=np.array([0, 0, 1.0]),
    focal=np.ones(2),
    center=np.zeros(2),
    size=np.array([9.0, 5.0]),
)


def projection_entries():
    """H-G1 to H-G4 as far as they are projection."""
    edge = np.float32(0.2)
    depths = np.array([0.0, 1e-12, -1e-12, np.nextafter(edge, np.float32(0)), -3.0])
    x = np.stack([np.full(5, 0.1), np.full(5, -0.2), depths], axis=1)
    nothing = {
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
        "at the camera, at depths +-1e-12, a hair before the near plane, behind: 1/z^2",
        dict(x=x, Sigma=np.tile(np.diag([0.5, 0.25, 1]), (5, 1, 1)), **VIEW),
        ("mean2d", (0, 0)),
        lambda v: v["x"][0, 0] / v["x"][0, 2],
        ("behind", "zero"),
        smooth=False,
        expected=nothing,
    )
    yield hard(
        "H-G1.beyond_near",
        "projection",
        "a hair beyond the near plane",
        dict(
            x=np.array([[0.0625, -0.125, float(np.nextafter(edge, np.float32(1)))]]),
            Sigma=np.diag([0.5, 0.25, 1])[None],
            **VIEW,
        ),
        ("mean2d", (0, 0)),
        lambda v: v["x"][0, 0] / v["x"][0, 2] * v["focal"][0] + v["center"][0],
        ("behind",),
    )
    far = np.array([[40.0, 0.25, 2], [-40, 0.25, 2], [0.25, -90, 4], [50, 60, 0.5]])
    rng = np.random.default_rng(2)
    L = rng.normal(size=(4, 3, 3)) * 0.5
    yield hard(
        "H-G2.beyond_the_clamp",
        "projection",
        "far outside the view, where the Jacobian's x/z is clamped: its gradient is forgotten",
        dict(x=far, Sigma=L @ L.transpose(0, 2, 1), **VIEW),
        ("x_bar", (0, 2)),
        _unclamped,
        ("clamped", "outside"),
        value=(1e-12, 1e-5),
        grad=(1e-11, 1e-5),
    )
    c, s = np.cos(np.deg2rad(40)), np.sin(np.deg2rad(40))
    for name, long, short in (("1e4", 1e8, 0.25), ("1e3", 1e6, 0.25), ("100", 1e4, 1e-4)):
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        yield hard(
            f"H-G3.{name}px",
            "projection",
            f"a splat {name} px long, {short**0.5:g} px thin, at 40 degrees: a c - b^2 in float32",
            dict(x=np.zeros((1, 3)), Sigma=_symmetric((R * [long, short, 1]) @ R.T)[None], **NEAR),
            ("conic", (0, 0)),
            _literal_conic,
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
            f"a scale of {name}: the blur alone remains, or nothing that a conic can hold",
            dict(x=np.zeros((1, 3)), Sigma=np.where(Sigma < 3e38, Sigma, 3e38)[None], **NEAR),
            ("conic", (0, 0)),
            _literal_conic,
            ("extreme", "zero"),
            value=(1e-12, 1e-6),
            grad=(1e-12, 1e-6),
            each=False,
        )
    for name, wrong in (("inf", np.inf), ("nan", np.nan)):
        Sigma = np.stack([np.diag([wrong] * 3), np.eye(3)])
        Sigma = np.where(np.isnan(Sigma), wrong, Sigma)
        yield Entry(
            f"H-G4.{name}",
            "projection",
            f"a covariance with {name}: that Gaussian alone is culled, with gradient 0",
            lambda dtype, Sigma=Sigma: _culled(dtype, Sigma),
        )


def _symmetric(Sigma):
    Sigma = single(Sigma)
    return (Sigma + Sigma.T) / 2


def _literal_conic(v):
    """The conic's first number with the determinant in the precision given."""
    a, b, c = v["Sigma"][0, 0, 0], v["Sigma"][0, 0, 1], v["Sigma"][0, 1, 1]
    blur = v["Sigma"].dtype.type(0.3)
    a, c = a + blur, c + blur
    return c / (a * c - b * b)


def _unclamped(v):
    """The gradient of z as if x/z were not clamped: that of the mean alone, and -2 of everything else over z."""
    x, y, z = v["x"][0]
    return (
        -(v["mean2d_bar"][0] @ (np.array([x, y], v["x"].dtype) * v["focal"])) / z**2
        + v["depth_bar"][0]
    )


def _culled(dtype, Sigma):
    inputs = dict(
        x=np.array([[0.0, 0, 0], [0.5, 0, 0]], DTYPES[dtype]),
        Sigma=Sigma.astype(DTYPES[dtype]),
        **NEAR,
    )
    with np.errstate(all="ignore"):
        out, res = projection.forward(**inputs)
        bars = projection.backward(res, mean2d_bar=np.ones((2, 2)), conic_bar=np.ones((2, 3)))
        alone, res = projection.forward(
            **{**inputs, "x": inputs["x"][1:], "Sigma": inputs["Sigma"][1:]}
        )
        literal = _literal_conic(inputs)
    wanted = np.concatenate([np.zeros((1, 3)), alone.conic])
    grad = {
        name: np.concatenate([np.zeros((1, *a.shape[1:])), a])
        for name, a in projection.backward(
            res, mean2d_bar=np.ones((1, 2)), conic_bar=np.ones((1, 3))
        ).items()
    }
    return Measured(
        number(literal),
        float(out.conic[0, 0]),
        0.0,
        relative(out.conic, wanted, True),
        max(relative(bars[name], grad[name], True) for name in bars),
        0.0,
        0.0,
    )


def shape_entries():
    """H-G4 and H-G5 as far as they are covariance and quaternions."""
    unit = np.array([[0.5, 0.5, -0.5, 0.5]])
    for s in (0.0, 1e-15, 1e15):
        yield hard(
            f"H-G4.covariance{s:g}",
            "covariance",
            f"scales of {s:g} beside 2 and 3",
            dict(s=np.array([[s, 2, 3]]), r=unit),
            ("Sigma", (0, 0, 0)),
            lambda v: v["s"][0, 1] ** 2,
            ("extreme", "zero"),
            each=False,
        )
    apart = dict(
        x=np.zeros((1, 3)), s=np.ones((1, 3)), delta_x=np.zeros((1, 3)), delta_s=np.zeros((1, 3))
    )
    bare = lambda v: (
        (v["r"][0, 1] + v["delta_r"][0, 1]) / np.sqrt(((v["r"] + v["delta_r"]) ** 2).sum())
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
            dict(**apart, r=np.array([r], float), delta_r=np.array([delta], float)),
            ("r_t", (0, 1)),
            bare,
            ("normalise", "extreme"),
        )
    yield Entry(
        "H-G5.opposite",
        "covariance",
        "q and -q: the same covariance to the bit, opposite gradients",
        _opposite,
    )


def _opposite(dtype):
    rng = np.random.default_rng(9)
    r = rng.normal(size=(6, 4))
    r, s = (
        a.astype(DTYPES[dtype])
        for a in (r / np.linalg.norm(r, axis=1, keepdims=True), rng.lognormal(size=(6, 3)))
    )
    bar = rng.normal(size=(6, 3, 3)).astype(DTYPES[dtype])
    (one, res), (two, res_two) = covariance.forward(s, r), covariance.forward(s, -r)
    grad = relative(
        covariance.backward(res_two, bar)["r"], -covariance.backward(res, bar)["r"], True
    )
    return Measured(
        float(r[0, 0] - -r[0, 0]),
        float(two.Sigma[0, 0, 1]),
        float(one.Sigma[0, 0, 1]),
        relative(two.Sigma, one.Sigma, True),
        grad,
        0.0,
        0.0,
    )


def _layers(alpha, n=1, depth=None):
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
    just = np.float32(0.99)
    for name, alpha in (
        ("below_clamp", float(np.nextafter(just, np.float32(0)))),
        ("above_clamp", float(np.nextafter(just, np.float32(1)))),
        ("one", 1.0),
        ("zero", 0.0),
    ):
        yield hard(
            f"H-G6.{name}",
            "compositing",
            "an opacity at either side of its clamp, 0 or 1; literal is the "
            "gradient without a clamp",
            _layers(alpha),
            ("alpha_bar", (0,)),
            lambda v: (
                ((v["color"][0] - v["background"]) * v["image_bar"][0, 0]).sum()
                - v["transmittance_bar"][0, 0]
            ),
            ("clamped", "opaque"),
            value=(1e-13, 2e-5),
            grad=(1e-13, 2e-5),
        )
    for name, alpha, n in (("0.99", 0.9899999, 200), ("0.5", 0.5, 60)):
        yield hard(
            f"H-G7.{name}",
            "compositing",
            f"{n} layers of alpha {name}: T underflows; literal is the last "
            "colour's weight by T / (1 - alpha)",
            {**_layers(alpha, n), "color": np.linspace(0, 1, 3 * n).reshape(n, 3)},
            ("alpha_bar", (0,)),
            _divided,
            ("opaque",),
            value=(1e-13, 1e-4),
            grad=(1e-12, 1e-4),
        )
    depth = np.array([2.0, 1, 2, 1, 2])
    rng = np.random.default_rng(5)
    yield hard(
        "H-G8.equal_depths",
        "compositing",
        "equal depths: front to back by index; literal sorts unstably, here last first",
        {**_layers(0.5, 5, depth), "color": rng.random((5, 3))},
        ("image", (0, 0, 0)),
        lambda v: _stack(v, [3, 1, 4, 2, 0]),
        ("order",),
        value=(1e-13, 1e-5),
        grad=(1e-13, 1e-5),
    )
    yield Entry(
        "H-G8.permuted",
        "compositing",
        "the same Gaussians in another order of input: the same image",
        _permuted,
    )
    yield Entry(
        "H-G6.footprint_edge",
        "fast",
        "alpha one ulp beside 1/255: listed by tiles in float64; literal "
        "compares with a float32 constant",
        _edge,
    )


def _stack(v, order):
    T, total = 1.0, 0.0
    for i in order:
        total, T = total + T * v["alpha"][i] * v["color"][i, 0], T * (1 - v["alpha"][i])
    return total + T * v["background"][0]


def _divided(v):
    """The gradient of the first alpha as published kernels have it: every T recovered from the last by dividing by 1 - alpha."""
    T = np.cumprod(1 - v["alpha"])[-1]
    behind = v["background"] * T
    for i in reversed(range(1, len(v["alpha"]))):
        T = T / (1 - v["alpha"][i])
        behind = behind + v["alpha"][i] * T * v["color"][i]
    T = T / (1 - v["alpha"][0])
    return (v["image_bar"][0, 0] * (T * v["color"][0] - behind / (1 - v["alpha"][0]))).sum()


def _scene(dtype, n, height, width, seed=0):
    splats = compositing.random_splats(np.random.default_rng(seed), n, height, width)
    inputs = dict(**splats, background=np.array([0.9, 0.5, 0.2]), height=height, width=width)
    return {
        name: a.astype(DTYPES[dtype]) if isinstance(a, np.ndarray) and a.dtype.kind == "f" else a
        for name, a in inputs.items()
    }


def _permuted(dtype):
    inputs = _scene(dtype, 40, 9, 7)
    inputs["depth"] = inputs["depth"] + np.arange(40, dtype=DTYPES[dtype])  # no two alike
    turn = np.random.default_rng(1).permutation(40)
    moved = {
        name: a[turn] if isinstance(a, np.ndarray) and len(a) == 40 else a
        for name, a in inputs.items()
    }
    bar = np.random.default_rng(2).normal(size=(9, 7, 3)).astype(DTYPES[dtype])
    (one, res), (two, res_two) = (compositing.forward(**v) for v in (inputs, moved))
    g, h = compositing.backward(res, bar), compositing.backward(res_two, bar)
    error = max(
        relative(h[name][np.argsort(turn)], g[name], False)
        for name in ("mean2d", "conic", "alpha", "color")
    )
    literal = compositing.forward(**{**moved, "depth": inputs["depth"]})[0].image[0, 0, 0]
    return Measured(
        float(literal),
        float(two.image[0, 0, 0]),
        float(one.image[0, 0, 0]),
        relative(two.image, one.image, True),
        error,
        float(np.finfo(DTYPES[dtype]).eps),
        FEW * float(np.finfo(DTYPES[dtype]).eps),
    )


def _settings(dtype, **changes):
    return FAST._replace(dtype=dtype, stop=0.0, **changes)


def _fast(inputs, settings):
    a, b, c = inputs["conic"].astype(float).T
    cov2d = np.stack([c, -b, a], axis=1) / (a * c - b * b)[:, None]
    wide = {
        name: v.astype(float) if isinstance(v, np.ndarray) and v.dtype.kind == "f" else v
        for name, v in inputs.items()
    }
    return fast.forward(cov2d=cov2d, settings=settings, **wide)


def _edge(dtype):
    one, worst, apart = 1 / 255, 0.0, 0
    for alpha in (np.nextafter(one, 0), one, np.nextafter(one, 1)):
        inputs = {
            **_scene("float64", 1, 3, 3),
            "alpha": np.array([alpha]),
            "mean2d": np.ones((1, 2)),
        }
        image = _fast(inputs, _settings(dtype, cut=one))[0].image
        wanted = compositing.forward(**inputs)[0].image
        at_mean = (
            inputs["background"] if alpha <= one else wanted[1, 1]
        )  # the ellipse alpha >= cut is the mean itself
        worst = max(worst, float(np.abs(image[1, 1] - at_mean).max()))
        rounded = DTYPES[dtype](alpha) >= np.float32(one)
        apart += bool(rounded) != bool(alpha >= one)
    return Measured(
        f"{apart} of 3 flip", worst, 0.0, worst, None, 1e-15 if dtype == "float64" else 1e-6, None
    )


def frame_entries():
    yield Entry(
        "H-G9.nothing",
        "fast",
        "no Gaussians, none visible, a picture of one pixel, a width that is no multiple of a tile",
        _nothing,
    )
    yield Entry(
        "H-G10.whole_image",
        "fast",
        "one splat over all of 3840 x 2160: tiles against the closed form; "
        "300 of them are refused before memory is taken",
        _whole,
    )
    yield Entry(
        "H-G11.tiles",
        "fast",
        "tiles of 1, 8, 16 pixels and the whole image, all Gaussians listed: the "
        "exact twin; literal is the 3-sigma box",
        _tiles,
    )


def _nothing(dtype):
    worst = grad = 0.0
    try:
        literal = float(
            np.zeros(0, DTYPES[dtype]).max()
        )  # the largest depth, or radius, of nothing
    except ValueError as error:
        literal = type(error).__name__
    for n, hidden, (height, width) in (
        (0, False, (5, 9)),
        (6, True, (5, 9)),
        (1, True, (1, 1)),
        (0, False, (1, 1)),
    ):
        inputs = _scene(dtype, n, height, width)
        inputs["visible"] = inputs["visible"] & (not hidden)
        out, res = _fast(inputs, _settings(dtype))
        worst = max(
            worst, float(np.abs(out.image - inputs["background"].astype(out.image.dtype)).max())
        )
        bars = fast.backward(res, np.ones((height, width, 3)))
        assert all(
            bars[name].shape == inputs[name].shape for name in ("mean2d", "conic", "alpha", "color")
        )
        grad = max(
            grad,
            *(
                float(np.abs(bars[name]).max(initial=0))
                for name in ("mean2d", "conic", "alpha", "color")
            ),
        )
    return Measured(literal, worst, 0.0, worst, grad, 1e-15 if dtype == "float64" else 1e-6, 0.0)


def _whole(dtype):
    """The mean is (1000, 700), the deviations 4000 and 3000 pixels."""
    inputs = dict(
        mean2d=np.array([[1000.0, 700]]),
        conic=np.array([[4000.0**-2, 0, 3000.0**-2]]),
        alpha=np.array([0.75]),
        color=np.array([[1.0, 0.5, 0.25]]),
        depth=np.ones(1),
        visible=np.ones(1, bool),
        background=np.zeros(3),
        height=2160,
        width=3840,
    )
    image = _fast(inputs, _settings(dtype))[0].image
    many = {
        name: np.repeat(a, 300, axis=0)
        if name in ("mean2d", "conic", "alpha", "color", "depth", "visible")
        else a
        for name, a in inputs.items()
    }
    try:
        _fast(many, _settings(dtype))  # 300 of them would take 8 GB
        refused = False
    except ValueError as error:
        refused = "Gaussian 0 alone touches 129600 of 129600 tiles" in str(error)
    y, x = np.arange(2160.0)[:, None], np.arange(3840.0)
    true = 0.75 * np.exp(-0.5 * (((x - 1000) / 4000) ** 2 + ((y - 700) / 3000) ** 2))
    error = float(np.abs(image[:, :, 0] - true).max() / true.max()) if refused else np.inf
    literal = f"{int(np.ceil(3840 / 8) * np.ceil(2160 / 8)):d} pairs"
    return Measured(
        literal,
        float(image[-1, -1, 0]),
        float(true[-1, -1]),
        error,
        None,
        1e-13 if dtype == "float64" else 1e-5,
        None,
    )


def _tiles(dtype):
    inputs = _scene(dtype, 30, 21, 18)
    bar = np.random.default_rng(4).normal(size=(21, 18, 3)).astype(DTYPES[dtype])
    wide = {
        name: a.astype(float) if isinstance(a, np.ndarray) and a.dtype.kind == "f" else a
        for name, a in inputs.items()
    }
    want, res = compositing.forward(**wide)
    want_bars = compositing.backward(res, bar.astype(float))
    worst = grad = 0.0
    for tile in (1, 8, 16, 21):
        out, res = _fast(
            inputs, EXACT._replace(footprint="ellipse", cut=1e-12, dtype=dtype, tile=tile)
        )
        bars = fast.backward(res, bar)
        worst = max(worst, relative(out.image, want.image, False))
        grad = max(
            grad,
            *(
                relative(bars[name], want_bars[name], False)
                for name in ("mean2d", "conic", "alpha", "color")
            ),
        )
    box = _fast(inputs, EXACT._replace(footprint="box", dtype=dtype, tile=8))[0].image
    bound = 1e-9 if dtype == "float64" else 2e-5
    return Measured(
        float(box[0, 0, 0]),
        float(out.image[0, 0, 0]),
        float(want.image[0, 0, 0]),
        worst,
        grad,
        bound,
        bound,
    )


def entries():
    yield from projection_entries()
    yield from shape_entries()
    yield from layer_entries()
    yield from frame_entries()
