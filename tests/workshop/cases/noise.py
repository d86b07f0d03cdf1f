"""Cases of Eq. (7)."""

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(12)
    f, u, q = rng.normal(size=(6, 5)), rng.random((6, 5)) - 0.5, rng.lognormal(size=(6, 1))
    return [
        Case("ordinary", dict(f=f, u=u, q=q)),
        Case("no_noise", dict(f=f, u=0 * u, q=q), ("zero",), expected={"f_noisy": f}),
        Case("tiny", dict(f=f * 1e-300, u=u, q=q * 1e-300), ("extreme",)),
        Case(
            "by_hand",
            dict(f=np.array([[1.0, 2.0]]), u=np.array([[-0.5, 0.25]]), q=np.array([[0.2]])),
            ("single",),
            cotangents={"f_noisy_bar": np.array([[3.0, -8.0]])},
            expected={"f_noisy": np.array([[0.9, 2.05]]), "q_bar": np.array([[-3.5]])},
        ),
    ]
