"""Hard cases that take more than one call of an equation, except those of the codec."""

import math

import numpy as np

from p4dgs_ref.equations import anchor_rate, deformed, likelihood, rate_loss
from p4dgs_ref.equations.likelihood import FAR, NARROW
from p4dgs_ref.lab.accuracy import formulas
from p4dgs_ref.lab.random_inputs import random_splats
from p4dgs_ref.lab.stability import judged, number, relative
from p4dgs_ref.oracle.compare import cast
from p4dgs_ref.scenes import Scene, SceneError
from p4dgs_ref.splatting import compositing, covariance, fast, projection, render
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import EXACT, FAST
from p4dgs_ref.training.loop import psnr
from p4dgs_ref.training.parameters import BETA_1, BETA_2, EPSILON, Adam, Parameters
from tests.golden import needles

FEW = 64  # eps: a few roundings of terms a few times larger than their sum
SPLATS = ("mean2d", "conic", "alpha", "color")  # the inputs of compositing with a gradient


def within(dtype, double, single):
    """The bound of a precision."""
    return double if dtype == "float64" else single


def exact(literal, ours, true, error):
    """The result of a procedure that must be exactly right."""
    return judged(literal, ours, true, float(error), None, 0.0, None)


def refuses(call, error, says=""):
    """Whether a call raises that error, with a message that contains `says`."""
    try:
        call()
    except error as refusal:
        return says in str(refusal)
    return False


# --- rate ----------------------------------------------------------------------------------------
def sum_of_bits(dtype):
    """1e8 bits against their exact sum."""
    row = (2 + np.sin(np.arange(100.0))).astype(dtype)
    many = np.broadcast_to(row, (10**6, 100))

    def rated(bits_f):
        A = len(bits_f)
        none = np.zeros((A, 3), row.dtype)
        return anchor_rate.forward(
            bits_f=bits_f,
            bits_s=none,
            bits_l=none,
            bits_O=np.zeros((A, 0, 3), row.dtype),
            mask=np.zeros((A, 0), bool),
        )

    ours = float(rated(many)[0])
    total, block = row.dtype.type(0), np.tile(row, 10**4)
    for _ in range(100):
        total = np.add.accumulate(np.concatenate([[total], block]))[-1]
    true = 10**6 * math.fsum(row.tolist())
    gradient = anchor_rate.backward(rated(many[:7])[1], row.dtype.type(-1.5))["bits_f"]
    return judged(
        float(total),
        ours,
        true,
        abs(ours - true) / true,
        relative(gradient, np.full((7, 100), -1.5), True),
        within(dtype, 1e-11, 1.2e-7),  # NumPy adds blocks one after the other
        0.0,
    )


def seams(dtype):
    """The largest relative jump between neighbours 1e-13 apart, where regimes of Eq. (11) meet."""
    places = [(z, NARROW / max(1, z)) for z in (0, 0.5, 2, 8, 1000)]
    places += [(w / 2, w) for w in (0.05, 1, 100)]
    places += [(FAR + w / 2, w) for w in (0.05, 1, 1e3)]
    jump = slope_jump = literal = 0.0
    z_moved, w_moved = 1 + 1e-13 * np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]])
    for z, w in places:
        z, w = (z * z_moved[None]).astype(dtype), (w * w_moved[None]).astype(dtype)
        inputs = z, 0 * z, 0 * z + 1, w
        bits, saved = likelihood.forward(*inputs)
        q_bar = likelihood.backward(saved, np.ones_like(z))["q"]
        with np.errstate(all="ignore"):
            literal = np.fmax(literal, spread(formulas.literal(*inputs)[0]))
        jump, slope_jump = max(jump, spread(bits)), max(slope_jump, spread(q_bar))
    bound = within(dtype, 1e-9, 2e-6)
    return judged(number(literal), jump, 0.0, jump, slope_jump, bound, bound)


def spread(a):
    """The range of an array over its largest magnitude."""
    return float(np.ptp(a) / np.abs(a).max())


def nothing_coded(dtype):
    """Without coded numbers the rate is 0."""
    zero, three = np.zeros((), dtype)[()], np.array(3, dtype)[()]
    (_, L_rate), saved = rate_loss.forward(zero, zero, 0)
    slope = rate_loss.backward(saved, zero, three)["R_anchor"]
    L_rate = float(L_rate)
    # Literal is 0/0.
    return judged("nan", L_rate, 0.0, abs(L_rate), abs(float(slope)), 0.0, 0.0)


# --- projection and covariance -------------------------------------------------------------------
def culled(value):
    """A procedure: a Gaussian whose covariance holds `value` is culled, its neighbour is not."""

    def run(dtype):
        x = np.array([[0.0, 0, 0], [0.5, 0, 0]], dtype)
        Sigma = np.stack([np.where(np.eye(3) > 0, value, 0), np.eye(3)])
        Sigma = Sigma.astype(dtype)
        with np.errstate(all="ignore"):
            found = conic_and_gradients(x, Sigma)
            a, b, c = Sigma[0, 0, 0] + 0.3, Sigma[0, 0, 1], Sigma[0, 1, 1] + 0.3
            literal = number(c / (a * c - b * b))
        alone = conic_and_gradients(x[1:], Sigma[1:])
        errors = [
            relative(a, np.concatenate([np.zeros_like(b), b]), True) for a, b in zip(found, alone)
        ]
        conic = found[0]
        return judged(literal, float(conic[0, 0]), 0.0, errors[0], max(errors[1:]), 0.0, 0.0)

    return run


def conic_and_gradients(x, Sigma):
    """The conics of Gaussians, and the gradients of the sum of their means and conics."""
    camera = dict(focal=np.ones(2), center=np.zeros(2), size=np.array([9.0, 5.0]))
    outputs, saved = projection.forward(x, Sigma, np.eye(3), np.array([0, 0, 1.0]), **camera)
    _, _, conic, _, _ = outputs
    ones = np.ones((len(x), 2)), np.ones((len(x), 3))
    gradients = projection.backward(saved, mean2d_bar=ones[0], conic_bar=ones[1])
    return conic, gradients["x"], gradients["Sigma"]


def opposite_quaternions(dtype):
    """r and -r are the same rotation."""
    rng = np.random.default_rng(9)
    r = rng.normal(size=(6, 4))
    r = (r / np.linalg.norm(r, axis=1, keepdims=True)).astype(dtype)
    s = rng.lognormal(size=(6, 3)).astype(dtype)
    bar = rng.normal(size=(6, 3, 3)).astype(dtype)
    (one, saved_one), (two, saved_two) = covariance.forward(s, r), covariance.forward(s, -r)
    r_bar = -covariance.backward(saved_one, bar)["r"]
    return judged(
        float(r[0, 0] - -r[0, 0]),
        float(two[0, 0, 1]),
        float(one[0, 0, 1]),
        relative(two, one, True),
        relative(covariance.backward(saved_two, bar)["r"], r_bar, True),
        0.0,
        0.0,
    )


# --- compositing and the fast renderer -----------------------------------------------------------
def splats(dtype, n, height, width):
    """Inputs of compositing."""
    frame = dict(background=np.array([0.9, 0.5, 0.2]), height=height, width=width)
    return cast({**random_splats(np.random.default_rng(0), n, height, width), **frame}, dtype)


def fast_image(inputs, settings):
    """The fast renderer's image and what its backward needs."""
    a, b, c = inputs["conic"].astype(float).T
    cov2d = np.stack([c, -b, a], axis=1) / (a * c - b * b)[:, None]
    (image, *_), saved = fast.forward(cov2d=cov2d, settings=settings, **cast(inputs, float))
    return image, saved


def without_stop(dtype, **changes):
    """The fast settings with another precision, and no early stop."""
    return FAST._replace(dtype=dtype, stop=0.0, **changes)


def permuted(dtype):
    """The image does not depend on the order of the input."""
    inputs = splats(dtype, 40, 9, 7)
    inputs["depth"] = inputs["depth"] + np.arange(40, dtype=dtype)  # no two are equal
    turn = np.random.default_rng(1).permutation(40)
    per_splat = (*SPLATS, "depth", "visible")
    moved = {name: a[turn] if name in per_splat else a for name, a in inputs.items()}
    bar = np.random.default_rng(2).normal(size=(9, 7, 3)).astype(dtype)
    (one, _), saved_one = compositing.forward(**inputs)
    (two, _), saved_two = compositing.forward(**moved)
    gradients = compositing.backward(saved_one, bar)
    gradients_moved = compositing.backward(saved_two, bar)
    back = np.argsort(turn)
    (wrong_depths, _), _ = compositing.forward(**{**moved, "depth": inputs["depth"]})
    eps = float(np.finfo(dtype).eps)
    return judged(
        float(wrong_depths[0, 0, 0]),
        float(two[0, 0, 0]),
        float(one[0, 0, 0]),
        relative(two, one, True),
        max(relative(gradients_moved[n][back], gradients[n], False) for n in SPLATS),
        eps,
        FEW * eps,
    )


def footprint_edge(dtype):
    """A splat is listed where its opacity is at least the cut of 1/255, decided in float64."""
    cut, worst, flips = 1 / 255, 0.0, 0
    for alpha in (np.nextafter(cut, 0), cut, np.nextafter(cut, 1)):
        one = {"alpha": np.array([alpha]), "mean2d": np.ones((1, 2))}
        inputs = {**splats("float64", 1, 3, 3), **one}
        image, _ = fast_image(inputs, without_stop(dtype, cut=cut))
        (full, _), _ = compositing.forward(**inputs)
        # At the cut the ellipse alpha >= cut is the mean itself.
        wanted = inputs["background"] if alpha <= cut else full[1, 1]
        worst = max(worst, float(np.abs(image[1, 1] - wanted).max()))
        flips += (np.array(alpha, dtype) >= np.float32(cut)) != (alpha >= cut)
    return judged(f"{flips} of 3 flip", worst, 0.0, worst, None, within(dtype, 1e-15, 1e-6), None)


def nothing_to_draw(dtype):
    """Without visible Gaussians the image is the background and all gradients are 0."""
    literal = "ValueError"  # the largest depth, or radius, of no Gaussians: np.max of nothing
    worst = grad = 0.0
    for n, shown, height, width in (
        (0, True, 5, 9),
        (6, False, 5, 9),
        (1, False, 1, 1),
        (0, True, 1, 1),
    ):
        inputs = splats(dtype, n, height, width)
        inputs["visible"] = inputs["visible"] & shown
        image, saved = fast_image(inputs, without_stop(dtype))
        background = inputs["background"].astype(image.dtype)
        worst = max(worst, float(np.abs(image - background).max()))
        gradients = fast.backward(saved, np.ones((height, width, 3)))
        for name in SPLATS:
            grad = max(grad, relative(gradients[name], np.zeros(inputs[name].shape), True))
    return judged(literal, worst, 0.0, worst, grad, within(dtype, 1e-15, 1e-6), 0.0)


def whole_image(dtype):
    """One splat over a large image; 30,000 of them would take a terabyte and are refused."""
    one = dict(
        mean2d=np.array([[1000.0, 700]]),
        conic=np.array([[4000.0**-2, 0, 3000.0**-2]]),
        alpha=np.array([0.75]),
        color=np.array([[1.0, 0.5, 0.25]]),
        depth=np.ones(1),
        visible=np.ones(1, bool),
    )
    frame = dict(background=np.zeros(3), height=2160, width=3840)
    image, _ = fast_image({**one, **frame}, without_stop(dtype))
    many = {name: np.repeat(a, 30_000, axis=0) for name, a in one.items()}
    refused = refuses(
        lambda: fast_image({**many, **frame}, without_stop(dtype)),
        ValueError,
        "3888000000 pairs of Gaussians and tiles",
    )
    y, x = np.arange(2160.0)[:, None], np.arange(3840.0)
    true = 0.75 * np.exp(-0.5 * (((x - 1000) / 4000) ** 2 + ((y - 700) / 3000) ** 2))
    error = float(np.abs(image[:, :, 0] - true).max() / true.max()) if refused else np.inf
    return judged(
        f"{3840 // 8 * 2160 // 8} pairs",
        float(image[-1, -1, 0]),
        float(true[-1, -1]),
        error,
        None,
        within(dtype, 1e-13, 1e-5),
        None,
    )


def tiles(dtype):
    """The size of the tiles does not change the image."""
    inputs = splats(dtype, 30, 21, 18)
    bar = np.random.default_rng(4).normal(size=(21, 18, 3)).astype(dtype)
    (want, _), saved = compositing.forward(**cast(inputs, float))
    wanted = compositing.backward(saved, bar.astype(float))
    all_listed = EXACT._replace(footprint="ellipse", cut=1e-12, dtype=dtype)
    worst = grad = 0.0
    for tile in (1, 8, 16, 21):
        image, saved = fast_image(inputs, all_listed._replace(tile=tile))
        gradients = fast.backward(saved, bar)
        worst = max(worst, relative(image, want, False))
        grad = max(grad, *(relative(gradients[n], wanted[n], False) for n in SPLATS))
    box, _ = fast_image(inputs, EXACT._replace(footprint="box", dtype=dtype, tile=8))
    shown = (float(a[0, 0, 0]) for a in (box, image, want))
    bound = within(dtype, 1e-9, 2e-5)
    return judged(*shown, worst, grad, bound, bound)


def long_needle(dtype):
    """The image of a needle and the gradients of its place, scales and quaternion."""
    ratio = max(needles.RATIOS)
    gaussians, bar = needles.needle(ratio)
    true, true_bars = needles.truth(ratio)
    settings = without_stop(dtype, cut=1e-12)
    (image, *_), saved = render.forward(**gaussians, camera=needles.CAMERA, settings=settings)
    gradients = render.backward(saved, bar)
    Sigma, _ = covariance.forward(gaussians.pop("s"), gaussians.pop("r"))
    (literal, *_), _ = render.from_covariances(
        Sigma=Sigma, **gaussians, camera=needles.CAMERA, settings=settings
    )
    worst = np.unravel_index(np.abs(literal - true).argmax(), true.shape)
    return judged(
        *(float(a[worst]) for a in (literal, image, true)),
        relative(image, true, True),
        max(relative(gradients[name], true_bars[name], True) for name in true_bars),
        within(dtype, 1e-13, 1e-5),
        within(dtype, 1e-12, 1e-4),
    )


# --- scene, motion, measures, optimiser ----------------------------------------------------------
def bad_time(dtype):
    """A scene refuses a time that is NaN, infinite or outside 0 to 1, and names it."""
    camera = look_at((0, -3, 1), (0, 0, 0), 9.0, 9.0, 5, 4)
    image = np.zeros((4, 5, 3), dtype)

    def with_time(time):
        return Scene.from_arrays([image], [camera], [time])

    times = np.array([np.nan, -1.0, 2.0, np.inf], dtype)
    refused = sum(refuses(lambda: with_time(t), SceneError, "times[0]") for t in times)
    return exact("nan", f"{refused} refused", "4 refused", 4 - refused)  # literal: 0/0


def still(dtype):
    """Without an effect of motion the attributes pass unchanged.

    Literal adds a zero and normalises once more.
    """
    r = np.random.default_rng(5).normal(size=(50, 4))
    r = (r / np.linalg.norm(r, axis=1, keepdims=True)).astype(dtype)
    x, none = np.ones((50, 3), r.dtype), np.zeros((50, 0), r.dtype)
    (_, _, r_t), _ = deformed.forward(x, x, r, none, none, none)
    (_, _, again), _ = deformed.forward(x, x, r, 0 * x, 0 * x, 0 * r)
    literal, ours = (f"{np.count_nonzero(a != r)} changed" for a in (again, r_t))
    return exact(literal, ours, "0 changed", relative(r_t, r, True))


def equal_images(dtype):
    """The PSNR of equal images is infinite, and null in JSON."""
    image = np.linspace(0, 1, 60).reshape(4, 5, 3).astype(dtype)
    with np.errstate(divide="ignore"):
        literal = -10 * np.log10(np.mean((image - image) ** 2))
    ours = psnr(image, image)
    return exact(str(float(literal)), str(ours), "inf", 0 if ours == math.inf else math.inf)


def adam_step(dtype):
    """One step of Adam against its closed form; literal divides by the root without epsilon."""
    p = Parameters({"x": np.zeros(3)}, np.dtype(dtype).type)
    adam, g, rate = Adam(p), p.zeros(), 0.25
    adam.steps["x"] = 10**5  # steps without a gradient leave both moments at zero
    g["x"][...] = tiny = np.array(2.0**-100, dtype)[()]
    adam.step(p, g, lambda name: rate)
    n, ours = 10**5 + 1, float(p["x"][0])
    root = within(dtype, np.sqrt(1 - BETA_2) * float(tiny), 0.0)  # float32 cannot hold 2^-200
    correction = np.sqrt(1 - BETA_2**n) / (1 - BETA_1**n)
    true = -rate * correction * (1 - BETA_1) * float(tiny) / (root + EPSILON)
    with np.errstate(divide="ignore"):
        square = np.array(1 - BETA_2, dtype)[()] * tiny**2
        literal = -rate * (1 - BETA_1) * tiny / np.sqrt(square)
    bound = FEW * float(np.finfo(dtype).eps)
    error = abs(ours - true) / abs(true)
    return judged(number(literal), ours, float(true), error, None, bound, None)


PROCEDURES = {
    "H-R5.seams": seams,
    "H-R7.sum": sum_of_bits,
    "H-P10.nothing_coded": nothing_coded,
    "H-G3.needle": long_needle,
    "H-G4.inf": culled(np.inf),
    "H-G4.nan": culled(np.nan),
    "H-G5.opposite": opposite_quaternions,
    "H-G8.permuted": permuted,
    "H-G6.footprint_edge": footprint_edge,
    "H-G9.nothing": nothing_to_draw,
    "H-G10.whole_image": whole_image,
    "H-G11.tiles": tiles,
    "H-P3.bad_time": bad_time,
    "H-P3.still": still,
    "H-P8.psnr": equal_images,
    "H-P9.adam": adam_step,
}
