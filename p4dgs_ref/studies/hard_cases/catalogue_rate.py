"""Hard cases of the rate model and the quantiser's equations: rows H-R1 to H-R7, H-Q1, H-Q2."""

import math

import numpy as np

from ...equations import anchor_rate, gaussian_bin, likelihood
from .entry import DTYPES, Entry, Measured, hard, number, relative

BITS = dict(value=(1e-12, 2e-6), grad=(1e-12, 2e-6))  # the figures of the project's likelihood
NARROW = 2.0**-13  # about 1e-4, and exact


def _bins(z, w, sigma=1.0):
    z, w = (np.atleast_2d(np.asarray(v, float)) for v in np.broadcast_arrays(z, w))
    return dict(f_noisy=sigma * z, mu=0 * z, sigma=sigma + 0 * z, q=sigma * w)


def _literal(name, index=(0, 0)):
    """Eq. (11) as printed, or its gradient by f under the case's cotangent."""

    def run(inputs):
        out, res = likelihood.literal(*(inputs[name] for name in ("f_noisy", "mu", "sigma", "q")))
        return (
            out.bits[index]
            if name == "bits"
            else likelihood.backward(res, inputs["bits_bar"])[name[:-4]][index]
        )

    return run


def rate_entries():
    """H-R1, H-R2, H-R3, H-R5: bits and slopes of single bins."""
    for z in (6, 9, 20, 40, 1000):
        inputs = _bins([z, -z, z, -z], [1, 1, NARROW, NARROW])
        yield hard(
            f"H-R1.{z}sigma",
            "likelihood",
            f"a bin {z} sigma from mu, on either side: both CDFs round to 0 or 1",
            inputs,
            ("bits", (0, 0)),
            _literal("bits"),
            ("tail", "narrow", "negative"),
            **BITS,
        )
        yield hard(
            f"H-R2.{z}sigma",
            "likelihood",
            f"the pull on a value {z} sigma away: 0/0 where the mass underflows",
            _bins([z, -z], [0.5, 0.5]),
            ("f_noisy_bar", (0, 0)),
            _literal("f_noisy_bar"),
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
            _literal("bits", (0, 2)),
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
            _literal("bits"),
            ("narrow" if w < 1 else "wide", "zero"),
            value=BITS["value"],
            grad=(1e-12 if w < 1e3 else 1e-9, 2e-6),
        )  # sigma's two terms, w / 2 each, leave 3


def floor_entries():
    """H-R3 predicted deviations, H-R4 steps that vanish, H-R6 grids of one sign."""
    raw = np.array([0.5, -14.0, 1.5, -14.5, -0.25, -1e4])  # groups of one: mu, raw of each
    yield hard(
        "H-R3.floor",
        "prior",
        "raw sigma on its clamp and far below: a sigma of 0 divides by 0",
        dict(h=np.zeros((1, 1)), weights=[np.zeros((1, 6))], biases=[raw], widths=(1, 1, 1)),
        ("sigma", (0, 2)),
        lambda inputs: np.exp(inputs["biases"][0][5]),
        ("clamped", "extreme"),
        smooth=False,
    )
    for u in (-10.0, -19.0, -100.0):
        flat = dict(
            h=np.zeros((1, 2)),
            weights=[np.zeros((2, 3))],
            biases=[np.array([u, 20.0, -2.5])],
            Q_0=np.array([1.0, 0.5, 2.0]),
        )
        yield hard(
            f"H-R4.u{u:g}",
            "step",
            f"psi_q = {u:g}: 1 + tanh is 0 and f/q infinite; ours stands on its floor of 2^-10",
            flat,
            ("q", (0, 0)),
            lambda inputs: 1 + np.tanh(inputs["biases"][0][0]),
            ("saturated", "clamped"),
        )
    for name, grids in (
        ("positive", [np.full((5, 2), 0.5)]),
        ("negative", [np.full((5, 2), -0.5)]),
        ("none", [np.zeros((0, 2))]),
    ):
        n = grids[0].size
        yield hard(
            f"H-R6.{name}",
            "hash_rate",
            f"a hash grid with {name} entries: 0 log 0, 0/0",
            dict(grids=grids),
            ("R_hash", ()),
            lambda inputs: _entropy_literal(inputs["grids"][0]),
            ("zero", "empty") if not n else ("zero",),
            smooth=False,
            expected={"R_hash": np.float64(0), "grids_bar": [0 * grids[0]]},
        )


def _entropy_literal(grid):
    n_pos, n = grid.dtype.type(np.count_nonzero(grid >= 0)), grid.dtype.type(grid.size)
    return -n_pos * np.log2(n_pos / n) - (n - n_pos) * np.log2((n - n_pos) / n)


def rounding_entries():
    """H-Q1, H-Q2: ties and what lies one ulp beside them."""
    ties = np.array([[-2.5, -1.5, -0.5, -0.0, 0.5, 1.5, 2.5]])
    even = np.array([[-2, -2, 0, 0, 0, 2, 2]])
    away = lambda inputs: np.trunc(inputs["f"][0, -1] / inputs["q"][0, 0] + 0.5)
    for q in (1.0, 0.25, 1024.0):
        yield hard(
            f"H-Q1.q{q:g}",
            "rounding",
            "ties; literal is C's round, which goes away from zero",
            dict(f=ties * q, q=np.array([[q]])),
            ("symbols", (0, 6)),
            away,
            ("tie", "negative"),
            expected={"symbols": even, "f_hat": even * q},
        )
    below, above = (
        np.nextafter(np.float32([0.5, 1.5, 2.5]), np.float32(to)).astype(float) for to in (0, 9)
    )
    yield hard(
        "H-Q2.beside_ties",
        "rounding",
        "one ulp of float32 beside ties; literal is floor(f/q + 1/2) in the precision given",
        dict(f=np.stack([below, above]), q=np.ones((2, 1))),
        ("symbols", (0, 0)),
        lambda inputs: np.floor(inputs["f"][0, 0] + inputs["f"].dtype.type(0.5)),
        ("tie",),
        expected={
            "symbols": np.array([[0, 1, 2], [1, 2, 3]]),
            "f_hat": np.array([[0.0, 1, 2], [1, 2, 3]]),
        },
    )


def _sum(dtype):
    """1e8 bits in the given precision: ours against the exact sum; literal adds one after the other, block by block."""
    row = (2 + np.sin(np.arange(100.0))).astype(DTYPES[dtype])
    many = np.broadcast_to(row, (10**6, 100))
    none = np.zeros((10**6, 3), row.dtype)
    out, _ = anchor_rate.forward(
        many, np.zeros((10**6, 0, 3), row.dtype), none, none, np.zeros((10**6, 0), bool)
    )
    total, block = row.dtype.type(0), np.tile(row, 10**4)
    for _ in range(100):
        total = np.add.accumulate(np.concatenate([[total], block]))[-1]
    true = 10**6 * math.fsum(row.tolist())
    few, res = anchor_rate.forward(
        many[:7], np.zeros((7, 0, 3), row.dtype), none[:7], none[:7], np.zeros((7, 0), bool)
    )
    slope = anchor_rate.backward(res, row.dtype.type(-1.5))["bits_f"]
    return Measured(
        float(total),
        float(out.R_anchor),
        true,
        abs(float(out.R_anchor) - true) / true,
        relative(slope, np.full((7, 100), -1.5), True),
        1e-11 if dtype == "float64" else 1.2e-7,
        0.0,
    )  # NumPy adds blocks one after the other


def _seams(dtype):
    """Where one formula of `gaussian_bin` hands over to another: the largest jump, relative, over neighbours 1e-13 apart."""
    places = [(z, gaussian_bin.NARROW / max(1, z)) for z in (0, 0.5, 2, 8, 1000)] + [
        (w / 2, w) for w in (0.05, 1, 100)
    ]
    places += [(gaussian_bin.FAR + w / 2, w) for w in (0.05, 1, 1e3)]
    worst = slope = literal = 0.0
    for z, w in places:
        near = 1 + 1e-13 * np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]])
        inputs = {
            name: a.astype(DTYPES[dtype]) for name, a in _bins(z * near[0], w * near[1]).items()
        }
        out, res = likelihood.forward(**inputs)
        g = likelihood.backward(res, np.ones_like(out.bits))["q"]
        with np.errstate(all="ignore"):
            printed = likelihood.literal(**inputs)[0].bits
            literal = np.fmax(literal, np.ptp(printed) / np.abs(printed).max())
        worst, slope = (
            max(worst, np.ptp(out.bits) / np.abs(out.bits).max()),
            max(slope, np.ptp(g) / np.abs(g).max()),
        )
    return Measured(
        number(literal),
        float(worst),
        0.0,
        float(worst),
        float(slope),
        1e-9 if dtype == "float64" else 2e-6,
        1e-9 if dtype == "float64" else 2e-6,
    )


def entries():
    yield from rate_entries()
    yield Entry(
        "H-R5.seams",
        "likelihood",
        "the switches between narrow, ordinary and far bins: no jump in value "
        "or slope; literal jumps as shown",
        _seams,
    )
    yield from floor_entries()
    yield Entry(
        "H-R7.sum",
        "anchor_rate",
        "1e8 bits added up; literal adds one after the other in the precision given",
        _sum,
    )
    yield from rounding_entries()
