"""Sizes of terms that varying the inputs does not show, because they cancel by a law.

The search measures the size S of terms by varying inputs (see `promises`). It cannot see that the
gradient through a normalised vector vanishes along that vector, or that the rows of a rotation are
orthogonal, because both stay true when the inputs vary. Each function here takes inputs and
cotangents and returns the sizes of such terms.
"""

import numpy as np

from p4dgs_ref.equations import anchor_network
from p4dgs_ref.equations import likelihood as likelihood_equation
from p4dgs_ref.equations import rotation as rotation_equation
from p4dgs_ref.equations.numerics import normalise_backward
from p4dgs_ref.splatting import projection as projection_equation

BLUR, TAN_CLAMP = 0.3, 1.3


def rotation(inputs, cotangents):
    """Sums of absolute values for the layers before the normalisation.

    Each layer sums products whose sum along r is zero.
    """
    _, (r, norm, (saved_mlp, d)) = rotation_equation.forward(**inputs)
    layer_inputs, weights = saved_mlp
    sizes = [np.abs(a) for a in layer_inputs], [np.abs(W) for W in weights]
    psi_bar = np.abs(normalise_backward(r, norm, cotangents["r_bar"]))
    gradients = anchor_network.backward((sizes, d), psi_bar)
    found = {name + "_bar": gradients[name] for name in ("f_a", "delta_vc", "d_vc")}
    for name in ("weights", "biases"):
        found.update({f"{name}_bar.{i}": a for i, a in enumerate(gradients[name])})
    return found


def likelihood(inputs, cotangents):
    """The gradient of sigma is the sum of one through z and one through w.

    At the near edge of a wide bin they leave little of each other.
    """
    _, saved = likelihood_equation.forward(**inputs)
    gradients = likelihood_equation.backward(saved, **cotangents)
    through_z = np.abs(gradients["f_noisy"] * (inputs["f_noisy"] - inputs["mu"]))
    through_w = np.abs(gradients["q"] * inputs["q"])
    return {"sigma_bar": (through_z + through_w) / inputs["sigma"]}


def ssim(inputs, cotangents):
    """SSIM is computed as 1 - D_SSIM, so the size of its terms is at least 1."""
    return {"ssim": np.ones(())}


def covariance(inputs, cotangents):
    """Each entry of R has an error of eps, even a small one: everything with |R| = 1."""
    s = np.abs(inputs["s"])[:, None, :]
    Sigma = np.broadcast_to((s * s).sum(axis=2, keepdims=True), (len(s), 3, 3))
    Sigma_bar = np.abs(cotangents["Sigma_bar"])
    M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)).sum(axis=2, keepdims=True) * s
    return {
        "Sigma": Sigma,
        "s_bar": M_bar.sum(axis=1),
        "r_bar": np.repeat((M_bar * s).sum(axis=(1, 2))[:, None], 4, axis=1),
    }


def projection(inputs, cotangents):
    """The rows of J W cancel along the ray through the mean, and a c - b^2 of a needle cancels.

    Both are computed here with absolute values.
    """

    def square(v):
        """(a, b, c) as matrices of absolute values."""
        return np.abs(v)[:, [[0, 1], [1, 2]]]

    outputs, saved = projection_equation.forward(**inputs)
    _, cov2d, _, _, visible = outputs
    x_c, *_, Sigma, _, _, W, focal, _ = saved
    z = x_c[:, 2:]
    limit = TAN_CLAMP * inputs["size"] / (2 * focal)
    uv = np.clip(x_c[:, :2] / z, -limit, limit)
    rows = np.abs(W[:2]) + np.abs(uv)[:, :, None] * np.abs(W[2])
    m = rows * (focal / z)[:, :, None]
    mS = m @ np.abs(Sigma)
    cov = mS @ m.transpose(0, 2, 1) + BLUR
    a, b, c = cov2d.T
    det = np.where(visible, a * c - b * b, np.inf)
    lost = (cov[:, 0, 0] * cov[:, 1, 1] + cov[:, 0, 1] ** 2) / det
    K = cov[:, ::-1, ::-1] * (np.maximum(lost, 1) / det)[:, None, None]
    D = K @ square(cotangents["conic_bar"]) @ K + square(cotangents["cov2d_bar"])
    m_bar = 2 * D @ mS
    ratio_bar = (m_bar @ np.abs(W[2])) * focal / z + np.abs(cotangents["mean2d_bar"]) * focal
    through_ratio = (ratio_bar * np.abs(x_c[:, :2])).sum(axis=1) / z[:, 0]
    z_bar = ((m_bar * m).sum(axis=(1, 2)) + through_ratio) / z[:, 0]
    x_bar = z_bar + ratio_bar.sum(axis=1) / z[:, 0] + np.abs(cotangents["depth_bar"])
    return {
        "cov2d": cov[:, [0, 0, 1], [0, 1, 1]],
        "conic": K[:, [0, 0, 1], [0, 1, 1]],
        "Sigma_bar": m.transpose(0, 2, 1) @ D @ m,
        "x_bar": np.repeat(x_bar[:, None], 3, axis=1),
    }
