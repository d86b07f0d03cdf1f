"""B2: positions of few bits per axis, sorted along a curve through the box.

Only the gaps between sorted positions are coded. The anchors of a model may stand in any order, and
the order of A anchors is worth log2(A!) bits. Sorted anchors need not pay for it. All other
sections follow the same order.

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
"""

import numpy as np

from ..codec import rans
from ..codec.container import require
from ..codec.plain import BOX_BYTES, read_box, write_box
from ..codec.streams import (
    MAX_GAMMA,
    expect_end,
    gamma_fields,
    pack_fields,
    raw_bits,
    read_gammas,
    unpack_fields,
)
from ..model import LATTICE, share_of, unsnap


def snap(x_a, lo, hi, bits):
    """Like `model.snap`, on a lattice of `bits` bits per axis."""
    m = np.rint(share_of(x_a, lo, hi) * ((1 << bits) - 1)).astype(np.int64)
    symbols = of_16_bits(m, bits)
    return symbols, unsnap(symbols, lo, hi)


def of_16_bits(m, bits):
    """The symbols of 16 bits of coordinates m on a lattice of `bits` bits, rounded to nearest."""
    most = (1 << bits) - 1
    return (m * LATTICE + most // 2) // most


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


def write_positions(model, positions):
    """The section of a model. The positions [A, 3] stand in ascending order of their codes."""
    return write_sorted(positions, model.box, model.design.position_bits)


def write_sorted(positions, box, bits):
    """The section of positions [A, 3] in ascending order of their codes."""
    gaps = np.diff(codes_of(positions, box, bits), prepend=0)
    most = bits * len(extended(box))
    choices = range(max(most - MAX_GAMMA, 0), most + 1)
    r = min(choices, key=lambda r: int((r + 2 * rans.bit_length((gaps >> r) + 1)).sum()))
    high, widths = gamma_fields((gaps >> r) + 1)
    coded = pack_fields(
        np.concatenate([gaps & (1 << r) - 1, high]),
        np.concatenate([np.full(len(gaps), r), widths]),
    )
    return write_box(box) + bytes([r]) + coded


def read_positions(data, count, design):
    """The box, and the positions [count, 3] of 16 bits, int64.

    Raises BitstreamError for data that `write_positions` does not write.
    """
    return read_sorted(data, count, design.position_bits)


def read_sorted(data, count, bits):
    """The same, from the number of bits of a coordinate."""
    name, start = "positions", BOX_BYTES
    message = f"expected {start} bytes or more for {count} anchors, found {len(data)}"
    require(len(data) >= start, name, len(data), message)
    box = read_box(data)
    axes = extended(box)[::-1]
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
    return box, of_16_bits(m, bits)
