"""The coding context: how every symbol is coded, computed in integers from positions and networks.

P-4DGS predicts for every anchor the step, mean and deviation of its attributes (its Fig. 2).
Encoder and decoder must agree on these to the last bit, so they are computed without a single
rounded floating-point result: all numbers are integers below 2^53, or IEEE doubles that are such
integers.

Three conventions are used below. An output y of a network is an integer in units of 2^-a. "The
output in units of 2^-c" is floor((y + 2^(a-c-1)) / 2^(a-c)) if a > c, and y 2^(c-a) otherwise; a
port clips before this multiplication overflows. clip(v, low, high) is v, at least low, at most
high. "Bits of" an integer is the number of its binary digits, 0 for 0.

NETWORKS give the same outputs on every machine and in any order of summation. A number is
represented by an integer n and a number of fractional bits a; its value is n times 2^-a. The
fractional bits of a layer follow from its weights alone, never from the data.

a. Input. The input x of a network is a vector of integers with |x| <= X = 2^15 and a = 15.

b. Layer. The weights W (I rows, J columns) and biases b (J) are the float16 numbers of the file.
   With

       p   = the least integer with max |W| < 2^p      (0 if all are zero)
       p_b = the least integer with max |b| < 2^p_b    (0 if all are zero)
       n   = min(15 - p, 50 - p_b - a, 24)

   they become integers, and the layer is computed in integers:

       W' = W 2^n         rounded to the nearest integer, ties to even;  |W'| < 2^15
       b' = b 2^(a + n)   rounded in the same way;                       |b'| <= 2^50
       y  = x W' + b'     in units of 2^-(a + n)

   Every output and every partial sum is bounded by

       B = X max_j sum_i |W'_ij| + max_j |b'_j|.

   Because I <= 2^14 and X <= 2^22, B is below 2^52. A float64, and therefore a JavaScript number,
   represents every partial sum exactly, so the products may be added in any order, with or without
   fused multiply-add.

c. Hidden layer. Let s = max(0, bits of B - 22). The input of the next layer is

       x = max(0, floor((y + floor(2^s / 2)) / 2^s))

   with a + n - s fractional bits and the bound X = floor((B + floor(2^s / 2)) / 2^s).

d. Last layer. Its output is y itself, with a + n fractional bits and the bound B.

Any of n, a and a + n may be negative.

Worked example of a network. x = (16384, -8192), W = (0.5, -0.3)^T and b = (0.1); in float16, -0.3
is -0.300048828125 and 0.1 is 0.0999755859375.

    p = 0, p_b = -3, n = min(15, 38, 24) = 15, W' = (16384, -9832)^T, b' = 107347968
    y = 456327168 in units of 2^-30, which is 0.42499
    B = 2^15 (16384 + 9832) + 107347968 = 966393856
    as a hidden layer: s = 8, x = 1782528, a = 22, X = 3774976

THE CONTEXT of an anchor follows from its position and the two networks.

1. Hash feature. Let n be one coordinate of the position, 0 to 65535. A level of resolution R has
   along that axis

       base = floor(n (R - 1) / 65535)         t = n (R - 1) - 65535 base

   and the weights 65535 - t for the corner at base and t for the corner at base + 1. On the last
   node t is 0, and the second corner does not matter. The weight of a corner of the cell is the
   product of its weights along the D axes of the level. The sum of weight times sign over the 2^D
   corners is an integer v with |v| <= 65535^D < 2^48, and the feature is

       h = floor((v + floor(Q / 2)) / Q)       Q = floor(65535^D / 2^15)

   in units of 2^-15, so |h| <= 2^15. A corner has one coordinate per axis, in the order of the axes
   in the level's name, each at most R - 1. The corner (i, j, k) reads node i + j R + k R^2 if
   R^D is at most the level's number of nodes T, and node

       (i XOR 2654435761 j XOR 805459861 k) mod T

   otherwise, with products modulo 2^32 (in JavaScript Math.imul, and >>> 0 before mod). A level of
   two axes has no k. The features of an anchor are ordered level by level, F numbers each.

2. Networks. psi_q and psi_p are evaluated on h as described under NETWORKS.

3. Steps. For each of the four outputs of psi_q:

       u = the output in units of 2^-12, clipped to +-2^15
       v = clip(u + 4 * 2^12, 0, 10 * 2^12 - 1)        i = floor(v / 64)        r = v mod 64
       share = sigmoid[i] + floor((sigmoid[i+1] - sigmoid[i]) r / 64)           in units of 2^-24
       q_units = clip(floor((share + 128) / 256), 32, 65536)
       q = q_units (Q_0 2^-15)

   Q_0 is the base step of the group. The last line is the only product of doubles that is rounded.

4. Reciprocal of the step. Q_0 = f 2^p with 1/2 <= f < 1.

       D = floor(2^24 f) q_units         n = bits of D - 24         R = floor(2^47 / floor(D / 2^n))

   Then 1/q is about R 2^(-8 - p - n). This D and R are not those of part 1.

5. Means. For an output y of psi_p that is a mean, in units of 2^-a, with B the bound of the outputs
   of psi_p and p, n and R those of the group:

       t = max(0, bits of B - 28)        m = floor((y + floor(2^t / 2)) / 2^t)
       S = a - t + p + n - 2             (of either sign)
       mu_units = floor(m R 2^-S + 1/2)  clipped to +-2^34

   Because |m R| <= 2^52, mu_units is 0 for S > 53.

6. Deviations. For an output of psi_p that is the logarithm of a deviation (raw), with p, n and D
   those of the group:

       raw = the output in units of 2^-16, clipped to [-14 * 2^16, 6 * 2^16]
       log2_sigma = floor((94548 raw + 2^15) / 2^16)         (94548 is log2(e) in units of 2^-16)
       floor(D / 2^n) - 2^23 = 2^15 i + r                    0 <= r < 2^15
       log2_D = (n + 23) 2^16 + log2[i] + floor((log2[i+1] - log2[i]) r / 2^15)
       sigma_units = clip(floor((log2_sigma - log2_D - (p - 39) 2^16 + 2^11) / 2^12), -128, 319)

The columns of an anchor are ordered f, s, l, O; `file.py` gives the outputs of psi_p and psi_q.

Worked example of a context. A level "xy" with R = 3 and T = 9, an anchor at (20000, 50000, any):

    base = (0, 1)     t = (40000, 34465)
    nodes             3            4             6            7
    weights           793372450    1242800000    880063775    1378600000
    signs             +            -             -            +
    v = 49108675      Q = 131068   h = 375

The network above has the output y = 456327168 with a = 30 and B = 966393856.

    as an output of psi_q    u = 1741, v = 18125, i = 283, r = 13, share = 11753797,
                             q_units = 45913; with Q_0 = 0.1, q = 0.1401153564453125
    1 / q                    f = 0.8, p = -3, D = 13421772 * 45913 = 616233817836, n = 16,
                             R = floor(2^47 / 9402981) = 14967326
    as a mean                t = 2, m = 114081792, S = 39, mu_units = 3106

A raw deviation of -3.5 is -229376 in units of 2^-16. It gives log2_sigma = -330918, i = 30,
r = 31333, log2_D = 2566696 and sigma_units = -35.
"""

from typing import NamedTuple

import numpy as np

from ..equations.grid_nodes import table_rows
from ..equations.prior import RAW_MAX, RAW_MIN, layout
from ..model import GROUPS, LATTICE
from .gaussian_table import MU_BITS, MU_LIMIT, SIGMA_BITS, SIGMA_MAX, SIGMA_MIN, lookup_table
from .rans import bit_length

INPUT_BITS, ACTIVATION_BITS, WEIGHT_BITS, BIAS_BITS, MAX_SCALE = 15, 22, 15, 50, 24
STEP_FLOOR, STEP_MAX = 32, 2**16  # of q_units, 2 Q_0 / 2^16 each; the floor of Q7 is 2^-10 Q_0
LOG2_E = 94548  # log2(e) in units of 2^-16
CHUNK = 2**18  # numbers per temporary array, so that memory does not grow with the anchors


class Layer(NamedTuple):
    """Integers in float64, exact because none reaches 2^53."""

    W: np.ndarray  # [I, J]
    b: np.ndarray  # [J]
    bits: int  # fractional bits of the output y
    bound: int  # upper bound of |y| and of every partial sum
    s: int  # bits of y that a hidden layer rounds away


def exponent(values):
    """Return the least integer p with max |values| < 2^p; 0 if all values are zero."""
    return int(np.frexp(np.abs(values).max(initial=0.0))[1])


def round_off(values, s):
    """Return values / 2^s rounded, ties up, or the values if s <= 0; integers in float64."""
    return np.floor((values + 2**s // 2) * 2.0**-s) if s > 0 else values


def integer_layers(weights, biases):
    """Return the layers of a network in integers, from the weights and biases in the file."""
    layers, bits, X = [], INPUT_BITS, 2**INPUT_BITS
    for W, b in zip(weights, biases):
        n = min(WEIGHT_BITS - exponent(W), BIAS_BITS - exponent(b) - bits, MAX_SCALE)
        W, b, bits = np.rint(W * 2.0**n), np.rint(b * 2.0 ** (bits + n)), bits + n
        # |x_i| <= X, so by the triangle inequality no sum of some of the products x_i W_ij, with or
        # without b_j, exceeds the bound. Integers up to 2^53 are exact in float64.
        largest_sum = int(np.abs(W).sum(axis=0).max(initial=0.0))
        bound = X * largest_sum + int(np.abs(b).max(initial=0.0))
        assert bound < 2**52, "a partial sum could be rounded"
        s = max(0, bound.bit_length() - ACTIVATION_BITS)
        layers.append(Layer(W, b, bits, bound, s))
        bits, X = bits - s, bound + 2**s // 2 >> s
    return layers


def product(x, W):
    """Return x W, exact in any order of summation.

    Nothing else here calls a library's matrix product.
    """
    return x @ W


def run_network(x, layers):
    """Return the last layer's outputs y [A, J] for x [A, I] in units of 2^-15, |x| <= 2^15."""
    for layer in layers[:-1]:
        x = np.maximum(round_off(product(x, layer.W) + layer.b, layer.s), 0.0)
    return product(x, layers[-1].W) + layers[-1].b


def rescale(y, unit, bits, limit):
    """Convert outputs y from units of 2^-unit to units of 2^-bits, clipped to +-limit: int64."""
    s = unit - bits
    if s < 0:  # few fractional bits: clip first, so that the multiplication stays exact
        y = np.clip(y, -limit, limit) * 2.0 ** min(-s, 30)
    return np.clip(round_off(y, s), -limit, limit).astype(np.int64)


def log2(values):
    """Return log2 of positive integers in units of 2^-16: exponent, then a table of 256 steps."""
    length = bit_length(values)
    # Shift the leading one to bit 23; the 23 bits after it are 8 of the index and 15 of the rest.
    leading = values << np.maximum(24 - length, 0) >> np.maximum(length - 24, 0)
    steps, i, r = lookup_table("log2"), leading >> 15 & 255, leading & 2**15 - 1
    return (length - 1 << 16) + steps[i] + ((steps[i + 1] - steps[i]) * r >> 15)


class CodingContext(NamedTuple):
    """What the coder needs to know about every anchor; columns as in `model.join`."""

    q: np.ndarray  # [A, 4]  steps of f, s, l, O, float64
    mu_units: np.ndarray  # [A, n]  mu / q in units of 2^-MU_BITS, int64
    sigma_units: np.ndarray  # [A, n]  log2(sigma / q) in units of 2^-SIGMA_BITS, int32


def hash_feature(positions, grids, design):
    """Return h [A, L F] in units of 2^-15 (part 1), integers in float64, of positions [A, 3]."""
    features = []
    for (axes, res), grid in zip(design.grid, grids):
        place = positions[:, ["xyz".index(axis) for axis in axes]] * (res - 1)
        base, t = place // LATTICE, (place % LATTICE).astype(float)
        corner = np.indices([2] * len(axes)).reshape(len(axes), -1).T
        weight = np.where(corner, t[:, None, :], LATTICE - t[:, None, :]).prod(axis=2)
        signs = grid.take(table_rows(base, corner, res, len(grid)), axis=0)  # [A, 2^D, F]
        # Exact in any order: sums of integers below 2^48.
        v = np.einsum("ac,acf->af", weight, signs).astype(np.int64)
        unit = LATTICE ** len(axes) >> INPUT_BITS
        features.append((v + unit // 2) // unit)
    return np.concatenate(features, axis=1).astype(float)


def shift(values, S):
    """Return floor(values 2^-S + 1/2) clipped to +-MU_LIMIT; |values| <= 2^52, S of either sign."""
    right, left = np.clip(S, 0, 62), np.clip(-S, 0, 28)
    rounded = (values + (1 << right >> 1)) >> right
    return np.clip(np.clip(rounded, -MU_LIMIT, MU_LIMIT) << left, -MU_LIMIT, MU_LIMIT)


def coding_context(design, networks, grids, positions):
    """Return the coding context of anchors at positions [A, 3], integers 0 to 65535.

    `networks` contain float16 numbers and `grids` +1 and -1, as in the file. P-4DGS Eqs. (8), (9)
    and (12) in integers; choices Q6 (one step per group), Q7, Q8 and Q11.
    """
    psi_q, psi_p = (integer_layers(*networks[name]) for name in ("psi_q", "psi_p"))
    columns = len(design.grid) * design.F, 8 * max(design.F, 3), 2 * sum(design.widths)
    rows = CHUNK // max(*columns, *design.context)
    parts = [
        context_of(hash_feature(positions[a : a + rows], grids, design), psi_q, psi_p, design)
        for a in range(0, len(positions), rows)
    ]
    return CodingContext(*map(np.concatenate, zip(*parts)))


def context_of(h, psi_q, psi_p, design):
    """Return q, mu_units and sigma_units (parts 3 to 6) of some anchors."""
    u = rescale(run_network(h, psi_q), psi_q[-1].bits, 12, 2**15)
    v = np.clip(u + (4 << 12), 0, (10 << 12) - 1)
    steps, i, r = lookup_table("sigmoid"), v >> 6, v & 63
    share = steps[i] + ((steps[i + 1] - steps[i]) * r >> 6)
    q_units = np.clip(share + 128 >> 8, STEP_FLOOR, STEP_MAX)

    fraction, p = np.frexp(np.array(design.Q_0))
    D = np.floor(fraction * 2.0**24).astype(np.int64) * q_units  # [A, 4], 29 to 40 bits
    n = bit_length(D) - 24
    R = 2**47 // (D >> n)
    log2_q = log2(D) + ((p - 39) << 16)
    group = np.repeat(np.arange(len(GROUPS)), design.widths)  # of every column

    y, bits = run_network(h, psi_p), psi_p[-1].bits
    mu_columns, raw_columns = layout(design.widths)
    t = max(0, psi_p[-1].bound.bit_length() - 28)
    m = round_off(y[:, mu_columns], t).astype(np.int64)
    S = bits - t + p + n - (MU_BITS - 8)
    mu_units = shift(m * R[:, group], S[:, group])

    raw = rescale(y[:, raw_columns], bits, 16, 2**24)
    log2_sigma = np.clip(raw, int(RAW_MIN) << 16, int(RAW_MAX) << 16) * LOG2_E + 2**15 >> 16
    sigma_units = (log2_sigma - log2_q[:, group] + (1 << 15 - SIGMA_BITS)) >> 16 - SIGMA_BITS
    q = q_units * (np.array(design.Q_0) * 2.0**-15)
    return q, mu_units, np.clip(sigma_units, SIGMA_MIN, SIGMA_MAX).astype(np.int32)
