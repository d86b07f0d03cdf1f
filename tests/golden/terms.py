"""Where a number's own terms are larger than varying the inputs shows: terms that cancel by a law, whatever the inputs.

The search measures the size S of terms by varying inputs (`promises`).  It cannot see that a gradient through a
normalised vector vanishes along it, or that rows of a rotation are orthogonal: both stay so for inputs that are varied.
Each function here takes inputs, cotangents and the measured sizes and returns the sizes of such terms.
"""

import numpy as np

from p4dgs_ref.equations import likelihood as likelihood_equation
from p4dgs_ref.equations import mlp
from p4dgs_ref.equations import rotation as rotation_equation
from p4dgs_ref.splatting import projection as projection_equation


def rotation(inputs, cotangents, S):
    """Behind the normalisation every layer sums products whose sum is nothing along r: their absolute values."""
    _, res = rotation_equation.forward(**inputs)
    r_bar = rotation_equation.normalise_backward(res.r, res.norm, cotangents["r_bar"])
    sizes = mlp.Res([np.abs(a) for a in res.mlp.inputs], [np.abs(W) for W in res.mlp.weights])
    gradients = mlp.backward(sizes, np.abs(r_bar).reshape(len(r_bar), -1))
    layers = {
        f"{name}_bar.{i}": a
        for name in ("weights", "biases")
        for i, a in enumerate(gradients[name])
    }
    seen = rotation_equation.split_view(gradients, res.d)
    return {**layers, **{name + "_bar": seen[name] for name in ("f_a", "delta_vc", "d_vc")}}


def likelihood(inputs, cotangents, S):
    """The gradient of sigma is one of z and one of w, which at the near edge of a wide bin leave little of each other."""
    g = likelihood_equation.backward(likelihood_equation.forward(**inputs)[1], **cotangents)
    moved = np.abs(g["f_noisy"] * (inputs["f_noisy"] - inputs["mu"])) + np.abs(g["q"] * inputs["q"])
    return {"sigma_bar": moved / inputs["sigma"]}


def ssim(inputs, cotangents, S):
    """1 - D_SSIM: of images without likeness the 1 is larger than what is left."""
    return {"ssim": np.ones(())}


def covariance(inputs, cotangents, S):
    """R comes with an error of eps in each entry, even where it is small: Sigma and gradients with |R| = 1 everywhere."""
    s = np.abs(inputs["s"])[:, None, :]
    Sigma = np.broadcast_to((s * s).sum(axis=2, keepdims=True), (len(s), 3, 3))
    Sigma_bar = np.abs(cotangents["Sigma_bar"])
    M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)).sum(axis=2, keepdims=True) * s
    return {
        "Sigma": Sigma,
        "s_bar": M_bar.sum(axis=1),
        "r_bar": np.repeat((M_bar * s).sum(axis=(1, 2))[:, None], 4, axis=1),
    }


def projection(inputs, cotangents, S):
    """Rows of J W vanish along the ray through the mean, and a c - b^2 of a needle cancels: both with absolute values."""
    out, res = projection_equation.forward(**inputs)
    z, square = res.x_c[:, 2:], lambda v: np.abs(v)[:, [[0, 1], [1, 2]]]  # (a, b, c) as a matrix
    m = (np.abs(res.W[:2]) + np.abs(res.uv)[:, :, None] * np.abs(res.W[2])) * (res.focal / z)[
        :, :, None
    ]
    mS = m @ np.abs(res.Sigma)
    cov = mS @ m.transpose(0, 2, 1) + 0.3
    a, b, c = out.cov2d.T
    det = np.where(out.visible, a * c - b * b, np.inf)
    lost = (cov[:, 0, 0] * cov[:, 1, 1] + cov[:, 0, 1] ** 2) / det
    K = cov[:, ::-1, ::-1] * (np.maximum(lost, 1) / det)[:, None, None]
    D = K @ square(cotangents["conic_bar"]) @ K + square(cotangents["cov2d_bar"])
    m_bar = 2 * D @ mS
    ratio_bar = (m_bar @ np.abs(res.W[2])) * res.focal / z + np.abs(
        cotangents["mean2d_bar"]
    ) * res.focal
    z_bar = (
        (m_bar * m).sum(axis=(1, 2)) + (ratio_bar * np.abs(res.x_c[:, :2])).sum(axis=1) / z[:, 0]
    ) / z[:, 0]
    x_bar = z_bar + ratio_bar.sum(axis=1) / z[:, 0] + np.abs(cotangents["depth_bar"])
    return {
        "cov2d": cov[:, [0, 0, 1], [0, 1, 1]],
        "conic": K[:, [0, 0, 1], [0, 1, 1]],
        "Sigma_bar": m.transpose(0, 2, 1) @ D @ m,
        "x_bar": np.repeat(x_bar[:, None], 3, axis=1),
    }
