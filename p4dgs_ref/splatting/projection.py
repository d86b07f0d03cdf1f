r"""Support: EWA projection of 3D Gaussians to 2D splats: mean, covariance, conic and depth.

.. math:: \Sigma_{2D} = J W \Sigma W^T J^T + 0.3\,I, \qquad
    J = \begin{pmatrix} f_x/z & 0 & -f_x u/z \\ 0 & f_y/z & -f_y v/z \end{pmatrix},\quad
    u = \mathrm{clip}(x/z, \pm 1.3\,W/2f_x),\ v = \mathrm{clip}(y/z, \pm 1.3\,H/2f_y)
"""

from typing import NamedTuple

import numpy as np

from ..equations.equation import Case, declare


class Out(NamedTuple):
    mean2d: np.ndarray  # (N, 2) pixels
    cov2d: np.ndarray  # (N, 3) the numbers (a, b, c) of [[a, b], [b, c]], square pixels
    conic: np.ndarray  # (N, 3) the same of the inverse
    depth: np.ndarray  # (N,)   z in the camera, scene units
    visible: np.ndarray  # (N,)   bool; the other rows are zeros


class Res(NamedTuple):
    x_c: np.ndarray  # (N, 3) camera coordinates; (0, 0, 1) where culled
    uv: np.ndarray  # (N, 2) clamped x/z, y/z
    inside: np.ndarray  # (N, 2) bool: not beyond the clamp
    m: np.ndarray  # (N, 2, 3) J W
    Sigma: np.ndarray  # (N, 3, 3)
    conic: np.ndarray  # (N, 3)
    visible: np.ndarray
    W: np.ndarray
    focal: np.ndarray
    dtype: np.dtype


def forward(x, Sigma, W, T, focal, center, size, near=0.2, blur=0.3, tan_clamp=1.3):
    """Project Gaussians.

    Shapes     x (N, 3), Sigma (N, 3, 3), W (3, 3) and T (3,) world to camera, focal, center, size (2,) as x, y
               -> mean2d (N, 2), cov2d (N, 3), conic (N, 3), depth (N,), visible (N,)
    Units      x, T, depth: scene units; focal, center, mean2d: pixels; size: width and height in pixels
    Domain     Sigma symmetric; depth at or before `near`, a determinant that is not positive, any number that is none:
               culled, zeros.  A needle L pixels long has its conic to eps L^2 / blur, the gradient of x to its square
    Raises     nothing
    Gradient   x, Sigma (symmetric); clamp: 1 inside and on its ends, 0 outside, exact in x, y and z; culled rows 0
    Choice     Q20 pixel centres at integers; Q21 constants; the clamp is about the optical axis
    Reference  Zwicker et al. 2001; Kerbl et al. 2023; the inside is float64 because needles cancel in the determinant
    """
    dtype, inner = np.result_type(x), np.result_type(x, np.float64)
    W, focal, Sigma = (
        np.asarray(W, inner),
        np.asarray(focal, inner),
        Sigma.astype(inner, copy=False),
    )
    x_c = x @ W.T + np.asarray(T, inner)
    visible = (x_c[:, 2] > near) & np.isfinite(x_c).all(axis=1)
    x_c = np.where(visible[:, None], x_c, (0.0, 0.0, 1.0))
    z = x_c[:, 2:]
    ratio, limit = x_c[:, :2] / z, tan_clamp * np.asarray(size) / (2 * focal)
    uv = np.clip(ratio, -limit, limit)
    m = (W[None, :2] - uv[:, :, None] * W[2]) * (focal / z)[:, :, None]  # rows of J W
    mS = m @ Sigma
    a, c = (np.einsum("nij,nij->ni", mS, m) + blur).T
    b = (
        (mS[:, 0] * m[:, 1]).sum(axis=1) + (mS[:, 1] * m[:, 0]).sum(axis=1)
    ) / 2  # both off-diagonal entries
    with np.errstate(over="ignore", invalid="ignore"):  # beyond every image: culled below
        det = a * c - b * b
    visible &= (det > 0) & np.isfinite(det)
    det, Sigma = np.where(visible, det, 1), np.where(visible[:, None, None], Sigma, 0)
    conic = np.where(visible, np.stack([c, -b, a]) / det, 0).T
    outputs = [
        ratio * focal + np.asarray(center, inner),
        np.stack([a, b, c], axis=1),
        conic,
        z[:, 0],
    ]
    outputs = [
        np.where(visible if o.ndim == 1 else visible[:, None], o, 0).astype(dtype, copy=False)
        for o in outputs
    ]
    return Out(*outputs, visible), Res(
        x_c, uv, np.abs(ratio) <= limit, m, Sigma, conic, visible, W, focal, dtype
    )


def backward(res, mean2d_bar=None, cov2d_bar=None, conic_bar=None, depth_bar=None):
    keep = res.visible
    z, m = res.x_c[:, 2:], res.m
    D = np.zeros((len(z), 2, 2), z.dtype)  # gradient of [[a, b], [b, c]] as a symmetric matrix
    if conic_bar is not None:  # d(K) = -K d(cov) K; b stands for both off-diagonal entries
        A, B, C = res.conic.T
        K = np.stack([A, B, B, C], axis=1).reshape(-1, 2, 2)
        gA, gB, gC = conic_bar.T
        D -= K @ np.stack([gA, gB / 2, gB / 2, gC], axis=1).reshape(-1, 2, 2) @ K
    da, db, dc = D[:, 0, 0], 2 * D[:, 0, 1], D[:, 1, 1]
    if cov2d_bar is not None:
        da, db, dc = da + cov2d_bar[:, 0], db + cov2d_bar[:, 1], dc + cov2d_bar[:, 2]
    D[:, 0, 0], D[:, 1, 1] = np.where(keep, (da, dc), 0)
    D[:, 0, 1] = D[:, 1, 0] = np.where(keep, db / 2, 0)
    Sigma_bar = m.transpose(0, 2, 1) @ D @ m
    m_bar = D @ m @ (res.Sigma + res.Sigma.transpose(0, 2, 1))
    uv_bar = -(m_bar @ res.W[2]) * res.focal / z
    z_bar = -(m_bar * m).sum(axis=(1, 2))[:, None] / z  # m is proportional to 1/z
    ratio_bar = uv_bar * res.inside
    if mean2d_bar is not None:
        ratio_bar = ratio_bar + np.where(keep[:, None], mean2d_bar, 0) * res.focal
    z_bar -= (ratio_bar * res.x_c[:, :2]).sum(axis=1, keepdims=True) / z**2
    if depth_bar is not None:
        z_bar[:, 0] += np.where(keep, depth_bar, 0)
    x_bar = np.concatenate([ratio_bar / z, z_bar], axis=1) @ res.W
    return {
        "x": x_bar.astype(res.dtype, copy=False),
        "Sigma": Sigma_bar.astype(res.dtype, copy=False),
    }


def cases():
    rng = np.random.default_rng(32)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    L = rng.normal(size=(7, 3, 3)) * 0.3
    base = dict(
        W=rotation,
        T=np.array([0.1, -0.2, 4.0]),
        focal=np.array([80.0, 65.0]),
        center=np.array([30.2, 24.9]),
        size=np.array([64, 48]),
    )
    x, Sigma = rng.normal(size=(7, 3)) * 0.7, L @ L.transpose(0, 2, 1)
    yield Case("ordinary", dict(x=x, Sigma=Sigma, **base))
    to_world = lambda p: (np.asarray(p, float) - base["T"]) @ rotation
    straight = {
        **base,
        "W": np.eye(3),
        "T": np.zeros(3),
    }  # so that a depth of exactly 0.2 stays exactly 0.2
    yield Case(
        "behind",
        dict(x=np.array([[0, 0, -1.0], [0, 0, 0], [0, 0, 0.2]]), Sigma=Sigma[:3], **straight),
        ("behind",),
        smooth=False,
        cotangents={"mean2d_bar": rng.normal(size=(3, 2)), "conic_bar": rng.normal(size=(3, 3))},
        expected={
            "visible": np.zeros(3, bool),
            "depth": np.zeros(3),
            "x_bar": np.zeros((3, 3)),
            "Sigma_bar": np.zeros((3, 3, 3)),
        },
    )
    ahead = np.array([[0.1, 0, 0.25], [0.1, 0, -3.0], [0.4, 0.2, 1.0]])
    yield Case("one_behind", dict(x=ahead, Sigma=Sigma[:3], **straight), ("behind",))
    yield Case(
        "beyond_the_clamp",
        dict(x=to_world([[9, 1, 2.0], [-9, 1, 2.0], [0.3, 9, 3.0]]), Sigma=Sigma[:3], **base),
        ("clamped",),
    )
    yield Case("no_gaussians", dict(x=x[:0], Sigma=Sigma[:0], **base), ("empty",))
    # 1e4 px by 0.01 px at 40 degrees: the determinant after blur is 0.3 (1e8 + 1e-4) + 9e-2 + 1e4; float32 gives 0
    turn = np.array([[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
    needle = (turn * np.array([1e8, 1e-4, 0.0])) @ turn.T
    plain = dict(
        W=np.eye(3),
        T=np.array([0, 0, 1.0]),
        focal=np.ones(2),
        center=np.zeros(2),
        size=np.array([9, 5]),
    )
    # on the axis m is the first two rows of the identity; the gradient of b is shared by both off-diagonal entries
    yield Case(
        "zero_covariance",
        dict(x=np.zeros((1, 3)), Sigma=np.zeros((1, 3, 3)), **plain),
        ("zero", "single"),
        smooth=False,
        cotangents={"cov2d_bar": np.array([[2.0, 6, 5]])},
        expected={
            "cov2d": np.array([[0.3, 0, 0.3]]),
            "conic": np.array([[1 / 0.3, 0, 1 / 0.3]]),
            "Sigma_bar": np.array([[[2.0, 3, 0], [3, 5, 0], [0, 0, 0]]]),
        },
    )
    flat = np.array(
        [[1.0, 1, 0], [1, 1, 0], [0, 0, 0]]
    )  # of determinant 0: what is left is the blur, if it shows
    nothing = {
        "visible": np.zeros(1, bool),
        "conic": np.zeros((1, 3)),
        "cov2d": np.zeros((1, 3)),
        "Sigma_bar": np.zeros((1, 3, 3)),
    }
    for name, Sigma_at in (
        ("no_determinant", 2.0**60 * flat),
        ("infinite_determinant", 1e200 * np.eye(3)),
    ):
        yield Case(
            name,
            dict(x=np.zeros((1, 3)), Sigma=Sigma_at[None], **plain),
            ("extreme", "single"),
            smooth=False,
            cotangents={"conic_bar": np.array([[1.0, -2, 3]])},
            expected=nothing,
        )
    # 1.3 * 64 / (2 * 32) and 1.3 * 48 / (2 * 24) are 1.3 in any order: x/z and y/z stand on the ends of the clamp
    ends = {**plain, "T": np.zeros(3), "focal": np.array([32.0, 24.0]), "size": np.array([64, 48])}
    turned = {
        "mean2d_bar": np.zeros((1, 2)),
        "cov2d_bar": np.array([[1.0, 0, 0]]),
        "conic_bar": np.zeros((1, 3)),
        "depth_bar": np.zeros(1),
    }
    yield Case(
        "on_the_clamp",
        dict(x=np.array([[1.3, -1.3, 1.0]]), Sigma=np.eye(3)[None], **ends),
        ("kink", "clamped"),
        smooth=False,
        cotangents=turned,
        tolerance=1e-13,
        expected={"x_bar": 32**2 * np.array([[2 * 1.3, 0, -2 * (1 + 1.3**2) - 2 * 1.3**2]])},
    )
    yield Case(
        "needle",
        dict(x=np.zeros((1, 3)), Sigma=needle[None], **plain),
        ("extreme",),
        smooth=False,
        tolerance=1e-6,
        expected={"conic": _inverse_of_needle(1e8 + 0.3, 1e-4 + 0.3)},
    )


def _inverse_of_needle(long, short):
    c, s = np.cos(0.7), np.sin(0.7)  # from the eigenvalues: nothing cancels
    return np.array(
        [
            [
                c * c / long + s * s / short,
                c * s * (1 / long - 1 / short),
                s * s / long + c * c / short,
            ]
        ]
    )


projection = declare(
    "projection",
    "",
    "Sigma_2D = J W Sigma W^T J^T + 0.3 I",
    {
        "x": "N 3",
        "Sigma": "N 3 3",
        "W": "3 3",
        "T": "3",
        "focal": "2",
        "center": "2",
        "size": "2",
        "mean2d": "N 2",
        "cov2d": "N 3",
        "conic": "N 3",
        "depth": "N",
        "visible": "N",
    },
    ("x", "Sigma"),
    forward,
    backward,
    cases,
)
