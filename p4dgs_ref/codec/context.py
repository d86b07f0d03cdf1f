"""From the bytes of a file to how each of its symbols is coded, in integers: the context of P-4DGS Fig. 2.

FORMAT.  Nothing here is a floating-point result: whole numbers below 2^53, and IEEE doubles that happen to be whole.

1. Hash feature.  n is a coordinate of the position, 0 ... 65535; a level of resolution R has
       base = floor(n (R - 1) / 65535)         t = n (R - 1) - 65535 base
   and per axis the weight 65535 - t for the corner base and t for base + 1 (on the last node, t = 0 and the corner
   does not matter).  Products over the D axes, times the signs of the entries, add up to a whole number v with
   |v| <= 65535^D < 2^48.  h = floor((v + floor(Q / 2)) / Q), Q = floor(65535^D / 2^15): |h| <= 2^15, units 2^-15.
   A corner has a coordinate per axis of the level, in the order of its name, each at most R - 1: it reads node
   i + j R (+ k R^2) where R^D <= T, else (i XOR 2654435761 j (XOR 805459861 k)) mod T, products modulo 2^32 (in
   JavaScript Math.imul, and >>> 0 before mod).  h runs level by level, F numbers each.
2. Networks.  psi_q and psi_p on h as `fixed_point.py` says.
   "y in units of 2^-c" below is floor((y + 2^(a-c-1)) / 2^(a-c)) for a > c, else y 2^(c-a); clip before it overflows.
3. Steps.  u = psi_q's output in units of 2^-12, clipped to +-2^15;  v = clip(u + 4 * 2^12, 0, 10 * 2^12 - 1);
   i = floor(v / 64), r = v mod 64;  share = sigmoid[i] + floor((sigmoid[i+1] - sigmoid[i]) r / 64)    (units 2^-24)
       q_units = clip(floor((share + 128) / 256), 32, 65536)           q = q_units Q_0 2^-15, the one product of doubles
4. One over q.  Q_0 = f 2^p with 1/2 <= f < 1;  D = floor(2^24 f) q_units;  n = bits of D - 24;
       R = floor(2^47 / floor(D / 2^n)),  so that 1/q is about R 2^(-8 - p - n)
5. Means.  y = psi_p's mu, still in units of 2^-a;  t = max(0, bits of B - 28), B the bound of all psi_p's outputs;
       m = floor((y + floor(2^t / 2)) / 2^t);          S = a - t + p + n - 2, of any sign;
       mu_units = floor(m R 2^-S + 1/2), clipped to +-2^34;  |m R| <= 2^52, so it is 0 for S > 53
6. Deviations.  raw in units of 2^-16, clipped to [-14, 6];  l = floor((94548 raw + 2^15) / 2^16);
       sigma_units = clip(floor((l - log2(D) - (p - 39) 2^16 + 2^11) / 2^12), -128, 319)
   log2(D) = (n + 23) 2^16 + log2[i] + floor((log2[i+1] - log2[i]) r / 2^15)  in units of 2^-16,
       where floor(D / 2^n) - 2^23 = 2^15 i + r, 0 <= r < 2^15
p, n, D and R of 4 are those of the column's group in 5 and 6 (D of 1 counts axes); "bits of" a whole number is how many
binary digits it has, 0 for 0.

WORKED NUMBERS.  Level xy, R = 3, T = 9, an anchor at (20000, 50000, .): base (0, 1), t (40000, 34465), nodes 3, 4, 6, 7
with weights 793372450, 1242800000, 880063775, 1378600000.  Signs + - - + add up to v = 49108675; Q = 131068, h = 375.
The network of `fixed_point.py` has y = 456327168, a = 30, B = 966393856.  As psi_q: u = 1741, v = 18125, i = 283, r = 13,
share = 11753797, q_units = 45913, and with Q_0 = 0.1 q = 0.1401153564453125.  Then f = 0.8, p = -3, D = 13421772 *
45913 = 616233817836, n = 16, R = floor(2^47 / 9402981) = 14967326.  As mu: t = 2, m = 114081792, S = 39, mu_units = 3106.
raw = -3.5, -229376 in units of 2^-16: l = -330918, i = 30, r = 31333, log2(D) = 2566696, sigma_units = -35.
"""

from typing import NamedTuple

import numpy as np

from ..equations.grid_nodes import entries
from ..equations.prior import RAW_MAX, RAW_MIN, layout
from ..model import LATTICE
from .fixed_point import (
    INPUT_BITS,
    bit_length,
    halve,
    log2,
    rescale,
    run_network,
    table,
    whole_layers,
)
from .gaussian_table import MU_BITS, MU_LIMIT, SIGMA_BITS, SIGMA_MAX, SIGMA_MIN

STEP_FLOOR, STEP_MAX = 32, 2**16  # q in units of 2 Q_0 / 2^16; the floor of Q7 is 2^-10 Q_0
LOG2_E = 94548  # log2(e) in units of 2^-16
CHUNK = 2**18  # numbers of one array on the way, so that memory does not grow with the anchors


class CodingContext(NamedTuple):
    q: np.ndarray  # (A, 4) float64, the steps of f, s, l, O: the same double everywhere
    mu_units: np.ndarray  # (A, n) int64, mu / q in units of 2^-MU_BITS; columns as `model.join`
    sigma_units: np.ndarray  # (A, n) int32, log2(sigma / q) in units of 2^-SIGMA_BITS


def hash_feature(positions, grids, design):
    """h of every anchor, whole numbers in float64, units 2^-15: positions int64 (A, 3) -> (A, L F)."""
    features = []
    for (axes, res), grid in zip(design.grid, grids):
        place = positions[:, ["xyz".index(axis) for axis in axes]] * (res - 1)
        base, t = place // LATTICE, (place % LATTICE).astype(float)
        corner = (
            np.array(np.meshgrid(*[[0, 1]] * len(axes), indexing="ij")).reshape(len(axes), -1).T
        )
        weight = np.where(corner, t[:, None, :], LATTICE - t[:, None, :]).prod(axis=2)  # below 2^48
        signs = grid.take(entries(base, corner, res, len(grid)), axis=0)  # (A, 2^D, F)
        v = np.einsum("ac,acf->af", weight, signs).astype(
            np.int64
        )  # exact in any order: sums of whole numbers
        unit = LATTICE ** len(axes) >> INPUT_BITS
        features.append((v + unit // 2) // unit)
    return np.concatenate(features, axis=1).astype(float)


def step_units(h, psi_q):
    """q_units (A, 4) int64."""
    steps = table("sigmoid")
    v = np.clip(
        rescale(run_network(h, psi_q), psi_q[-1].bits, 12, 2**15) + (4 << 12), 0, (10 << 12) - 1
    )
    i, r = v >> 6, v & 63
    share = steps[i] + ((steps[i + 1] - steps[i]) * r >> 6)
    return np.clip(share + 128 >> 8, STEP_FLOOR, STEP_MAX)


def shift(values, S):
    """values 2^-S rounded to nearest, ties up, clipped to +-MU_LIMIT; |values| <= 2^52, S of any sign."""
    right, left = np.clip(S, 0, 62), np.clip(-S, 0, 28)
    rounded = (values + (1 << right >> 1)) >> right
    return np.clip(np.clip(rounded, -MU_LIMIT, MU_LIMIT) << left, -MU_LIMIT, MU_LIMIT)


def coding_context(design, networks, grids, positions):
    """Steps, means and deviations of every coded attribute as the coder uses them.

    Shapes     positions (A, 3) int64 symbols of the 16-bit lattice; grids: levels (T, F) of +-1
    Domain     networks hold float16 numbers, Q_0 within the header's range
    Choice     Q6 one step per group; Q7 its floor; Q8 the clamp of sigma; Q11 the grid
    Reference  P-4DGS Eqs. (8), (9), (12); the integers are this project's
    """
    psi_q, psi_p = (whole_layers(*networks[name]) for name in ("psi_q", "psi_p"))
    A, n = len(positions), sum(design.widths)
    ctx = CodingContext(np.empty((A, 4)), np.empty((A, n), np.int64), np.empty((A, n), np.int32))
    rows = CHUNK // max(len(design.grid) * design.F, 8 * max(design.F, 3), *design.context, 2 * n)
    for a in range(0, A, rows):
        h = hash_feature(positions[a : a + rows], grids, design)
        for whole, part in zip(ctx, _context_of(h, psi_q, psi_p, design)):
            whole[a : a + rows] = part
    return ctx


def _context_of(h, psi_q, psi_p, design):
    """Steps 3 to 6: q, mu_units and sigma_units of some anchors."""
    q_units = step_units(h, psi_q)
    fraction, p = np.frexp(np.array(design.Q_0))
    D = np.floor(fraction * 2.0**24).astype(np.int64) * q_units  # (A, 4), 28 to 41 bits
    n = bit_length(D) - 24
    R = 2**47 // (D >> n)
    log2_q = log2(D) + ((p.astype(np.int64) - 39) << 16)
    spread = np.repeat(np.arange(4), design.widths)  # group of every column
    y, (mu_columns, raw_columns), bits = (
        run_network(h, psi_p),
        layout(design.widths),
        psi_p[-1].bits,
    )
    t = max(0, psi_p[-1].bound.bit_length() - 28)
    m = halve(y[:, mu_columns], t).astype(np.int64)
    S = bits - t + p.astype(np.int64) + n - (MU_BITS - 8)
    mu_units = shift(m * R[:, spread], S[:, spread])
    raw = np.clip(
        rescale(y[:, raw_columns], bits, 16, 2**24), int(RAW_MIN) << 16, int(RAW_MAX) << 16
    )
    log2_sigma = raw * LOG2_E + 2**15 >> 16
    sigma_units = (log2_sigma - log2_q[:, spread] + (1 << 15 - SIGMA_BITS)) >> 16 - SIGMA_BITS
    return (
        q_units * (np.array(design.Q_0) * 2.0**-15),
        mu_units,
        np.clip(sigma_units, SIGMA_MIN, SIGMA_MAX),
    )
