"""Known mistakes in covariance and projection: from Gaussians to ellipses in the image."""

import numpy as np

from p4dgs_ref.splatting import covariance
from tests.workshop.mistakes.kit import edited, given_as, known, surgery

# Text of the equations that several mistakes replace.
JACOBIAN = "W[None, :2] - uv[:, :, None] * W[2]"


# --- covariance ---------------------------------------------------------------------------------
def conjugate(r):
    return r * np.array([1, -1, -1, -1], r.dtype)


def projected(bar, r):
    return bar - r * (bar * r).sum(axis=1, keepdims=True)


# The factor of w in the entries of R off its diagonal, 2 (a b +- w c), and its sign.
TURNS = {(0, 1): (3, -1), (0, 2): (2, 1), (1, 0): (3, 1)}
TURNS |= {(1, 2): (1, -1), (2, 0): (2, -1), (2, 1): (1, 1)}


def one_sign(row, column):
    """R with the other sign before w in one entry."""
    axis, sign = TURNS[row, column]

    def run(given, cotangents):
        s, r, Sigma_bar = given["s"], given["r"], cotangents["Sigma_bar"]
        R = covariance.rotation_matrix(r)
        R[:, row, column] -= 4 * sign * r[:, 0] * r[:, axis]
        M = R * s[:, None, :]
        bars = covariance.backward((M, R, s, r), Sigma_bar)
        M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ M
        entry_bar = -4 * sign * M_bar[:, row, column] * s[:, column]
        bars["r"][:, [0, axis]] += entry_bar[:, None] * r[:, [axis, 0]]
        return {"Sigma": M @ M.transpose(0, 2, 1)}, bars

    return surgery(
        "covariance",
        f"covariance-sign-{row + 1}{column + 1}",
        f"one wrong sign in R: that of the product with w in row {row + 1}, column {column + 1}",
        run,
    )


COVARIANCE = [
    *(one_sign(*place) for place in TURNS),
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
    edited(
        "covariance",
        "covariance-not-squared",
        "the scales are not squared: R S R^T",
        {
            "return M @ M.transpose(0, 2, 1)": "return M @ R.transpose(0, 2, 1)",
            'np.einsum("nij,nij->nj", M_bar, R)': "(Sigma_bar @ R * R).sum(axis=1)",
            "R_bar = M_bar * s[:, None, :]": "R_bar = M_bar",
        },
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
    edited(
        "covariance",
        "covariance-one-factor",
        "the gradient of Sigma = M M^T counts one of the two factors M",
        {"(Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ M": "Sigma_bar @ M"},
    ),
    edited(
        "covariance",
        "covariance-not-symmetrised",
        "the gradient of Sigma is taken to be symmetric: "
        "2 Sigma_bar M for (Sigma_bar + Sigma_bar^T) M",
        {"(Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ M": "2 * Sigma_bar @ M"},
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
FLIP = np.array([1.0, -1.0, 1.0])


def axes_exchanged(tree, *_):
    return {name: a[:, ::-1] if name == "mean2d" else a for name, a in tree.items()}


CAMERAS = [
    known(
        "projection",
        "projection-camera-to-world",
        "W is transposed: camera to world for world to camera",
        **given_as(W=lambda given: np.asarray(given["W"]).T),
    ),
    known(
        "projection",
        "projection-camera-position",
        "T is taken for the camera's position: W (x - T) for W x + T",
        **given_as(T=lambda given: -np.asarray(given["W"]) @ np.asarray(given["T"])),
    ),
    known(
        "projection",
        "projection-y-up",
        "the camera's y axis points up: the image is flipped",
        **given_as(
            W=lambda given: FLIP[:, None] * np.asarray(given["W"]),
            T=lambda given: FLIP * np.asarray(given["T"]),
        ),
    ),
    known(
        "projection",
        "projection-z-backward",
        "the camera looks along -z with y up, as in OpenGL",
        **given_as(
            W=lambda given: np.array([[1], [-1], [-1]]) * np.asarray(given["W"]),
            T=lambda given: np.array([1, -1, -1]) * np.asarray(given["T"]),
        ),
    ),
    known(
        "projection",
        "projection-one-focal",
        "the focal length in x is used for y as well",
        **given_as(focal=lambda given: np.asarray(given["focal"])[[0, 0]]),
    ),
    known(
        "projection",
        "projection-centre-of-image",
        "the principal point is taken to be the centre of the image",
        **given_as(center=lambda given: (np.asarray(given["size"]) - 1) / 2),
    ),
    edited(
        "projection",
        "projection-half-pixel",
        "pixel centres are at half integers: means are half a pixel too far",
        {"ratio * focal + center": "ratio * focal + center + 0.5"},
    ),
    edited(
        "projection",
        "projection-half-pixel-back",
        "the half pixel of the principal point is subtracted twice",
        {"ratio * focal + center": "ratio * focal + center - 0.5"},
    ),
    known(
        "projection",
        "projection-row-column",
        "mean2d is (row, column) instead of (column, row)",
        outputs=axes_exchanged,
        outputs_bar=axes_exchanged,
    ),
    edited(
        "projection",
        "projection-distance",
        "depth is the distance to the camera instead of z",
        {
            "center, z, JW": "center, np.linalg.norm(x_c, axis=1)[:, None], JW",
            "z_bar[:, 0] += np.where(visible, depth_bar, 0)": (
                "away = (np.where(visible, depth_bar, 0) / np.linalg.norm(x_c, axis=1))[:, "
                "None] * x_c"
            ),
            "np.concatenate([ratio_bar / z, z_bar], axis=1) @ W": (
                "(np.concatenate([ratio_bar / z, z_bar], axis=1) + away) @ W"
            ),
        },
    ),
    known(
        "projection",
        "projection-near",
        "the near plane is at 0.01 instead of 0.2",
        **given_as(near=lambda given: 0.01),
    ),
    known(
        "projection",
        "projection-near-inclusive",
        "Gaussians exactly on the near plane are kept",
        **given_as(near=lambda given: np.nextafter(0.2, 0)),
    ),
    known(
        "projection",
        "projection-no-blur",
        "the covariance lacks the 0.3 of the low-pass filter",
        **given_as(blur=lambda given: 0.0),
    ),
    known(
        "projection",
        "projection-blur-third",
        "0.33 is added to the covariance instead of 0.3",
        **given_as(blur=lambda given: 0.33),
    ),
    known(
        "projection",
        "projection-blur-squared",
        "0.3^2 is added to the covariance instead of 0.3",
        **given_as(blur=lambda given: 0.3**2),
    ),
    known(
        "projection",
        "projection-no-clamp",
        "x/z and y/z are not clamped in the Jacobian",
        **given_as(tan_clamp=lambda given: np.inf),
    ),
    known(
        "projection",
        "projection-clamp-at-edge",
        "x/z and y/z are clamped at the image's edge, without the factor 1.3",
        **given_as(tan_clamp=lambda given: 1.0),
    ),
]


# --- projection: other formulas -----------------------------------------------------------------


def off_diagonal(factor):
    """The middle one of three numbers times `factor`."""

    def scale(a, *_):
        return a * np.array([1, factor, 1], a.dtype)

    return scale


FORMULAS = [
    edited(
        "projection",
        "projection-covariance-transposed",
        "the covariance is turned by W^T instead of W",
        {JACOBIAN: "W.T[None, :2] - uv[:, :, None] * W.T[2]", "JW_bar @ W[2]": "JW_bar @ W.T[2]"},
    ),
    edited(
        "projection",
        "projection-focal-over-x",
        "the Jacobian's diagonal is f_x / x, f_y / y instead of f_x / z, f_y / z",
        {
            JACOBIAN: "W[None, :2] / np.where(ratio, ratio, 1)[:, :, None] - uv[:, :, None] * W[2]",
            "ratio_bar = uv_bar * inside": (
                "ratio_bar = uv_bar * inside - (JW_bar * W[:2]).sum(axis=2) * focal * z / "
                "np.where(x_c[:, :2], x_c[:, :2], np.inf) ** 2"
            ),
        },
    ),
    edited(
        "projection",
        "projection-jacobian-sign",
        "the third column of the Jacobian has the wrong sign: + f_x u / z",
        {
            JACOBIAN: JACOBIAN.replace("-", "+"),
            "uv_bar = -(JW_bar @ W[2])": "uv_bar = (JW_bar @ W[2])",
        },
    ),
    edited(
        "projection",
        "projection-detached-determinant",
        "the gradient of the conic takes the determinant for a constant",
        {
            "cov_bar -= K @ matrix_gradient(conic_bar, visible) @ K": (
                "cov_bar += matrix_gradient(conic_bar, visible)[:, ::-1, ::-1] "
                "* [[1, -1], [-1, 1]] * np.linalg.det(K)[:, None, None]"
            )
        },
    ),
    edited(
        "projection",
        "projection-clamp-times-x",
        "the clamped x/z is multiplied by x instead of z",
        {
            JACOBIAN: "W[None, :2] - (uv * ratio)[:, :, None] * W[2]",
            "np.abs(ratio) <= limit": "uv + ratio * (np.abs(ratio) <= limit)",
        },
    ),
    edited(
        "projection",
        "projection-clamp-gradient",
        "the clamp of x/z and y/z lets the gradient through",
        {"np.abs(ratio) <= limit": "np.isfinite(ratio)"},
    ),
    edited(
        "projection",
        "projection-clamp-gradient-of-z",
        "beyond the clamp the gradient of z treats the clamped x as a constant, "
        "as the published kernel does",
        {
            "in_front), (x_c,": "in_front), ((x_c, uv),",
            "x_c, inside, JW, W, focal = saved": "(x_c, uv), inside, JW, W, focal = saved",
            "ratio_bar = uv_bar * inside": (
                "ratio_bar, z_bar = uv_bar * inside, z_bar - (uv_bar * uv * "
                "~inside).sum(axis=1, keepdims=True) / z"
            ),
        },
    ),
    edited(
        "projection",
        "projection-mean-gradient-alone",
        "x receives no gradient through the covariance",
        {"m_bar = cov_bar @ m @ (Sigma + Sigma.transpose(0, 2, 1))": "m_bar = 0 * m"},
    ),
    edited(
        "projection",
        "projection-conic-not-inverted",
        "the conic is the covariance itself: it is not inverted",
        {
            "np.stack([c, -b, a], axis=1) / np.where(visible, det, 1)[:, None]": (
                "np.stack([a, b, c], axis=1)"
            ),
            "cov_bar -= K @ matrix_gradient(conic_bar, visible) @ K": (
                "cov_bar += matrix_gradient(conic_bar, visible)"
            ),
        },
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
    edited(
        "projection",
        "projection-off-diagonal-gradient",
        "the gradient of the covariance's off-diagonal entry counts one of its two places",
        {
            "cov_bar[:, 1, 0] = cov_bar[:, 0, 1]": (
                "cov_bar[:, 1, 0] = cov_bar[:, 0, 1] = cov_bar[:, 0, 1] / 2"
            ),
        },
    ),
]

MISTAKES = [*COVARIANCE, *CAMERAS, *FORMULAS]
