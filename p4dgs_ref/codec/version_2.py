"""The sections of version 2 that differ from version 1: sorted positions and coded networks.

POSITIONS. They are sorted along a curve through the box, so that only gaps are coded. The anchors
of a model may stand in any order, and the order of A anchors is worth log2(A!) bits. Sorted anchors
need not pay for it. All other sections follow the same order.

LATTICE. B is the header's `position_bits`, and L = 2^B - 1. The file holds coordinates m on a
lattice of B bits, from 0 to L. Everything else on this page uses positions of 16 bits, namely

    n = floor((65535 m + floor(L / 2)) / L)

which is m for B = 16. An encoder finds m = floor((L n + 32767) / 65535).

CODES. The code of a point takes one bit of each of its coordinates in turn: the highest bit of x,
then of y, of z, the next bit of x and so on. An axis on which the box has no extent (lo = hi) is
left out, and m is 0 there. With D axes left, a code has D B bits. (It is known as Morton code.) The
points stand in ascending order of their codes, and several may have the same code. The first gap is
the first code, and every other gap is the difference of a code to the one before.

SECTION. The box is that of version 1. It is followed by

    1 byte      r, the number of raw bits of every gap, from 0 to D B
    ...         bits, which fill every byte from its lowest bit on; unused bits are 0:
                a. for every gap in order its r low bits, lowest first
                b. for every gap in order floor(gap / 2^r) + 1 in the gamma code of `streams.py`

The bytes are read exactly to their end, and the sum of all gaps is at most 2^(D B) - 1. An encoder
may choose r. This one takes the r that needs the fewest bits, the smallest of several, but at least
D B - 33, because a gamma code has at most 33 zeros.

Worked numbers of positions. With B = 2, the points (3, 0, 1) and (0, 1, 2) have the bits 11 00 01
and 00 01 10, and therefore the codes 100101 = 37 and 001010 = 10. The gaps are 10 and 27. With
r = 4 the raw bits are 0101 1101, lowest first, and 10 / 16 + 1 = 1 and 27 / 16 + 1 = 2 have the
gamma codes 1 and 010. After the box, the section has the bytes 04 BA 05. The coordinates 0, 1, 2
and 3 are 0, 21845, 43690 and 65535 in 16 bits.

NETWORKS are integers times a step, coded with scales of rows and columns (B1).

A tensor is the weights W (I rows, J columns) or the biases b of a layer; b is a matrix of J rows
and one column. A section has the tensors of its networks in the order of version 1: W and b of the
first layer, W and b of the second, and so on; heads without outputs are left out. It consists of

    2 bytes each    for every tensor its step s, 0 to 255, and its level t plus 8, 0 to 27; s and t
                    of the first tensor, then s and t of the second, and so on
    a message       (`rans.py`) of the row codes r (I numbers) and then the column codes c (J) of
                    every W, tensor by tensor. They are whole numbers from -13 to 13, each coded
                    with the table of mu_units = 0 and sigma_units = 0 (`gaussian_table.py`) and
                    never with its escape
    a stream        (`streams.py`, Gaussian) of the symbols n of all tensors, from -32767 to 32767,
                    row by row

A symbol of row i and column j is coded with

    mu_units = 0        sigma_units = 16 clip(t + r_i + c_j, -8, 19)

so its deviation is 2^(t + r_i + c_j) where that is in range. Biases have no codes: r and c are 0
there. The number is

    n (16 + s mod 16) 2^(floor(s / 16) - 19)

which is exact: n has 15 bits and the step 5. Only these numbers are computed further; whatever is
said about the float16 numbers of version 1 holds for them.

An encoder may choose t, r and c. This one changes them in turn, until nothing changes but at most
four times each, to those that need the fewest bits, with r and c from -6 to 6.

Worked numbers of networks. s = 186 is the step 26 2^-8 = 0.1015625, and the symbol -3 is
-0.3046875. With t = 1, r = -1 and c = 2 its sigma_units are 32: a deviation of 4 symbols. In the
published stream `coded_ten_bits` the section context_mlps begins with the bytes 60 10 50 11: the
first W has the step 96 and t = 8, its b the step 80 and t = 9.
"""

from functools import cache

import numpy as np

from ..model import LATTICE, on_lattice, step_of_code
from ..scenes.scene import MAX_STEPS
from . import rans
from .container import require
from .gaussian_table import CHUNK, SIGMA_BITS, SIGMA_MAX, SIGMA_MIN, gaussian_model
from .streams import (
    MAX_GAMMA,
    decode_symbols,
    encode_gaussian,
    expect_end,
    find_entries,
    gamma_fields,
    ideal_bits_gaussian,
    pack_fields,
    raw_bits,
    read_gammas,
    unpack_fields,
)

LEVELS = np.arange(SIGMA_MIN >> SIGMA_BITS, (SIGMA_MAX >> SIGMA_BITS) + 1)
CODES = np.arange(-6, 7)  # of rows and columns, that the encoder tries
SWEEPS = 4
MOST = 1024  # magnitudes whose cost the encoder knows; larger ones count as the largest of them


def extended(box):
    """The axes on which a box has an extent."""
    return np.flatnonzero(box[0] < box[1])


def codes_of(positions, box, bits):
    """The codes [A] of positions [A, 3] of 16 bits that stand on the lattice of `bits` bits."""
    m = (positions * ((1 << bits) - 1) + LATTICE // 2) // LATTICE
    codes, axes = np.zeros(len(m), np.int64), extended(box)[::-1]
    for i in range(bits * len(axes)):
        codes |= (m[:, axes[i % len(axes)]] >> i // len(axes) & 1) << i
    return codes


def write_gaps(positions, box, bits):
    """The section after the box. The positions stand in ascending order of their codes."""
    gaps = np.diff(codes_of(positions, box, bits), prepend=0)
    most = bits * len(extended(box))
    choices = range(max(most - MAX_GAMMA, 0), most + 1)
    r = min(choices, key=lambda r: int((r + 2 * rans.bit_length((gaps >> r) + 1)).sum()))
    high, widths = gamma_fields((gaps >> r) + 1)
    return bytes([r]) + pack_fields(
        np.concatenate([gaps & (1 << r) - 1, high]),
        np.concatenate([np.full(len(gaps), r), widths]),
    )


def read_gaps(data, start, count, box, bits):
    """The positions [count, 3] of 16 bits in a section whose byte r stands at `start`.

    Raises BitstreamError for data that `write_gaps` does not write.
    """
    name, axes = "positions", extended(box)[::-1]
    require(len(data) > start, name, len(data), "the data end before the number of raw bits")
    r, most = data[start], bits * len(axes)
    require(r <= most, name, start, f"{r} raw bits per gap, expected at most {most}")
    at = 8 * (start + 1)
    end = at + r * count
    # At least one more bit per gap, so that a wrong count is refused before it costs memory.
    require(
        end + count <= 8 * len(data),
        name,
        len(data),
        "the data end before the last bit of a gap",
    )
    low = unpack_fields(raw_bits(data, at, end), np.full(count, r))
    gamma, end = read_gammas(data, end, count, name)
    expect_end(data, end, name)
    # A gap larger than every code is cut to the first number beyond them: no sum overflows.
    codes = np.cumsum((np.minimum(gamma - 1, 1 << most - r) << r) + low)
    require((codes >> most == 0).all(), name, start, f"gaps that add up to 2^{most} or more")
    m = np.zeros((count, 3), np.int64)
    for i in range(most):
        m[:, axes[i % len(axes)]] |= (codes >> i & 1) << i // len(axes)
    return on_lattice(m, bits)


def write_weights(networks, steps):
    """The section of networks whose numbers are multiples of their tensors' steps.

    `networks` and `steps` are some of `Model.networks` and `Model.steps`.
    """
    head, codes, scales, symbols = [], [], [], []
    layers = [layer for name in networks for layer in zip(*networks[name], *steps[name])]
    for W, b, step_W, step_b in layers:
        for a, step in ((W, step_W), (b[:, None], step_b)):
            n = np.rint(a / step_of_code(step)).astype(np.int64)
            t, r, c = fit(n, a is W)
            head += [step, t - LEVELS[0]] if a.size else []
            codes += [r, c] if a is W and a.size else []
            scales.append((t + r[:, None] + c).ravel())
            symbols.append(n.ravel())
    codes, scales, symbols = (np.concatenate(parts) for parts in (codes, scales, symbols))
    tables = tables_of(0 * codes)
    message = rans.encode(find_entries(codes, tables)[0], tables.keys)
    return bytes(head) + message + encode_gaussian(symbols, 0 * symbols, sigma_units(scales))


def read_weights(data, section, shapes):
    """The networks in a section and the codes of their steps, from the shapes of their layers.

    Raises BitstreamError for data that `write_weights` does not write.
    """
    layers = [layer for network in shapes.values() for layer in network]
    full = np.array([J > 0 for _, J in layers])
    start = 4 * int(full.sum())
    require(len(data) >= start, section, len(data), "the data end before the last level")
    raw = np.frombuffer(data, np.uint8, start)
    at = 2 * int((raw[1::2] < len(LEVELS)).argmin()) + 1
    require(raw[at] < len(LEVELS), section, at, f"expected levels of at most {len(LEVELS) - 1}")
    head = np.zeros((len(layers), 2, 2), np.int64)  # step and level of W and b
    head[full] = raw.reshape(-1, 2, 2)
    steps, levels = head[:, :, 0], head[:, :, 1] + LEVELS[0]

    lengths = [length for I, J in layers for length in (I if J else 0, J)]
    tables = tables_of(np.zeros(sum(lengths), np.int64))
    entries, at = rans.decode(data, tables.table, tables.keys, start, section)
    codes = tables.lowest + entries - tables.first[tables.table]
    require((codes <= -tables.lowest).all(), section, start, "a code beyond +-13")
    codes = iter(np.split(codes, np.cumsum(lengths)))
    scales = []
    for (_, J), (t_W, t_b) in zip(layers, levels):
        scales += [(t_W + next(codes)[:, None] + next(codes)).ravel(), np.full(J, t_b)]
    symbols = decode_symbols(data, tables_of(np.concatenate(scales)), section, at=at)
    require(
        np.abs(symbols).max(initial=0) <= MAX_STEPS,
        section,
        at,
        f"expected symbols within +-{MAX_STEPS}",
    )
    numbers = symbols * np.repeat(step_of_code(steps.ravel()), [len(part) for part in scales])
    of_network = np.split(steps.T, np.cumsum([*map(len, shapes.values())])[:-1], axis=1)
    return networks_of(numbers, shapes), dict(zip(shapes, map(tuple, of_network)))


def networks_of(numbers, shapes):
    """The networks {name: (weights, biases)} whose numbers follow each other, as in version 1."""
    sizes = [size for network in shapes.values() for I, J in network for size in (I * J, J)]
    arrays, networks = iter(np.split(numbers, np.cumsum(sizes))), {}
    for name, network in shapes.items():
        pairs = [(next(arrays).reshape(shape), next(arrays)) for shape in network]
        networks[name] = [W for W, _ in pairs], [b for _, b in pairs]
    return networks


def level_index(scales):
    """The index in LEVELS of the binary logarithms of deviations, integers."""
    return np.clip(scales, LEVELS[0], LEVELS[-1]) - LEVELS[0]


def sigma_units(scales):
    """The sigma_units of symbols from the binary logarithms of their deviations, integers."""
    return LEVELS[level_index(scales)] << SIGMA_BITS


@cache
def tables_of_levels():
    """The model of one symbol at every level; `gaussian_model` orders tables by deviation."""
    return gaussian_model(0 * LEVELS, sigma_units(LEVELS))


def tables_of(scales):
    """`gaussian_model` of symbols, from the binary logarithms of their deviations."""
    levels, i = tables_of_levels(), level_index(scales)
    return levels._replace(table=levels.table[i], lowest=levels.lowest[i])


@cache
def costs():
    """Bits, in units of 1/256, of magnitudes at every level [28, MOST] and of CODES [13]."""
    scales, magnitudes = np.repeat(LEVELS, MOST), np.tile(np.arange(MOST), len(LEVELS))
    bits = ideal_bits_gaussian(magnitudes, 0 * scales, sigma_units(scales)).reshape(-1, MOST)
    price = ideal_bits_gaussian(CODES, 0 * CODES, 0 * CODES)
    return np.rint(256 * bits), np.rint(256 * price)  # whole numbers: their sums are exact


def price(magnitudes, scales):
    """The bits, as in `costs`, of magnitudes at scales; the two have shapes that NumPy combines."""
    return costs()[0].take(MOST * level_index(scales) + magnitudes)  # faster than two indices


def fit(symbols, coded, best_level=None):
    """The level, row codes [I] and column codes [J] of symbols [I, J]; only 0 unless `coded`.

    `best_level` may be `best_level_plainly`.
    """
    magnitudes = np.minimum(np.abs(symbols), MOST - 1)
    r, c = (np.zeros(length, np.int64) for length in symbols.shape)
    for _ in range(SWEEPS):
        before, t = (r, c), (best_level or best_level_fast)(magnitudes, r[:, None] + c)
        if coded:
            r = best_codes(magnitudes, t + c)
            c = best_codes(magnitudes.T, t + r)
        if all(map(np.array_equal, before, (r, c))):
            break  # every further sweep would find the same
    return int(t), r, c


def best_codes(magnitudes, scales):
    """The codes [I] of rows that need the fewest bits.

    `scales` [J] are what the codes are added to: the level plus the codes of the columns.
    """
    blocks = np.array_split(magnitudes, 1 + magnitudes.size // CHUNK)  # so that memory is bounded
    of_rows = [price(block, np.add.outer(CODES, scales)[:, None]).sum(axis=2) for block in blocks]
    return CODES[np.argmin(np.concatenate(of_rows, axis=1) + costs()[1][:, None], axis=0)]


def best_level_plainly(magnitudes, codes):
    """The level that needs the fewest bits; `codes` [I, J] are sums of row and column codes."""
    return LEVELS[np.argmin([price(magnitudes, t + codes).sum() for t in LEVELS])]


def best_level_fast(magnitudes, codes):
    """The same as `best_level_plainly`. A tensor has few different pairs of a magnitude and a code,
    so each pair is looked up once and its bits are multiplied by its count.
    """
    pairs, counts = np.unique(codes * MOST + magnitudes, return_counts=True)
    of_pairs = price(pairs % MOST, np.add.outer(LEVELS, pairs // MOST))
    return LEVELS[np.argmin(of_pairs @ counts)]
