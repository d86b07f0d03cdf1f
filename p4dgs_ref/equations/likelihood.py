r"""Eq. (11): the bits that a value costs under its predicted Gaussian.

.. math:: b = -\log_2\Bigl[\Phi\Bigl(\frac{\tilde f + q/2 - \mu}{\sigma}\Bigr)
                         - \Phi\Bigl(\frac{\tilde f - q/2 - \mu}{\sigma}\Bigr)\Bigr]
"""

import math
from typing import NamedTuple

import numpy as np

from . import gaussian_bin
from .equation import Case, declare


class Out(NamedTuple):
    bits: np.ndarray  # (A, n)


class Res(NamedTuple):
    f_slope: np.ndarray  # (A, n) d bits / d f_noisy; that of mu is its negative
    sigma_slope: np.ndarray  # (A, n)
    q_slope: np.ndarray  # (A, n)


def forward(f_noisy, mu, sigma, q, log_mass=gaussian_bin.stable):
    """Rate every value.

    Shapes     f_noisy, mu, sigma, q (A, n) -> bits (A, n); no broadcasting
    Units      f_noisy, mu, sigma, q: units of the attribute; bits: bits
    Domain     sigma > 0, q > 0; accurate for |f_noisy - mu| <= 1000 sigma, 1e-12 <= q / sigma <= 1e6
    Raises     ValueError naming the first sigma or q that is not positive
    Gradient   f_noisy, mu, sigma, q; smooth everywhere, finite however far the tail
    Choice     no floor under the mass; HAC's (19.93 bits, no gradient beyond) is the rung `hac`
    Reference  P-4DGS Eq. (11)
    """
    for name, a in (("sigma", sigma), ("q", q)):
        if a.min(initial=1) <= 0:
            index = np.argwhere(a <= 0)[0].tolist()
            raise ValueError(f"{name}{index} is {a[tuple(index)]}: expected a positive number")
    b = log_mass(f_noisy, mu, sigma, q)
    per_unit = -1 / (
        math.log(2) * sigma
    )  # from slopes of log p in z and w to bits per attribute unit
    slopes = (
        b.slope_z,
        -(b.z * b.slope_z + b.w * b.slope_w),
        b.slope_w,
    )  # sigma scales both z and w
    bits = b.log_p * (-1 / math.log(2)) + 0.0  # adding 0 turns -0 into 0
    dtype = f_noisy.dtype
    return Out(bits.astype(dtype, copy=False)), Res(
        *((per_unit * s).astype(dtype, copy=False) for s in slopes)
    )


def backward(res, bits_bar):
    f_bar = bits_bar * res.f_slope
    return {
        "f_noisy": f_bar,
        "mu": -f_bar,
        "sigma": bits_bar * res.sigma_slope,
        "q": bits_bar * res.q_slope,
    }


def literal(f_noisy, mu, sigma, q):
    """Rung: the printed difference, wrong in the tails and for narrow bins."""
    with np.errstate(invalid="ignore"):  # infinite slopes of infinite bits: inf - inf
        return forward(f_noisy, mu, sigma, q, gaussian_bin.literal)


def hac(f_noisy, mu, sigma, q):
    """Rung: the printed difference under HAC's floor of 1e-6."""
    return forward(f_noisy, mu, sigma, q, gaussian_bin.hac)


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


likelihood = declare(
    "likelihood",
    "11",
    "bits = -log2(Phi((f_noisy + q/2 - mu) / sigma) - Phi((f_noisy - q/2 - mu) / sigma))",
    {"f_noisy": "A n", "mu": "A n", "sigma": "A n", "q": "A n", "bits": "A n"},
    ("f_noisy", "mu", "sigma", "q"),
    forward,
    backward,
    cases,
    rungs={"stable": forward, "literal": literal, "hac": hac},
)
