"""The frequency table of one symbol: a Gaussian with its own mean and deviation, in integers alone.

The coding context gives two integers for every symbol k:

    mu_units      mu / q in units of 1/1024, within +-2^34
    sigma_units   log2(sigma / q) in units of 1/16, from -128 to 319 (sigma / q from 2^-8 to almost
                  2^20)

A symbol is coded as the *block* it lies in, plus raw bits if a block has several symbols. Every
block within six deviations of the mean has a frequency; all others share the *escape*. Divisions by
powers of two round down; they are arithmetic shifts of integers of more than 32 bits. Every product
stays below 2^53 if differences are taken before products.

1. Deviation. e = floor(sigma_units / 16), f = sigma_units mod 16.

2. Mean. It is rounded to a multiple of max(1/1024, 2^(e-4)) symbols, which is between sigma / 32
   and sigma / 16 from e = -6 on:

       step = max(e + 6, 0)         node = floor((mu_units + floor(2^step / 2)) / 2^step)
       mu'  = node 2^step

   mu' replaces mu_units from here on.

3. Blocks. If that multiple exceeds one symbol, a block has as many symbols as the multiple, and
   one symbol otherwise:

       low = max(e - 4, 0)          K = floor(k / 2^low)

   K is the block of symbol k. The low bits, k mod 2^low, are stored as they are (`streams.py`). low
   is 0 wherever sigma / q < 32.

4. Window. The block of the mean is c, and the window reaches W blocks to either side:

       c = floor((mu' + 512) / 2^(10+low))         W = 1 + ceil(12 * 2^min(e, 4))

   The blocks c-W to c+W have a frequency each. Any other block is coded as the escape, which takes
   the place of block c+W+1.

5. Distribution function. At the boundary below block K,

       z = floor((K 2^(10+low) - 512 - mu') exp2[f] / 2^(12+e))      clipped to -98304 ... 98303

   is the distance to the mean in deviations, times 2^14. With i = floor(z / 256) + 384 and
   r = z mod 256,

       C(K) = phi[i] + floor((phi[i+1] - phi[i]) r / 256)

   is the Gaussian distribution function times 2^24. W is large enough that C is 0 at K = c-W and
   2^24 at K = c+W+1.

6. Frequencies. With n = 2W + 1 blocks and j = K - (c-W),

       cum(K)  = floor(C(K) (2^24 - n - 1) / 2^24) + j
       freq(K) = cum(K+1) - cum(K) >= 1

   The escape begins at cum = 2^24 - 1 and has frequency 1, so the total is exactly 2^24. cum
   increases with K, so a decoder can find a block by bisection and needs no table.

Worked example. mu / q = 0.3 and sigma / q = 1.5 give mu_units = 307 and sigma_units = 9.

    e = 0, f = 9, step = 6, node = 5, mu' = 320, low = 0, c = 0, W = 13, n = 27, exp2[9] = 44376
    below block 0:  z = floor(-832 * 44376 / 4096) = -9014, i = 348, r = 202
                    C = 4813177 + floor(89668 * 202 / 256) = 4883930
                    cum(0) = 4883921 + 13 = 4883934
    below block 1:  z = 2080, cum(1) = 9236032

The symbol 0 therefore has the frequency 4352098, a probability of 0.2594, and costs 1.947 bits.
"""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

MU_BITS, SIGMA_BITS, PRECISION = 10, 4, 24
MU_LIMIT = 1 << 34
SIGMA_MIN, SIGMA_MAX = -8 << SIGMA_BITS, (20 << SIGMA_BITS) - 1
Z_BITS, PHI_BITS, EXP2_BITS = 14, 6, 16  # fractional bits of z, of phi's argument, and of exp2
Z_LIMIT = 6 << Z_BITS
HALF = 1 << MU_BITS - 1  # half a symbol
CHUNK, TABLES = 1 << 15, 1 << 12  # symbols and tables processed at a time, to fit the cache


class EntropyModel(NamedTuple):
    """The frequency tables of n symbols, in the form that `rans` takes: U tables in one array."""

    keys: np.ndarray  # [E+1]  (u << 24) + cum of every entry of every table u, then U << 24
    first: np.ndarray  # [U]  index into keys of each table's first block
    blocks: np.ndarray  # [U]  2W + 1; the entry first + blocks is the escape
    low: np.ndarray  # [U]  number of raw bits per symbol
    table: np.ndarray  # [n]  which table each symbol uses, int32
    lowest: np.ndarray  # [n]  c - W, the first block of the symbol's table, int32


@cache
def lookup_table(name):
    """Return a table of `tables.json`, int64.

    The tables are part of the format: do not recompute them.
    """
    tables = json.loads(Path(__file__).with_name("tables.json").read_text(encoding="utf-8"))
    return np.array(tables[name], np.int64)


def shape_of(sigma_units):
    """Return e, step, low and W of deviations (parts 1 to 4), int64."""
    e = sigma_units >> SIGMA_BITS
    # ceil(12 * 2^e) is minus the floor of -12 * 2^e; as e >= -8, 2^8 makes every shift go right.
    W = 1 - ((-12 << 8) >> 8 - np.minimum(e, 4))
    return e, np.maximum(e + 6, 0), np.maximum(e - 4, 0), W


def gaussian_model(mu_units, sigma_units):
    """Return the EntropyModel of n symbols, from integers mu_units [n] and sigma_units [n].

    They lie in the ranges above. Symbols with the same deviation and the same place of mu' in its
    block share one table. P-4DGS Eqs. (11) and (12).
    """
    pair, lowest = np.empty(len(mu_units), np.int32), np.empty(len(mu_units), np.int32)
    used = np.zeros(SIGMA_MAX - SIGMA_MIN + 1 << MU_BITS, bool)
    for a in range(0, len(pair), CHUNK):
        rows = slice(a, a + CHUNK)
        sigma = sigma_units[rows].astype(np.int64)
        _, step, low, reach = shape_of(sigma)
        mu = (mu_units[rows].astype(np.int64) + (1 << step >> 1)) >> step << step
        lowest[rows] = (mu + HALF >> MU_BITS + low) - reach
        # low > 0 only if mu' is a multiple of its block, so the place is always below 1024.
        pair[rows] = (sigma - SIGMA_MIN << MU_BITS) | (mu & (1 << MU_BITS + low) - 1)
        used[pair[rows]] = True

    pairs = np.flatnonzero(used)
    sigma_units, place = (pairs >> MU_BITS) + SIGMA_MIN, pairs & (1 << MU_BITS) - 1
    parts = [
        keys_of(sigma_units[a : a + TABLES], place[a : a + TABLES]) + (a << PRECISION)
        for a in range(0, len(pairs), TABLES)
    ]
    table_of_pair = np.empty(len(used), np.int32)
    table_of_pair[pairs] = np.arange(len(pairs))
    for a in range(0, len(pair), CHUNK):  # in place: from here on a pair is the number of its table
        pair[a : a + CHUNK] = table_of_pair[pair[a : a + CHUNK]]
    _, _, low, reach = shape_of(sigma_units)
    entries = 2 * reach + 2
    keys = np.concatenate([*parts, [len(pairs) << PRECISION]])
    return EntropyModel(keys, np.cumsum(entries) - entries, entries - 1, low, pair, lowest)


def keys_of(sigma_units, place):
    """Return the keys of a few tables (parts 5 and 6), counted from 0, without the closing one.

    `place` is mu' modulo one block, in units of 1/1024 symbol.
    """
    phi, exp2 = lookup_table("phi"), lookup_table("exp2")
    e, _, low, reach = shape_of(sigma_units)
    entries = 2 * reach + 2
    number = np.repeat(np.arange(len(entries)), entries)  # of each entry's table
    j = np.arange(len(number)) - (np.cumsum(entries) - entries)[number]
    unit, scale = MU_BITS + low, exp2[sigma_units & (1 << SIGMA_BITS) - 1]
    lowest = (place + HALF >> unit) - reach
    # |K 2^(10+low) - 512 - mu'| <= 195 * 2^25 < 2^33, times exp2 <= 2^16: below 2^49. It is linear
    # in j, so everything but j is computed once for a table.
    below_first, step = ((lowest << unit) - (HALF + place)) * scale, scale << unit
    z = below_first[number] + j * step[number] >> (EXP2_BITS + MU_BITS - Z_BITS + e)[number]
    z = np.clip(z, -Z_LIMIT, Z_LIMIT - 1) + Z_LIMIT
    i, r = z >> Z_BITS - PHI_BITS, z & (1 << Z_BITS - PHI_BITS) - 1
    C = phi[i] + (np.diff(phi)[i] * r >> Z_BITS - PHI_BITS)
    # entries = n + 1, and the product stays below 2^48
    cum = (C * ((1 << PRECISION) - entries)[number] >> PRECISION) + j
    return (number << PRECISION) + cum
