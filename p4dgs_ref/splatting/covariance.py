r"""Support: the covariance of a Gaussian from its scale and its quaternion, as 3DGS parametrises it.

.. math:: \Sigma = R\,S\,S^T R^T, \qquad S = \mathrm{diag}(s)
"""

from typing import NamedTuple

import numpy as np

from ..equations.equation import Case, declare


class Out(NamedTuple):
    Sigma: np.ndarray  # (N, 3, 3) symmetric


class Res(NamedTuple):
    M: np.ndarray  # (N, 3, 3)  R S, so that Sigma = M M^T
    R: np.ndarray  # (N, 3, 3)
    s: np.ndarray  # (N, 3)     the untouched input
    r: np.ndarray  # (N, 4)     the untouched input


def rotation_matrix(r):
    """The printed matrix of a quaternion r = (w, x, y, z), which must be of unit length: (N, 4) -> (N, 3, 3)."""
    w, x, y, z = r.T
    R = np.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ],
        axis=1,
    )
    return R.reshape(-1, 3, 3)


def forward(s, r):
    """Build covariances.

    Shapes     s (N, 3), r (N, 4) as (w, x, y, z) -> Sigma (N, 3, 3)
    Units      s: scene units; Sigma: square scene units
    Domain     r of unit length (it is not normalised here); s any real, its sign cancels
    Raises     nothing
    Gradient   s, r: plain derivative of the printed matrix, not projected on the unit sphere
    Choice     Q9: Sigma depends on s'^2 only, so s' may be zero or negative
    Reference  Kerbl et al. 2023, Eq. (6); used by P-4DGS without a number
    """
    R = rotation_matrix(r)
    M = R * s[:, None, :]
    return Out(M @ M.transpose(0, 2, 1)), Res(M, R, s, r)


def backward(res, Sigma_bar):
    M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ res.M  # both factors of M M^T
    s_bar = (M_bar * res.R).sum(axis=1)
    R_bar = M_bar * res.s[:, None, :]
    w, x, y, z = res.r.T
    (a, b, c), (d, e, f), (g, h, i) = R_bar.transpose(1, 2, 0)
    r_bar = 2 * np.stack(
        [
            z * (d - b) + y * (c - g) + x * (h - f),
            y * (b + d) + z * (c + g) + w * (h - f) - 2 * x * (e + i),
            x * (b + d) + z * (f + h) + w * (c - g) - 2 * y * (a + i),
            x * (c + g) + y * (f + h) + w * (d - b) - 2 * z * (a + e),
        ],
        axis=1,
    )
    return {"s": s_bar, "r": r_bar}


def cases():
    rng = np.random.default_rng(31)
    s, r = rng.lognormal(-1, 0.7, size=(7, 3)), rng.normal(size=(7, 4))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    yield Case("ordinary", dict(s=s, r=r))
    yield Case(
        "negative_scale", dict(s=-s, r=r), ("negative",), expected={"Sigma": forward(s, r)[0].Sigma}
    )
    yield Case(
        "opposite_quaternion",
        dict(s=s, r=-r),
        ("normalise",),
        expected={"Sigma": forward(s, r)[0].Sigma},
    )
    yield Case("zero_scale", dict(s=0 * s, r=r), ("zero",), expected={"Sigma": np.zeros((7, 3, 3))})
    half = np.sqrt(0.5)  # a quarter turn about z carries the x axis to the y axis
    yield Case(
        "quarter_turn",
        dict(s=np.array([[3.0, 2.0, 1.0]]), r=np.array([[half, 0, 0, half]])),
        ("single",),
        expected={"Sigma": np.diag([4.0, 9.0, 1.0])[None]},
    )
    yield Case("no_gaussians", dict(s=s[:0], r=r[:0]), ("empty",))
    yield Case("needle", dict(s=np.array([[1e4, 1e-4, 1e-4]]), r=r[:1]), ("extreme",))


covariance = declare(
    "covariance",
    "",
    "Sigma = R(r) diag(s)^2 R(r)^T",
    {"s": "N 3", "r": "N 4", "Sigma": "N 3 3"},
    ("s", "r"),
    forward,
    backward,
    cases,
)
