"""Known mistakes in covariance and projection: from Gaussians to ellipses in the image."""

import numpy as np

from p4dgs_ref.splatting.covariance import rotation_matrix
from p4dgs_ref.table import EQUATIONS
from tests.golden.mistakes.kit import bars_of, known, port, surgery


# --- covariance ---------------------------------------------------------------------------------
def conjugate(r):
    return r * np.array([1, -1, -1, -1], r.dtype)


def differentiated(Sigma_of, bars_of_R_s):
    """`run` with Sigma_of(R, s) and its gradients bars_of_R_s(Sigma_bar, R, s), R_bar and s_bar."""

    def run(given, cotangents):
        s, r = given["s"][:, None, :], given["r"]
        R = rotation_matrix(r)
        R_bar, s_bar = bars_of_R_s(cotangents["Sigma_bar"], R, s)
        # R is quadratic in r: a central difference over any step is its derivative
        slopes = [
            (rotation_matrix(r + e) - rotation_matrix(r - e)) / 2 for e in np.eye(4, dtype=r.dtype)
        ]
        r_bar = np.stack([(R_bar * slope).sum(axis=(1, 2)) for slope in slopes], axis=1)
        return {"Sigma": Sigma_of(R, s)}, {"s": s_bar, "r": r_bar}

    return run


def transpose(a):
    return a.swapaxes(1, 2)


def squared(R, s):
    return R * s**2 @ transpose(R)


def once(bar, R, s):
    return bar @ (R * s) * s, (bar @ (R * s) * R).sum(axis=1)


def twice(bar, R, s):
    return tuple(2 * a for a in once(bar, R, s))


def plain(R, s):
    return R * s @ transpose(R)


def plain_bars(bar, R, s):
    return (bar + transpose(bar)) @ (R * s), (bar @ R * R).sum(axis=1)


def projected(bar, r):
    return bar - r * (bar * r).sum(axis=1, keepdims=True)


COVARIANCE = [
    known(
        "covariance",
        "covariance-real-last",
        "the quaternion is read as (x, y, z, w) instead of (w, x, y, z)",
        inputs={"r": lambda r: r[:, [3, 0, 1, 2]]},
        inputs_bar={"r": lambda bar, _: bar[:, [1, 2, 3, 0]]},
    ),
    known(
        "covariance",
        "covariance-transposed",
        "the rotation is transposed: R^T S^2 R, as with row vectors",
        inputs={"r": conjugate},
        inputs_bar={"r": lambda bar, _: conjugate(bar)},
    ),
    surgery(
        "covariance",
        "covariance-not-squared",
        "the scales are not squared: R S R^T",
        differentiated(plain, plain_bars),
    ),
    known(
        "covariance",
        "covariance-log-scale",
        "s is taken for a logarithm: exp(s) scales",
        inputs={"s": np.exp},
        inputs_bar={"s": lambda bar, s: bar * np.exp(s)},
    ),
    known(
        "covariance",
        "covariance-log-gradient",
        "the gradient of s is that of log s: it has one factor s too many",
        inputs_bar={"s": lambda bar, s: bar * s},
    ),
    surgery(
        "covariance",
        "covariance-one-factor",
        "the gradient of Sigma = M M^T counts one of the two factors M",
        differentiated(squared, once),
    ),
    surgery(
        "covariance",
        "covariance-not-symmetrised",
        "the gradient of Sigma is taken to be symmetric: "
        "2 Sigma_bar M for (Sigma_bar + Sigma_bar^T) M",
        differentiated(squared, twice),
    ),
    known(
        "covariance",
        "covariance-normalised-gradient",
        "the gradient of r is projected on the unit sphere",
        inputs_bar={"r": projected},
    ),
    known(
        "covariance",
        "covariance-half-quaternion",
        "the gradient of r lacks the factor 2 of the rotation matrix",
        inputs_bar={"r": lambda bar, _: bar / 2},
    ),
]


# --- projection: other cameras ------------------------------------------------------------------
def moved(**changes):
    """Other settings of the camera: name -> f(inputs)."""
    return dict(inputs=lambda given: {**given, **{name: f(given) for name, f in changes.items()}})


FLIP = np.array([1.0, -1.0, 1.0])


def axes_exchanged(tree, *_):
    return {name: a[:, ::-1] if name == "mean2d" else a for name, a in tree.items()}


def shifted(pixels):
    """mean2d moved by so many pixels; culled rows stay zeros."""

    def outputs(out, given):
        mean2d = np.where(
            out["visible"][:, None], out["mean2d"] + np.asarray(pixels, out["mean2d"].dtype), 0
        )
        return {**out, "mean2d": mean2d}

    return dict(outputs=outputs)


def distances(out, given):
    """The distance to the camera in place of its component along the optical axis."""
    x_c = given["x"] @ np.asarray(given["W"]).T + np.asarray(given["T"])
    return {
        **out,
        "depth": np.where(out["visible"], np.linalg.norm(x_c, axis=1), 0).astype(
            out["depth"].dtype
        ),
    }


def distance_run(given, cotangents):
    bar = cotangents["depth_bar"]
    out, in_bar = port("projection")(given, {**cotangents, "depth_bar": np.zeros_like(bar)})
    W = np.asarray(given["W"])
    x_c = given["x"] @ W.T + np.asarray(given["T"])
    far = np.linalg.norm(x_c, axis=1, keepdims=True)
    through = (
        np.where(out["visible"][:, None], bar[:, None] * x_c / np.where(far > 0, far, 1), 0) @ W
    )
    return distances(out, given), {**in_bar, "x": in_bar["x"] + through.astype(in_bar["x"].dtype)}


CAMERAS = [
    known(
        "projection",
        "projection-camera-to-world",
        "W is transposed: camera to world for world to camera",
        **moved(W=lambda given: np.asarray(given["W"]).T),
    ),
    known(
        "projection",
        "projection-camera-position",
        "T is taken for the camera's position: W (x - T) for W x + T",
        **moved(T=lambda given: -np.asarray(given["W"]) @ np.asarray(given["T"])),
    ),
    known(
        "projection",
        "projection-y-up",
        "the camera's y axis points up: the image is flipped",
        **moved(
            W=lambda given: FLIP[:, None] * np.asarray(given["W"]),
            T=lambda given: FLIP * np.asarray(given["T"]),
        ),
    ),
    known(
        "projection",
        "projection-z-backward",
        "the camera looks along -z with y up, as in OpenGL",
        **moved(
            W=lambda given: np.array([[1], [-1], [-1]]) * np.asarray(given["W"]),
            T=lambda given: np.array([1, -1, -1]) * np.asarray(given["T"]),
        ),
    ),
    known(
        "projection",
        "projection-one-focal",
        "the focal length in x is used for y as well",
        **moved(focal=lambda given: np.asarray(given["focal"])[[0, 0]]),
    ),
    known(
        "projection",
        "projection-centre-of-image",
        "the principal point is taken to be the centre of the image",
        **moved(center=lambda given: (np.asarray(given["size"]) - 1) / 2),
    ),
    known(
        "projection",
        "projection-half-pixel",
        "pixel centres are at half integers: means are half a pixel too far",
        **shifted(0.5),
    ),
    known(
        "projection",
        "projection-half-pixel-back",
        "the half pixel of the principal point is subtracted twice",
        **shifted(-0.5),
    ),
    known(
        "projection",
        "projection-row-column",
        "mean2d is (row, column) instead of (column, row)",
        outputs=axes_exchanged,
        outputs_bar=axes_exchanged,
    ),
    surgery(
        "projection",
        "projection-distance",
        "depth is the distance to the camera instead of z",
        distance_run,
    ),
    known(
        "projection",
        "projection-near",
        "the near plane is at 0.01 instead of 0.2",
        **moved(near=lambda given: 0.01),
    ),
    known(
        "projection",
        "projection-near-inclusive",
        "Gaussians exactly on the near plane are kept",
        **moved(near=lambda given: np.nextafter(0.2, 0)),
    ),
    known(
        "projection",
        "projection-no-blur",
        "the covariance lacks the 0.3 of the low-pass filter",
        **moved(blur=lambda given: 0.0),
    ),
    known(
        "projection",
        "projection-blur-third",
        "0.33 is added to the covariance instead of 0.3",
        **moved(blur=lambda given: 0.33),
    ),
    known(
        "projection",
        "projection-blur-squared",
        "0.3^2 is added to the covariance instead of 0.3",
        **moved(blur=lambda given: 0.3**2),
    ),
    known(
        "projection",
        "projection-no-clamp",
        "x/z and y/z are not clamped in the Jacobian",
        **moved(tan_clamp=lambda given: np.inf),
    ),
    known(
        "projection",
        "projection-clamp-at-edge",
        "x/z and y/z are clamped at the image's edge, without the factor 1.3",
        **moved(tan_clamp=lambda given: 1.0),
    ),
]


# --- projection: other formulas -----------------------------------------------------------------
def turned_back(given):
    """x such that W^T for W moves nothing: only the covariance sees another W."""
    W = np.asarray(given["W"])
    return {**given, "x": (given["x"] @ W.T @ W.T).astype(given["x"].dtype), "W": W.T}


def turned_back_bar(bars, given):
    W = np.asarray(given["W"])
    return {**bars, "x": (bars["x"] @ W @ W).astype(bars["x"].dtype)}


def off_diagonal(factor):
    """The middle one of three numbers times `factor`."""

    def scale(a, *_):
        return a * np.array([1, factor, 1], a.dtype)

    return scale


def cov_for_conic_bar(bars, out, given):
    return {**bars, "cov2d": bars["cov2d"] + bars["conic"], "conic": np.zeros_like(bars["conic"])}


def covariance_bar(bars, out):
    """Return the whole gradient of the covariance's (a, b, c), that through the conic included.

    d(K) = -K d(cov) K for the conic, in which b has two places.
    """
    a, b, c = out["conic"].astype(float).T
    g_a, g_b, g_c = bars["conic"].astype(float).T
    through = np.stack(
        [
            a * a * g_a + a * b * g_b + b * b * g_c,
            2 * a * b * g_a + (a * c + b * b) * g_b + 2 * b * c * g_c,
            b * b * g_a + b * c * g_b + c * c * g_c,
        ],
        axis=1,
    )
    return np.where(out["visible"][:, None], bars["cov2d"] - through, 0)


def counted_once(bars, out, given):
    half = covariance_bar(bars, out) * [0, 0.5, 0]
    return {**bars, "cov2d": (bars["cov2d"] - half).astype(bars["cov2d"].dtype)}


def jacobian(place):
    """`run` of a port whose Jacobian is taken elsewhere.

    place(ratio, limit) returns uv, used instead of the clamped x/z and y/z; the slope of uv in x/z
    that x and y see; that slope times x/z as z sees it; the factor of the focal lengths; and minus
    the logarithmic slope of that factor.
    """

    def run(given, cotangents):
        x, W, T = (np.asarray(given[name], float) for name in ("x", "W", "T"))
        x_c = x @ W.T + T
        z = x_c[:, 2:]
        ratio, limit = (
            np.where(z > 0, x_c[:, :2] / z, 0),
            1.3 * np.asarray(given["size"]) / (2 * np.asarray(given["focal"])),
        )
        uv, slope, slope_z, k, k_slope = place(ratio, limit)
        there = {
            **given,
            "x": (np.concatenate([uv * z, z], axis=1) - T) @ W,
            "focal": given["focal"] * k,
        }
        out, pullback = EQUATIONS["projection"].vjp(**given)
        shape, shape_pullback = EQUATIONS["projection"].vjp(
            **there, tan_clamp=np.copysign(np.inf, k)
        )
        out = {
            **out,
            "cov2d": shape["cov2d"],
            "conic": shape["conic"],
            "visible": out["visible"] & shape["visible"],
        }
        bars = bars_of(cotangents)
        here = pullback(mean2d_bar=cotangents["mean2d_bar"], depth_bar=cotangents["depth_bar"])
        bar = shape_pullback(cov2d_bar=cotangents["cov2d_bar"], conic_bar=cotangents["conic_bar"])
        x_c_bar = bar["x"] @ W.T
        uv_bar, z_bar = (
            x_c_bar[:, :2] * z,
            x_c_bar[:, 2:] + (x_c_bar[:, :2] * uv).sum(axis=1, keepdims=True),
        )
        d_a, d_b, d_c = (covariance_bar(bars, out) * (shape["cov2d"] - np.array([0.3, 0, 0.3]))).T
        ratio_k = -np.stack([2 * d_a + d_b, 2 * d_c + d_b], axis=1) * k_slope
        z_bar -= (uv_bar * slope_z + ratio_k * ratio).sum(axis=1, keepdims=True) / z
        x_c_bar = np.concatenate([(uv_bar * slope + ratio_k) / z, z_bar], axis=1)
        x_bar = np.where(out["visible"][:, None], x_c_bar @ W, 0)
        return out, {"x": (here["x"] + x_bar).astype(given["x"].dtype), "Sigma": bar["Sigma"]}

    return run


def clamp_open(ratio, limit):
    return np.clip(ratio, -limit, limit), 1, ratio, 1, 0


def clamp_of_kernel(ratio, limit):
    uv = np.clip(ratio, -limit, limit)
    return uv, np.abs(ratio) <= limit, uv, 1, 0


def clamp_times_x(ratio, limit):
    uv = np.clip(ratio, -limit, limit)
    slope = uv + ratio * (np.abs(ratio) <= limit)
    return uv * ratio, slope, slope * ratio, 1, 0


def over_x(ratio, limit):
    """f / x in the diagonal, which is f / z divided by x/z.

    Where x is 0, a port must do something else; here it takes f / z.
    """
    straight = ratio == 0
    by = np.where(straight, 1, ratio)
    uv, inside = np.clip(ratio, -limit, limit), np.abs(ratio) <= limit
    slope = np.where(straight, inside, uv + by * inside)
    return uv * by, slope, slope * ratio, 1 / by, ~straight / by


def mean_alone(given, cotangents):
    out, pullback = EQUATIONS["projection"].vjp(**given)
    alone = pullback(mean2d_bar=cotangents["mean2d_bar"], depth_bar=cotangents["depth_bar"])
    return out, {**pullback(**cotangents), "x": alone["x"]}


FORMULAS = [
    known(
        "projection",
        "projection-covariance-transposed",
        "the covariance is turned by W^T instead of W",
        inputs=turned_back,
        inputs_bar=turned_back_bar,
    ),
    surgery(
        "projection",
        "projection-focal-over-x",
        "the Jacobian's diagonal is f_x / x, f_y / y instead of f_x / z, f_y / z",
        jacobian(over_x),
    ),
    surgery(
        "projection",
        "projection-clamp-times-x",
        "the clamped x/z is multiplied by x instead of z",
        jacobian(clamp_times_x),
    ),
    surgery(
        "projection",
        "projection-clamp-gradient",
        "the clamp of x/z and y/z lets the gradient through",
        jacobian(clamp_open),
    ),
    surgery(
        "projection",
        "projection-clamp-gradient-of-z",
        "beyond the clamp the gradient of z treats the clamped x as a constant, "
        "as the published kernel does",
        jacobian(clamp_of_kernel),
    ),
    surgery(
        "projection",
        "projection-mean-gradient-alone",
        "x receives no gradient through the covariance",
        mean_alone,
    ),
    known(
        "projection",
        "projection-conic-not-inverted",
        "the conic is the covariance itself: it is not inverted",
        outputs=lambda out, given: {**out, "conic": out["cov2d"]},
        outputs_bar=cov_for_conic_bar,
    ),
    known(
        "projection",
        "projection-conic-sign",
        "the off-diagonal entry of the conic has the covariance's sign",
        outputs={"conic": off_diagonal(-1)},
        outputs_bar={"conic": off_diagonal(-1)},
    ),
    known(
        "projection",
        "projection-conic-doubled",
        "the off-diagonal entry of the conic is counted twice",
        outputs={"conic": off_diagonal(2)},
        outputs_bar={"conic": off_diagonal(2)},
    ),
    known(
        "projection",
        "projection-off-diagonal-gradient",
        "the gradient of the covariance's off-diagonal entry counts one of its two places",
        outputs_bar=counted_once,
    ),
]

MISTAKES = [*COVARIANCE, *CAMERAS, *FORMULAS]
