"""Cases of Eq. (11)."""

import math

import numpy as np

from . import Case


def cases():
    rng = np.random.default_rng(16)

    def row(z, w):
        z, w = (v.astype(float) for v in np.broadcast_arrays(np.atleast_2d(z), w))
        return dict(f_noisy=z, mu=np.zeros_like(z), sigma=np.ones_like(z), q=w)

    A, n = 5, 4
    sigma = rng.lognormal(size=(A, n))
    mu, q = rng.normal(size=(A, n)), sigma * rng.uniform(0.2, 3, size=(A, n))
    f_noisy = mu + sigma * rng.normal(size=(A, n))
    ordinary = dict(f_noisy=f_noisy, mu=mu, sigma=sigma, q=q)
    yield Case("ordinary", ordinary)
    yield Case("no_anchor", {name: a[:0] for name, a in ordinary.items()}, ("empty",))
    signed = np.array([6, -6, 9, -9, 20, -20, 40, -40, 1000, -1000])
    yield Case("tail", row(signed, 1), ("tail", "negative"))
    yield Case("tail_of_narrow_bins", row(signed, 1e-4), ("tail", "narrow"))
    yield Case(
        "narrow", row([0, 0.5, -1, 3], [[1e-12], [1e-9], [1e-6], [1e-3]]), ("narrow", "zero")
    )
    yield Case(
        "nearly_narrow", row([0, 0.5, -0.5, 1, -1], [[0.031], [0.0624], [0.12]]), ("narrow",)
    )  # a long series
    yield Case("wide", row([0, 0.5, -3, 10], 100), ("wide",), expected={"bits": np.zeros((1, 4))})
    yield Case("edge_of_a_wide_bin", row([50, -50, 49, 52], 100), ("wide", "negative"))
    # sigma of 2^-30 and 2^20: everything scales along, bit for bit
    yield Case("tiny_sigma", {name: a * 2.0**-30 for name, a in ordinary.items()}, ("extreme",))
    yield Case("huge_sigma", {name: a * 2.0**20 for name, a in ordinary.items()}, ("extreme",))
    p = math.erf(0.5 / math.sqrt(2))  # one bin of width sigma about mu
    yield Case(
        "centred",
        row([0], 1),
        ("zero", "single"),
        cotangents={"bits_bar": np.array([[-3.0]])},
        expected={
            "bits": np.array([[-math.log2(p)]]),
            "f_noisy_bar": np.zeros((1, 1)),
            "q_bar": np.array([[3 / math.log(2) * math.exp(-1 / 8) / math.sqrt(2 * math.pi) / p]]),
        },
    )
