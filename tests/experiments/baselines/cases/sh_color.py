"""Cases of D2."""

import numpy as np

from tests.golden.cases import Case

C_0 = 0.5 / np.sqrt(np.pi)


def cases():
    rng = np.random.default_rng(22)
    d = rng.normal(size=(5, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    sh = 0.1 * rng.normal(size=(5, 3, 16))
    yield Case("ordinary", dict(d=d, sh=sh))
    for K in (1, 4, 9):
        n = 60 // (3 * K + 3)  # so few numbers that 60-digit arithmetic differentiates them
        yield Case(f"degree_{round(K**0.5) - 1}", dict(d=d[:n], sh=sh[:n, :, :K]), ("off",))
    yield Case("no_gaussians", dict(d=d[:0], sh=sh[:0]), ("empty",))
    yield Case("long_direction", dict(d=2 * d[:1], sh=0.05 * sh[:1]), ("normalise", "single"))
    for i, axis in enumerate("xyz"):
        along = (-1.0) ** i * np.eye(3)[[i]]
        yield Case(f"along_{axis}", dict(d=along, sh=sh[[i]]), ("zero", "single"))
    yield Case(
        "in_the_camera",  # Eq. (2) gives such a Gaussian the direction 0
        dict(d=np.zeros((1, 3)), sh=np.ones((1, 3, 16))),
        ("zero", "single"),
        expected={"color": np.full((1, 3), 0.5 + C_0)},
    )
    dark = np.zeros((1, 3, 4))
    dark[0, :, 0] = -2 / C_0, 0, 2 / C_0
    yield Case(
        "below_the_clamp",
        dict(d=np.array([[0.0, 0, 1]]), sh=dark),
        ("clamped", "negative"),
        cotangents={"color_bar": np.array([[1.0, 2, 3]])},
        expected={
            "color": np.array([[0.0, 0.5, 2.5]]),
            "sh_bar": np.array([[0.0, 2, 3]])[:, :, None]
            * np.array([C_0, 0, np.sqrt(3) * C_0, 0])[None, None],
        },
    )
    black = np.full((1, 3, 1), -0.5 / 0.28209479177387814)
    yield Case(
        "at_the_clamp",
        dict(d=np.array([[1.0, 0, 0]]), sh=black),
        ("kink",),
        smooth=False,
        cotangents={"color_bar": np.array([[1.0, -2, 3]])},
        expected={
            "color": np.zeros((1, 3)),
            "sh_bar": C_0 * np.array([[1.0, -2, 3]])[:, :, None],
            "d_bar": np.zeros((1, 3)),
        },
    )
