"""Cases of the covariance."""

import numpy as np

from p4dgs_ref.splatting.covariance import forward

from . import Case


def cases():
    rng = np.random.default_rng(31)
    s, r = rng.lognormal(-1, 0.7, size=(7, 3)), rng.normal(size=(7, 4))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    half = np.sqrt(0.5)  # a quarter turn about z carries the x axis to the y axis
    return [
        Case("ordinary", dict(s=s, r=r)),
        Case(
            "negative_scale", dict(s=-s, r=r), ("negative",), expected={"Sigma": forward(s, r)[0]}
        ),
        Case(
            "opposite_quaternion",
            dict(s=s, r=-r),
            ("normalise",),
            expected={"Sigma": forward(s, r)[0]},
        ),
        Case("zero_scale", dict(s=0 * s, r=r), ("zero",), expected={"Sigma": np.zeros((7, 3, 3))}),
        Case(
            "quarter_turn",
            dict(s=np.array([[3.0, 2.0, 1.0]]), r=np.array([[half, 0, 0, half]])),
            ("single",),
            expected={"Sigma": np.diag([4.0, 9.0, 1.0])[None]},
        ),
        Case("no_gaussians", dict(s=s[:0], r=r[:0]), ("empty",)),
        Case("needle", dict(s=np.array([[1e4, 1e-4, 1e-4]]), r=r[:1]), ("extreme",)),
    ]
