"""Hard cases of prediction, deformation, grid, losses and optimiser: rows H-P1 to H-P10."""

import numpy as np

from ...equations import deformed, mlp, positional_encoding, rate_loss
from ...equations.deformation import random_field
from ...equations.opacity import view_inputs
from ...scenes.scene import Scene, SceneError
from ...splatting.camera import look_at
from ...training.adam import BETA_1, BETA_2, EPSILON, Adam
from ...training.parameters import Parameters
from ...training.progress import psnr
from .entry import DTYPES, FEW, Entry, Measured, hard, number, relative


def _squares(inputs, i=0):
    return np.sqrt(((inputs["x_a"][i] - inputs["x_c"]) ** 2).sum())


def view_entries():
    """H-P1, and what the search found beside it."""
    yield hard(
        "H-P1.inside",
        "view",
        "an anchor in the camera: a direction 0/0",
        dict(x_a=np.array([[1.0, 2, 3], [1, 2, 5]]), x_c=np.array([1.0, 2, 3])),
        ("d_vc", (0, 0)),
        lambda v: (v["x_a"][0, 0] - v["x_c"][0]) / _squares(v),
        ("zero", "kink"),
        smooth=False,
        expected={"delta_vc": np.array([[0.0], [2]]), "d_vc": np.array([[0.0, 0, 0], [0, 0, 1]])},
    )
    yield hard(
        "H-P1.beside",
        "view",
        "an anchor 1e-23 from the camera: squares of differences leave float32",
        dict(x_a=np.array([[3e-23, -4e-23, 1.2e-22], [1e-9, 2e-9, 2e-9]]), x_c=np.zeros(3)),
        ("delta_vc", (0, 0)),
        _squares,
        ("extreme",),
    )
    yield hard(
        "H-P1.along_an_axis",
        "view",
        "nearly along an axis: 1 - d_x^2 has no digits; literal is (I - d d^T) v",
        dict(x_a=np.array([[4.0, 2.0**-14, -(2.0**-16)], [2.0**-20, -2, 0]]), x_c=np.zeros(3)),
        ("x_a_bar", (0, 0)),
        _projected,
        ("extreme",),
    )


def _projected(v):
    """The first anchor's gradient along x as the textbook has it: (delta_bar d + (v - d (d . v)) / delta)."""
    delta = _squares(v)
    d, bar = (v["x_a"][0] - v["x_c"]) / delta, v["d_vc_bar"][0]
    return ((bar - d * (d @ bar)) / delta)[0]


def motion_entries():
    """H-P2 to H-P4."""
    s = np.array([[0.5, 2, 3], [1, 0.25, 4]])
    for name, factor in (("zero", -1.0), ("negative", -2.0)):
        yield hard(
            f"H-P2.{name}",
            "deformed",
            f"delta_s = {factor:g} s: a scale that is {name}; literal clamps or takes a log",
            dict(
                x=np.zeros((2, 3)),
                s=s,
                r=np.eye(4)[:2],
                delta_x=np.ones((2, 3)),
                delta_s=factor * s,
                delta_r=np.zeros((2, 4)),
            ),
            ("s_t", (0, 0)),
            lambda v: np.exp(np.log(v["s"][0, 0] + v["delta_s"][0, 0])),
            ("negative", "zero"),
            expected={"x_t": np.ones((2, 3)), "s_t": (1 + factor) * s, "r_t": np.eye(4)[:2]},
        )
    field = random_field(np.random.default_rng(3), 2, 3, 5)
    x = np.array([[0.3, -1, 0.7], [0, 0.25, -0.5]])
    for t in (0.0, 1.0, -1.0, 2.0):
        yield hard(
            f"H-P3.t{t:g}",
            "deformation",
            f"t = {t:g}: at, before and after the ends of the recording",
            dict(x=x, t=t, **field),
            ("delta_x", (0, 0)),
            _side_by_side,
            ("zero",) if t == 0 else ("outside",),
            each=False,
        )
    yield Entry(
        "H-P3.bad_time",
        "scene",
        "a time of NaN (one frame: t = i / (frames - 1) is 0/0), or outside the recording",
        _bad_time,
    )
    yield Entry(
        "H-P3.still",
        "deformed",
        "a scene in which nothing moves: the same bits at any time",
        _still,
    )
    for L in (10, 16, 20):
        p = np.array([[1.29, -0.77], [-1.3, 0.001]])
        yield hard(
            f"H-P4.L{L}",
            "positional_encoding",
            f"frequencies to 2^{L - 1}; literal doubles the "
            "angle, sin 2a = 2 sin a cos a, L - 1 times",
            dict(p=p, L=L),
            ("E", (0, -4)),
            lambda v: _doubled(v["p"][0, 0], v["L"] - 1),
            ("extreme",),
            each=False,
        )


def _doubled(angle, times):
    """The sine of 2^times angle by doubling: an error that doubles with it."""
    sine, cosine = np.sin(angle), np.cos(angle)
    for _ in range(times):
        sine, cosine = 2 * sine * cosine, cosine * cosine - sine * sine
    return sine


def _side_by_side(v):
    """psi_d's first number from E(x) and E(t) written side by side, row by row."""
    E_x = positional_encoding.forward(v["x"][:1], v["L_x"])[0].E
    E_t = positional_encoding.forward(np.full((1, 1), v["t"], v["x"].dtype), v["L_t"])[0].E
    return mlp.forward(np.concatenate([E_x, E_t], axis=1), v["weights"][:-2], v["biases"][:-2])[
        0
    ].y[0, 0]


def _bad_time(dtype):
    """A scene refuses a time that is none, by name: nothing to divide, nothing to extrapolate."""
    camera = look_at((0, -3, 1), (0, 0, 0), 9.0, 9.0, 5, 4)
    refused = 0
    for time in (np.nan, -1.0, 2.0, np.inf):
        try:
            Scene.from_arrays([np.zeros((4, 5, 3), DTYPES[dtype])], [camera], [DTYPES[dtype](time)])
        except SceneError as error:
            refused += "times[0]" in str(error)
    with np.errstate(invalid="ignore"):
        frame = np.divide(DTYPES[dtype](0), DTYPES[dtype](0))
    return Measured(
        number(frame), f"{refused} refused", "4 refused", float(4 - refused), None, 0.0, None
    )


def _still(dtype):
    """No effect of motion: the attributes pass bit by bit; literal adds a zero and normalises again."""
    r = np.random.default_rng(5).normal(size=(50, 4))
    r = (r / np.linalg.norm(r, axis=1, keepdims=True)).astype(DTYPES[dtype])
    x, none = np.ones((50, 3), r.dtype), np.zeros((50, 0), r.dtype)
    out = deformed.forward(x, x, r, none, none, none)[0]
    again = deformed.forward(x, x, r, 0 * x, 0 * x, 0 * r)[0].r_t
    changed = int((again != r).sum())
    return Measured(
        f"{changed} changed",
        f"{int((out.r_t != r).sum())} changed",
        "0 changed",
        relative(out.r_t, r, True),
        None,
        0.0,
        None,
    )


def grid_entries():
    """H-P5, H-P6."""
    box = dict(lo=np.array([-1.0, 0, 2]), hi=np.array([1.0, 4, 2.5]))
    rng = np.random.default_rng(8)
    for name, resolutions, tables in (
        ("dense", (("xyz", 3), ("xy", 5)), (27, 25)),
        ("hashed", (("xyz", 9), ("yz", 65)), (16, 16)),
    ):
        grids = [rng.uniform(-0.9, 0.9, size=(T, 2)) for T in tables]
        for place, x_a in (
            ("outside", [[-7.0, 9, 1e30], [3, -1e30, 0]]),
            ("upper_face", [[1.0, 4, 2.5], [0.25, 4, 2.5]]),
        ):
            yield hard(
                f"H-P5.{name}_{place}",
                "hash_grid",
                "an anchor beyond the box or on its upper face; literal is the node it would read",
                dict(x_a=np.array(x_a), **box, grids=grids, resolutions=resolutions),
                ("h", (0, 0)),
                _node,
                ("outside", "clamped"),
                each=False,
            )
    latents = np.array([[0.0], [-0.0], [1.0], [-1.0], [1.5], [-1.5]])
    yield hard(
        "H-P6.latents",
        "hash_grid",
        "entries 0, -0, +-1 and beyond: sign(0) is 0 where a bit belongs",
        dict(
            x_a=np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0]]),
            lo=np.zeros(3),
            hi=np.array([2.0, 2, 0]),
            grids=[np.concatenate([latents, np.zeros((3, 1))])],
            resolutions=(("xy", 3),),
        ),
        ("h", (0, 0)),
        lambda v: np.sign(v["grids"][0][0, 0]),
        ("kink", "clamped"),
        smooth=False,
        expected={"h": np.array([[1.0], [1], [1], [-1], [1], [-1]])},
    )


def _node(v):
    """Where along x the first anchor would read, counted in nodes."""
    return float((v["x_a"][0, 0] - v["lo"][0]) / (v["hi"][0] - v["lo"][0]) * v["resolutions"][0][1])


def loss_entries():
    """H-P7, H-P8 and H-P10's weights."""
    truth = np.full((6, 5, 1), 0.75)
    for name, image in (("constant", truth * 0 + 0.5), ("identical", truth), ("black", 0 * truth)):
        other = truth if name != "black" else image
        yield hard(
            f"H-P7.{name}",
            "ssim",
            f"{name} images: E[x^2] - E[x]^2 is rounding",
            dict(image=image, truth=other),
            ("ssim", ()),
            lambda v: _ssim_literal(v["image"], v["truth"]),
            ("single", "zero"),
            value=(1e-12, 2e-6),
            grad=(1e-10, 2e-5),
            **(
                {}
                if name == "constant"
                else dict(smooth=False, expected={"ssim": np.float64(1), "image_bar": 0 * image})
            ),
        )
    rng = np.random.default_rng(4)
    truth = np.round(rng.random((4, 3, 2)), 3)
    yield hard(
        "H-P7.nearly_equal",
        "render_loss",
        "images 1e-4 apart: 1 - SSIM loses what is left in float32",
        dict(image=truth + 1e-4 * rng.choice([-1, 1], truth.shape), truth=truth, lambda_ssim=0.25),
        ("D_SSIM", ()),
        lambda v: 1 - v["image"].dtype.type(_ssim_literal(v["image"], v["truth"])),
        ("zero",),
        value=(1e-10, 2e-4),
        grad=(1e-10, 2e-4),
    )
    for lam in (0.0, 1e6):
        yield hard(
            f"H-P10.lambda{lam:g}",
            "total_loss",
            f"lambda_rate = {lam:g}",
            dict(L_render=np.float64(0.0625), L_rate=np.float64(2.5), lambda_rate=lam),
            ("L_total", ()),
            lambda v: v["L_render"] + v["lambda_rate"] * v["L_rate"],
            ("zero", "extreme"),
            expected={
                "L_total": np.float64(0.0625 + lam * 2.5),
                "L_render_bar": np.nan,
                "L_rate_bar": np.nan,
            },
        )
    yield hard(
        "H-P10.all_masked",
        "masking",
        "a mask that removes every child: empty arrays",
        dict(
            alpha=np.full((3, 2), 0.5),
            mask=np.zeros((3, 2), bool),
            tau_alpha=0.0,
            x=np.ones((3, 2, 3)),
            color=np.ones((3, 2, 3)),
            s=np.ones((3, 2, 3)),
            r=np.ones((3, 2, 4)),
        ),
        ("alpha_bar", (0, 0)),
        lambda v: np.divide(v["alpha"][v["mask"]].sum(), np.count_nonzero(v["mask"])),
        ("masked", "empty"),
        expected={
            name + "_bar": np.zeros((3, 2, *rest))
            for name, rest in (
                ("alpha", ()),
                ("x", (3,)),
                ("color", (3,)),
                ("s", (3,)),
                ("r", (4,)),
            )
        },
    )
    yield Entry(
        "H-P10.nothing_coded", "rate_loss", "no numbers to code: 0/0 bits per number", _nothing
    )
    yield Entry("H-P8.psnr", "evaluate", "PSNR of identical images: log 0", _psnr)


def _ssim_literal(image, truth):
    """SSIM with the window's moments as E[x^2] - E[x]^2, in the precision given."""
    one = image.dtype.type
    line = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = (np.outer(line, line) / line.sum() ** 2).astype(image.dtype)[:, :, None]

    def mean(a):
        around, (H, W, _) = np.pad(a, ((5, 5), (5, 5), (0, 0))), a.shape
        return np.array(
            [
                [(window * around[i : i + 11, j : j + 11]).sum(axis=(0, 1)) for j in range(W)]
                for i in range(H)
            ]
        )

    mx, my = mean(image), mean(truth)
    vx, vy, vxy = (
        mean(image * image) - mx * mx,
        mean(truth * truth) - my * my,
        mean(image * truth) - mx * my,
    )
    C1, C2 = one(1e-4), one(9e-4)
    return (
        (2 * mx * my + C1) * (2 * vxy + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))
    ).mean()


def _nothing(dtype):
    one = DTYPES[dtype]
    out, res = rate_loss.forward(one(0), one(0), 0)
    slope = rate_loss.backward(res, L_rate_bar=one(3))["R_anchor"]
    with np.errstate(invalid="ignore"):
        literal = number(np.divide(one(0), one(0)))
    return Measured(
        literal, float(out.L_rate), 0.0, abs(float(out.L_rate)), abs(float(slope)), 0.0, 0.0
    )


def _psnr(dtype):
    """Infinite by definition, and null beside "exact" in JSON; literal is the logarithm of a mean of zeros."""
    image = np.linspace(0, 1, 60).reshape(4, 5, 3).astype(DTYPES[dtype])
    with np.errstate(divide="ignore"):
        literal = -10 * np.log10(np.mean((image - image) ** 2))
    ours = psnr(image, image)
    return Measured(
        str(float(literal)),
        str(ours),
        "inf",
        0.0 if ours == float("inf") else float("inf"),
        None,
        0.0,
        None,
    )


def _adam(dtype):
    """A gradient of 1e-30 after 1e5 silent steps: the step against its closed form; literal divides by the bare root."""
    p = Parameters({"x": np.zeros(3)}, DTYPES[dtype])
    adam, g, rate = Adam(p), p.zeros(), 0.25
    adam.steps["x"] = 10**5  # silent steps leave both moments at zero
    g["x"][...] = single_gradient = DTYPES[dtype](2.0**-100)
    adam.step(p, g, lambda name: rate)
    n, tiny = 10**5 + 1, float(single_gradient)
    root = (
        np.sqrt(1 - BETA_2) * tiny if dtype == "float64" else 0.0
    )  # the square, 2^-200, is no float32
    true = -rate * np.sqrt(1 - BETA_2**n) / (1 - BETA_1**n) * (1 - BETA_1) * tiny / (root + EPSILON)
    ours = float(p["x"][0])
    with np.errstate(divide="ignore"):
        literal = (
            -rate
            * (1 - BETA_1)
            * single_gradient
            / np.sqrt(DTYPES[dtype](1 - BETA_2) * single_gradient**2)
        )
    return Measured(
        number(literal),
        ours,
        float(true),
        abs(ours - true) / abs(true),
        None,
        FEW * float(np.finfo(DTYPES[dtype]).eps),
        None,
    )


def saturated_entries():
    """Found by the search: slopes where tanh and the sigmoid round to their limit."""
    inputs = view_inputs(np.random.default_rng(6), A=2, d=2, k=2)
    inputs["weights"][-1] *= 0
    inputs["biases"][-1][...] = [9.0, -17.0]
    yield hard(
        "H-S1.tanh",
        "opacity",
        "the slope of a saturated tanh: literal is 1 - alpha^2",
        inputs,
        ("biases_bar", (-1, 1)),
        lambda v: 1 - np.tanh(v["biases"][-1][1]) ** 2,
        ("saturated",),
    )
    for key in ("color", "scale"):
        inputs = view_inputs(np.random.default_rng(7), A=2, d=2, k=1, outputs=3)
        inputs["weights"][-1] *= 0
        inputs["biases"][-1][...] = [16.0, -30.0, 38.0]
        more = {"s_a": np.array([[1.0, 2, 4], [0.5, 1, 8]])} if key == "scale" else {}
        yield hard(
            f"H-S1.{key}",
            key,
            "the slope of a saturated sigmoid: literal is s (1 - s)",
            {**more, **inputs},
            ("biases_bar", (-1, 2)),
            lambda v: (lambda s: s * (1 - s))(1 / (1 + np.exp(-v["biases"][-1][2]))),
            ("saturated",),
        )


def entries():
    yield from view_entries()
    yield from motion_entries()
    yield from grid_entries()
    yield from loss_entries()
    yield Entry(
        "H-P9.adam",
        "adam",
        "epsilon 1e-15 and a gradient of 2^-100 after 1e5 silent steps: a huge step",
        _adam,
    )
    yield from saturated_entries()
