"""Hard cases of the rate model and the quantiser's equations: rows H-R1 to H-R7, H-Q1, H-Q2."""

import numpy as np

from . import literals
from .entry import hard

BITS = dict(value=(1e-12, 2e-6), grad=(1e-12, 2e-6))  # what the project promises for Eq. (11)
NARROW = 2.0**-13  # about 1e-4, and exact


def _bins(z, w, sigma=1.0):
    """Inputs of Eq. (11) for bins of width w sigma, z sigma from the mean."""
    z, w = (np.atleast_2d(np.asarray(v, float)) for v in np.broadcast_arrays(z, w))
    return dict(f_noisy=sigma * z, mu=0 * z, sigma=sigma + 0 * z, q=sigma * w)


def rate_entries():
    """H-R1, H-R2, H-R3, H-R5: bits and slopes of single bins."""
    for z in (6, 9, 20, 40, 1000):
        yield hard(
            f"H-R1.{z}sigma",
            "likelihood",
            f"a bin {z} sigma from mu, on either side: a difference of CDFs close to 0 or 1",
            _bins([z, -z, z, -z], [1, 1, NARROW, NARROW]),
            ("bits", (0, 0)),
            literals.printed_bits,
            ("tail", "narrow", "negative"),
            **BITS,
        )
        yield hard(
            f"H-R2.{z}sigma",
            "likelihood",
            f"the gradient of a value {z} sigma away: 0/0 where the mass underflows",
            _bins([z, -z], [0.5, 0.5]),
            ("f_noisy_bar", (0, 0)),
            literals.printed_gradient,
            ("tail", "negative"),
            **BITS,
        )
    for power in (-30, -13, 0, 20):
        yield hard(
            f"H-R3.sigma2^{power}",
            "likelihood",
            f"sigma = 2^{power}, bins of a tenth to ten sigma",
            _bins([0.5, 3, -8], [0.1, 1, 10], 2.0**power),
            ("bits", (0, 2)),
            literals.printed_bits,
            ("extreme", "tail"),
            **BITS,
        )
    for w in (1e-12, 1e-9, 1e-6, 1e-3, 1.0, 10.0, 1e3, 1e6):
        yield hard(
            f"H-R5.width{w:g}",
            "likelihood",
            f"a bin of {w:g} sigma about mu: a difference of equal CDFs, or log 1",
            _bins([0, 0.25 if w < 40 else w / 2 - 3], w),
            ("bits", (0, 0)),
            literals.printed_bits,
            ("narrow" if w < 1 else "wide", "zero"),
            value=BITS["value"],
            # The two terms of sigma's gradient are w / 2 each and leave about 3 of each other.
            grad=(1e-12 if w < 1e3 else 1e-9, 2e-6),
        )


def floor_entries():
    """H-R3 predicted deviations, H-R4 steps that vanish, H-R6 grids of one sign."""
    raw = np.array([0.5, -14.0, 1.5, -14.5, -0.25, -1e4])  # groups of one: mu, raw of each
    yield hard(
        "H-R3.floor",
        "prior",
        "raw sigma on its clamp and far below: a sigma of 0 divides by 0",
        dict(h=np.zeros((1, 1)), weights=[np.zeros((1, 6))], biases=[raw], widths=(1, 1, 1)),
        ("sigma", (0, 2)),
        lambda v: np.exp(v["biases"][0][5]),
        ("clamped", "extreme"),
        smooth=False,
    )
    for u in (-10.0, -19.0, -100.0):
        yield hard(
            f"H-R4.u{u:g}",
            "step",
            f"psi_q = {u:g}: 1 + tanh is 0 and f/q infinite; ours is the floor of 2^-10 Q_0",
            dict(
                h=np.zeros((1, 2)),
                weights=[np.zeros((2, 3))],
                biases=[np.array([u, 20.0, -2.5])],
                Q_0=np.array([1.0, 0.5, 2.0]),
            ),
            ("q", (0, 0)),
            lambda v: 1 + np.tanh(v["biases"][0][0]),
            ("saturated", "clamped"),
        )
    for name, grids in (
        ("positive", [np.full((5, 2), 0.5)]),
        ("negative", [np.full((5, 2), -0.5)]),
        ("none", [np.zeros((0, 2))]),
    ):
        yield hard(
            f"H-R6.{name}",
            "hash_rate",
            f"signs of the entries of a hash grid: {name}; 0 log 0, 0/0",
            dict(grids=grids),
            ("R_hash", ()),
            literals.printed_entropy,
            ("zero",) if grids[0].size else ("zero", "empty"),
            smooth=False,
            expected={"R_hash": np.float64(0), "grids_bar": [0 * grids[0]]},
        )


def rounding_entries():
    """H-Q1, H-Q2: ties, and values one ulp beside them."""
    ties = np.array([[-2.5, -1.5, -0.5, -0.0, 0.5, 1.5, 2.5]])
    even = np.array([[-2, -2, 0, 0, 0, 2, 2]])
    for q in (1.0, 0.25, 1024.0):
        yield hard(
            f"H-Q1.q{q:g}",
            "rounding",
            "ties; literal is C's round, which rounds them away from zero",
            dict(f=ties * q, q=np.array([[q]])),
            ("symbols", (0, 6)),
            lambda v: np.trunc(v["f"][0, -1] / v["q"][0, 0] + 0.5),  # C's round
            ("tie", "negative"),
            expected={"symbols": even, "f_hat": even * q},
        )
    below, above = (
        np.nextafter(np.float32([0.5, 1.5, 2.5]), np.float32(to)).astype(float) for to in (0, 9)
    )
    symbols = np.array([[0, 1, 2], [1, 2, 3]])
    yield hard(
        "H-Q2.beside_ties",
        "rounding",
        "one ulp of float32 beside ties; literal is floor(f/q + 1/2) in the given precision",
        dict(f=np.stack([below, above]), q=np.ones((2, 1))),
        ("symbols", (0, 0)),
        lambda v: np.floor(v["f"][0, 0] + v["f"].dtype.type(0.5)),
        ("tie",),
        expected={"symbols": symbols, "f_hat": symbols.astype(float)},
    )


def entries():
    """All of them, in the order of the table."""
    yield from rate_entries()
    yield from floor_entries()
    yield from rounding_entries()
