"""The frequencies of one symbol: a Gaussian of its own mean and deviation, in integers alone.

FORMAT.  A symbol k (an integer) comes with two integers from the context:

    mu_units     mu/q in units of 1/1024, within +-2^34
    sigma_units  log2(sigma/q) in units of 1/16, -128..319 (sigma/q from 2^-8 to almost 2^20)

All divisions below by powers of two are floors (arithmetic shifts; shifts of 32 bits are too short); every product stays
below 2^53, if differences are taken first.

1. sigma.  e = floor(sigma_units / 16), f = sigma_units mod 16.
2. Grid.  One step is max(1/1024, 2^(e-4)) symbols: between sigma/32 and sigma/16.
       step = max(e + 6, 0)            node = floor((mu_units + floor(2^step / 2)) / 2^step)
   mu' = node * 2^step replaces mu_units from here on.
3. Blocks.  Where the step exceeds one symbol, the 2^low symbols of one step share one frequency:
       low = max(e - 4, 0)             K = floor(k / 2^low)
   and the low bits, k mod 2^low, are written as they are (`streams`).  low = 0 wherever sigma/q < 32.
4. Window.  c = floor((mu' + 512) / 2^(10+low)) is the block of the mean, W = 1 + ceil(12 * 2^min(e, 4)) its reach.
   The blocks c-W .. c+W have a frequency each; everything else is the escape, numbered c+W+1 here.
5. Boundary below block K:  z = floor((K * 2^(10+low) - 512 - mu') * exp2[f] / 2^(12+e)), clamped to
   -98304 .. 98303: the distance to mu in sigmas, times 2^14.  With i = floor(z / 256) + 384 and r = z mod 256
       C(K) = phi[i] + floor((phi[i+1] - phi[i]) * r / 256)       (tables in `tables.json`; Phi times 2^24)
   It is 0 at K = c-W and 2^24 at K = c+W+1 by the choice of W.
6. Cumulative frequency.  With n = 2W + 1 and j = K - (c-W):
       cum(K) = floor(C(K) * (2^24 - n - 1) / 2^24) + j,          freq(K) = cum(K+1) - cum(K) >= 1
   The escape starts at cum = 2^24 - 1 and has frequency 1; the total is 2^24 exactly.  cum rises with K, so a decoder
   that wants no table finds its block by bisection.

WORKED NUMBERS.  mu/q = 0.3, sigma/q = 1.5: mu_units = 307, sigma_units = 9.  Then e = 0, f = 9, step = 6, node = 5,
mu' = 320, low = 0, c = 0, W = 13, n = 27, exp2[9] = 44376.  Boundary below 0: z = floor(-832 * 44376 / 4096) = -9014,
i = 348, r = 202, C = 4813177 + floor(89668 * 202 / 256) = 4883930, cum(0) = 4883921 + 13 = 4883934.  Boundary below
1: z = 2080, cum(1) = 9236032.  So the symbol 0 has frequency 4352098 (probability 0.2594) and costs 1.947 bits.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from .fixed_point import table as normative

MU_BITS, SIGMA_BITS, PRECISION = 10, 4, 24
MU_LIMIT = 1 << 34
SIGMA_MIN, SIGMA_MAX = -8 << SIGMA_BITS, (20 << SIGMA_BITS) - 1
Z_BITS, PHI_BITS, EXP2_BITS = (
    14,
    6,
    16,
)  # z has 14 fractional bits; phi has 2^6 entries per unit of z
Z_LIMIT = 6 << Z_BITS
HALF = 1 << MU_BITS - 1  # half a symbol
CHUNK, TABLES = 1 << 15, 1 << 12


class Model(NamedTuple):
    """The frequency tables that n symbols use: U of them in one ascending array, for `rans`."""

    keys: (
        np.ndarray
    )  # (E+1,) (u << 24) + cum for every entry of every table u, and U << 24 at the end
    first: np.ndarray  # (U,)  index into keys of each table's first block
    blocks: np.ndarray  # (U,)  2W + 1; entry first + blocks is the escape
    low: np.ndarray  # (U,)  how many low bits of a symbol are written as they are
    table: np.ndarray  # (n,)  which table each symbol uses, int32
    lowest: np.ndarray  # (n,)  c - W, the block of that table's first entry, int32


def shape_of(sigma_units):
    """What a deviation fixes: e, step, low and W of the format above, int64."""
    e = sigma_units >> SIGMA_BITS
    # ceil(12 * 2^e) is minus the floor of -12 * 2^e; 2^8 makes every shift go right, as e >= -8
    return e, np.maximum(e + 6, 0), np.maximum(e - 4, 0), 1 - ((-12 << 8) >> 8 - np.minimum(e, 4))


def gaussian_model(mu_units, sigma_units):
    """The model of n symbols; equal (sigma, place of mu in its block) share one table.

    Shapes     mu_units, sigma_units (n,) integers -> Model
    Units      see the format above
    Domain     |mu_units| <= 2^34, -128 <= sigma_units <= 319
    Raises     ValueError outside that domain, for other dtypes or unequal shapes
    Reference  P-4DGS Eqs. (11), (12)
    """
    _check(mu_units, sigma_units)
    pair, lowest = np.empty(len(mu_units), np.int32), np.empty(len(mu_units), np.int32)
    used = np.zeros(SIGMA_MAX - SIGMA_MIN + 1 << MU_BITS, bool)
    for a in range(0, len(pair), CHUNK):  # in pieces that stay in the cache
        rows = slice(a, a + CHUNK)
        number = sigma_units[rows].astype(np.int64) - SIGMA_MIN
        _, step, low, reach = (values[number] for values in _shapes())
        mu = (mu_units[rows].astype(np.int64) + (1 << step >> 1)) >> step << step
        lowest[rows] = (mu + HALF >> MU_BITS + low) - reach
        # low > 0 only where mu is a multiple of its block, so the place in the block is always below 1024
        pair[rows] = (number << MU_BITS) | (mu & (1 << MU_BITS + low) - 1)
        used[pair[rows]] = True
    pairs = np.flatnonzero(used)
    sigma_units, place = (pairs >> MU_BITS) + SIGMA_MIN, pairs & (1 << MU_BITS) - 1
    _, _, low, reach = shape_of(sigma_units)
    keys, first = build_keys(sigma_units, place)
    table_of_pair = np.cumsum(used, dtype=np.int32) - 1
    for a in range(0, len(pair), CHUNK):  # in place: from here on a pair is its table
        pair[a : a + CHUNK] = table_of_pair[pair[a : a + CHUNK]]
    return Model(keys, first, 2 * reach + 1, low, pair, lowest)


def build_keys(sigma_units, place):
    """The keys of U tables and the index of each table's first entry.

    Shapes     sigma_units, place (U,) -> keys (E+1,), first (U,)
    Units      place: mu' modulo one block, 1/1024 symbol
    """
    entries = 2 * shape_of(sigma_units)[3] + 2
    ends = np.cumsum(entries)
    keys, first = np.empty(int(entries.sum()) + 1, np.int64), ends - entries
    for a in range(0, len(entries), TABLES):  # in pieces, for their memory
        rows = slice(a, a + TABLES)
        keys[first[a] : ends[rows][-1]] = _keys_of(sigma_units[rows], place[rows]) + (
            a << PRECISION
        )
    keys[-1] = len(entries) << PRECISION
    return keys, first


def _keys_of(sigma_units, place):
    """The keys of some tables, counted from 0, without the last one that closes them."""
    phi, exp2 = normative("phi"), normative("exp2")
    e, _, low, reach = shape_of(sigma_units)
    entries = 2 * reach + 2
    table = np.repeat(np.arange(len(entries)), entries)
    j = np.arange(len(table)) - (np.cumsum(entries) - entries)[table]
    lowest = (place + HALF >> MU_BITS + low) - reach
    # |K 2^(10+low) - 512 - mu'| <= 195 * 2^25 < 2^33, times exp2 <= 2^16: below 2^49
    distance = (j + lowest[table] << (MU_BITS + low)[table]) - (HALF + place)[table]
    scale = exp2[sigma_units & (1 << SIGMA_BITS) - 1]
    z = distance * scale[table] >> (EXP2_BITS + MU_BITS - Z_BITS + e)[table]
    z = np.clip(z, -Z_LIMIT, Z_LIMIT - 1) + Z_LIMIT
    i, r = z >> Z_BITS - PHI_BITS, z & (1 << Z_BITS - PHI_BITS) - 1
    C = phi[i] + ((phi[i + 1] - phi[i]) * r >> Z_BITS - PHI_BITS)
    cum = (
        C * ((1 << PRECISION) - entries)[table] >> PRECISION
    ) + j  # entries = n + 1; product below 2^48
    return (table << PRECISION) + cum


@cache
def _shapes():
    """`shape_of` for every deviation, to be indexed by sigma_units - SIGMA_MIN."""
    return shape_of(np.arange(SIGMA_MIN, SIGMA_MAX + 1, dtype=np.int64))


def _check(mu_units, sigma_units):
    for name, values, low, high in (
        ("mu_units", mu_units, -MU_LIMIT, MU_LIMIT),
        ("sigma_units", sigma_units, SIGMA_MIN, SIGMA_MAX),
    ):
        if values.dtype.kind != "i":
            raise ValueError(f"{name}: signed integers expected, got {values.dtype}")
        if values.size and not low <= values.min() <= values.max() <= high:
            raise ValueError(
                f"{name}: values within {low}..{high} expected, got {values.min()}..{values.max()}"
            )
    if mu_units.shape != sigma_units.shape or mu_units.ndim != 1:
        raise ValueError(
            f"mu_units {mu_units.shape} and sigma_units {sigma_units.shape}: equal 1-d shapes expected"
        )
