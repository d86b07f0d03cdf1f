"""Known mistakes that ports make often: in the scalar functions of L0, and one step of an equation.

A scalar function that is its equation has the equation's mistakes.
"""

import numpy as np
from scipy.special import expit

from tests.workshop.mistakes import geometry, losses, motion, rate
from tests.workshop.mistakes.kit import edited, known, surgery

# Those that show in one coordinate, in points without an extent, and beside ties.
WAVES = (
    *("pi", "two-pi", "degrees", "from-one", "linear", "gradient-frequency", "gradient-sign"),
    *("no-raw", "raw-last", "sines-first", "cosines-first"),
)
PIXEL = (
    *("camera-to-world", "camera-position", "y-up", "z-backward", "one-focal", "centre-of-image"),
    *("half-pixel", "half-pixel-back", "row-column", "distance", "near"),
)
TIES = ("half-away", "half-up", "floor", "truncate", "half-step-up", "symbols-for-values")


def of_scalar(subject, mistakes, chosen=(), run=lambda mistake: mistake.run):
    """Return mistakes of an equation as those of a scalar function that is the equation."""
    scalars = []
    for mistake in mistakes:
        _, _, name = mistake.id.partition("-")
        if not chosen or name in chosen:
            id = f"{subject.replace('_', '-')}-{name}"
            scalars.append(mistake._replace(id=id, subject=subject, run=run(mistake)))
    return scalars


def of_points(mistake):
    """Return `run` of a mistake in projection for points, which have no extent."""

    def run(given, cotangents):
        x, nothing = given["x"], {"conic_bar": np.zeros((len(given["x"]), 3))}
        Sigma = np.zeros((len(x), 3, 3), x.dtype)
        outputs, bars = mistake.run({**given, "Sigma": Sigma}, {**nothing, **cotangents})
        return {n: outputs[n] for n in ("mean2d", "depth", "visible")}, {"x": bars["x"]}

    return run


def of_number(subject, id, description, output, wrong):
    """Return a mistake of a function of y; `wrong(y, bar)` returns the output and the gradient."""

    def run(given, cotangents):
        bar = cotangents[f"{output}_bar"]
        ((name, y),) = given.items()
        out, y_bar = wrong(y, bar.reshape(y.shape))
        return {output: out.reshape(bar.shape)}, {name: y_bar}

    return surgery(subject, id, description, run)


def by_sigmoid(y, bar):
    return expit(y), bar * expit(y) * expit(-y)


def by_tanh(y, bar):
    return np.tanh(y), bar * (1 - np.tanh(y) ** 2)


def unit(r):
    return r / np.sqrt((r * r).sum(axis=1, keepdims=True) + 1e-24)


def halved(name):
    return dict(inputs={name: lambda y: y / 2}, inputs_bar={name: lambda bar, _: bar / 2})


def clamped(y):
    return np.exp(np.clip(y, -14, 6))


NETWORK_OUTPUTS = [
    of_number("tanh", "tanh-sigmoid", "sigmoid for tanh", "alpha", by_sigmoid),
    of_number(
        "tanh",
        "tanh-slope",
        "the slope of tanh is taken as 1 - tanh instead of 1 - tanh^2",
        "alpha",
        lambda y, bar: (np.tanh(y), bar * (1 - np.tanh(y))),
    ),
    of_number("sigmoid", "sigmoid-tanh", "tanh for the sigmoid", "color", by_tanh),
    of_number(
        "sigmoid",
        "sigmoid-slope",
        "the slope of the sigmoid lacks its factor 1 - sigmoid",
        "color",
        lambda y, bar: (expit(y), bar * expit(y)),
    ),
    of_number(
        "unit_quaternion",
        "unit-quaternion-not-normalised",
        "the quaternion is returned as it is, not divided by its length",
        "r",
        lambda y, bar: (y, bar),
    ),
    of_number(
        "unit_quaternion",
        "unit-quaternion-constant-length",
        "the gradient takes the length of the quaternion for a constant",
        "r",
        lambda y, bar: (unit(y), bar / np.sqrt((y * y).sum(axis=1, keepdims=True) + 1e-24)),
    ),
    of_number(
        "sigma_clamp",
        "sigma-clamp-no-clamp",
        "the raw output is not clamped before exp",
        "sigma",
        lambda y, bar: (np.exp(y), bar * np.exp(y)),
    ),
    of_number(
        "sigma_clamp",
        "sigma-clamp-gradient",
        "the clamp of the raw output lets the gradient pass",
        "sigma",
        lambda y, bar: (clamped(y), bar * clamped(y)),
    ),
    known(
        "sigma_clamp",
        "sigma-clamp-log-variance",
        "the raw output is taken for the logarithm of a variance: exp(raw / 2)",
        **halved("raw"),
    ),
    known(
        "step_floor",
        "step-floor-half-argument",
        "q = 2 Q_0 sigmoid(u): the sigmoid of 2 u is meant",
        **halved("u"),
    ),
    known(
        "step_floor",
        "step-floor-half-slope",
        "the slope lacks the inner factor 2 of sigmoid(2 u)",
        inputs_bar={"u": lambda bar, _: bar / 2},
    ),
]


# --- cameras, ellipses, bins ----------------------------------------------------------------------


def density(given, _):
    z, w = given["z"], given["w"]
    log_p = np.log(w) - z * z / 2 - np.log(2 * np.pi) / 2
    return {"log_p": log_p, "slope_z": -z, "slope_w": 1 / w}, {}


BINS = [
    known(
        "gaussian_bin",
        "gaussian-bin-bits",
        "log_p is in bits: the logarithm to base 2 for the natural one",
        outputs=lambda out, given: {name: a / np.log(2) for name, a in out.items()},
    ),
    surgery(
        "gaussian_bin",
        "gaussian-bin-density",
        "the density at z times w for the mass of the bin",
        density,
    ),
    known(
        "gaussian_bin",
        "gaussian-bin-whole-width",
        "the bin reaches from z - w to z + w: the half before w is missing",
        inputs={"w": lambda w: 2 * w},
        outputs={"slope_w": lambda slope: 2 * slope},
    ),
    known(
        "gaussian_bin",
        "gaussian-bin-from-z",
        "the bin reaches from z to z + w instead of from z - w/2 to z + w/2",
        inputs=lambda given: {**given, "z": given["z"] + given["w"] / 2},
        outputs=lambda out, given: {**out, "slope_w": out["slope_w"] + out["slope_z"] / 2},
    ),
]

GEOMETRY = [
    known(
        "rotation_matrix",
        "rotation-matrix-real-last",
        "the quaternion is read as (x, y, z, w) instead of (w, x, y, z)",
        inputs={"r": lambda r: r[:, [3, 0, 1, 2]]},
    ),
    known(
        "rotation_matrix",
        "rotation-matrix-transposed",
        "the matrix is transposed: it turns row vectors",
        outputs={"R": lambda R: R.transpose(0, 2, 1)},
    ),
    known(
        "lens",
        "lens-corner",
        "the principal point counts from the image's corner: half a pixel is not subtracted",
        outputs={"center": lambda center: center + 0.5},
    ),
    known(
        "lens",
        "lens-whole-angle",
        "the focal length is w / (2 tan(angle)): the tangent of half the angle is meant",
        outputs=lambda out, given: (
            out
            if given["fl_x"]
            else {
                **out,
                "focal": out["focal"]
                * np.tan(given["camera_angle_x"] / 2)
                / np.tan(given["camera_angle_x"]),
            }
        ),
    ),
    *of_scalar("pixel", geometry.CAMERAS, PIXEL, of_points),
    known(
        "projection",
        "projection-conic-exchanged",
        "the first and the last number of the conic are exchanged: (c, b, a) of the inverse",
        outputs={"conic": lambda conic: conic[:, ::-1]},
        outputs_bar={"conic": lambda bar, _: bar[:, ::-1]},
    ),
    known(
        "projection",
        "projection-conic-gradient-doubled",
        "the gradient of the conic's off-diagonal entry is counted twice",
        outputs_bar={"conic": geometry.off_diagonal(2)},
    ),
    known(
        "compositing",
        "compositing-conic-exchanged",
        "the first and the last number of the conic are exchanged: a goes with y",
        inputs={"conic": lambda conic: conic[:, ::-1]},
        inputs_bar={"conic": lambda bar, _: bar[:, ::-1]},
    ),
    known(
        "compositing",
        "compositing-off-diagonal-doubled",
        "the gradient of the conic's off-diagonal entry is counted twice",
        inputs_bar={"conic": geometry.off_diagonal(2)},
    ),
]

LOSSES = [
    edited(
        "ssim",
        "ssim-window-no-half",
        "the exponent of the Gaussian window lacks its 1/2",
        {"np.exp(-0.5 * (": "np.exp(-((", "/ SIGMA) ** 2)": "/ SIGMA) ** 2))"},
        helper="p4dgs_ref.equations.window",
    ),
    edited(
        "ssim",
        "ssim-window-sigma",
        "the exponent of the Gaussian window is divided by sigma instead of sigma^2",
        {"/ SIGMA) ** 2)": "/ np.sqrt(SIGMA)) ** 2)"},
        helper="p4dgs_ref.equations.window",
    ),
    surgery(
        "ssim",
        "ssim-replicate",
        "at the border the images are continued by their last pixels (replicate padding)",
        losses.padded("edge"),
    ),
    edited(
        "ssim",
        "ssim-one-constant",
        "C2 is 0.01^2, as C1",
        {"C1, C2 = 0.01**2, 0.03**2": "C1, C2 = 0.01**2, 0.01**2"},
    ),
    edited(
        "ssim",
        "ssim-second-constant",
        "C2 is 0.03 instead of its square",
        {"C1, C2 = 0.01**2, 0.03**2": "C1, C2 = 0.01**2, 0.03"},
    ),
    edited(
        "ssim",
        "ssim-no-constants",
        "C2 is left out",
        {"C1, C2 = 0.01**2, 0.03**2": "C1, C2 = 0.01**2, 0.0"},
    ),
    known(
        "scale",
        "scale-mean-gradient",
        "the gradient of s_a is the mean over the children instead of the sum",
        inputs_bar=lambda bars, given: {
            **bars,
            "s_a": bars["s_a"] / (len(given["biases"][-1]) // 3),
        },
    ),
]

FREE = "(raw >= RAW_MIN) & (raw <= RAW_MAX)"
BOUNDS = [
    edited(
        "prior",
        "prior-no-lower-clamp",
        "raw sigma is clamped at its upper end alone",
        {"np.clip(raw, RAW_MIN, RAW_MAX)": "np.minimum(raw, RAW_MAX)", FREE: "raw <= RAW_MAX"},
    ),
]

MISTAKES = [
    *NETWORK_OUTPUTS,
    *of_scalar("waves", motion.ENCODING, WAVES),
    *of_scalar("rounding_ties", rate.ROUNDING, TIES),
    *BINS,
    *GEOMETRY,
    *LOSSES,
    *BOUNDS,
]
