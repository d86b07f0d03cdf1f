"""Cases of the projection."""

import numpy as np

from . import Case


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
    to_world = (np.array([[9, 1, 2.0], [-9, 1, 2.0], [0.3, 9, 3.0]]) - base["T"]) @ rotation
    yield Case(
        "beyond_the_clamp",
        dict(x=to_world, Sigma=Sigma[:3], **base),
        ("clamped",),
    )
    yield Case("no_gaussians", dict(x=x[:0], Sigma=Sigma[:0], **base), ("empty",))
    # 1e4 px by 0.01 px at 40 degrees: the determinant after blur is 0.3 (1e8 + 1e-4) + 9e-2 + 1e4;
    # float32 gives 0
    turn = np.array([[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
    needle = (turn * np.array([1e8, 1e-4, 0.0])) @ turn.T
    plain = dict(
        W=np.eye(3),
        T=np.array([0, 0, 1.0]),
        focal=np.ones(2),
        center=np.zeros(2),
        size=np.array([9, 5]),
    )
    # on the axis m is the first two rows of the identity; the gradient of b is shared by both
    # off-diagonal entries
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
    # 1.3 * 64 / (2 * 32) and 1.3 * 48 / (2 * 24) are 1.3 in any order: x/z and y/z stand on the
    # ends of the clamp
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
