"""The two kinds of entropy-coded sections: Gaussian streams and bit streams.

Three values of an attribute become a stream, given their step q and the Gaussian that the context
predicts for them, and are decoded from it:

    >>> import numpy as np
    >>> from p4dgs_ref.codec.streams import decode_gaussian, encode_gaussian
    >>> f, q = np.array([0.1, 2.6, -20.1]), 0.5
    >>> mu, sigma = 0.15, 0.75
    >>> symbols = np.rint(f / q).astype(np.int64)  # 0, 5, -40: Eq. (10)
    >>> mu_units = np.full(3, round(1024 * mu / q))
    >>> sigma_units = np.full(3, round(16 * np.log2(sigma / q)))
    >>> data = encode_gaussian(symbols, mu_units, sigma_units)
    >>> data.hex(" ")
    '80 cb 67 86 a4 03 00 00 00 ff ff ff 00 a0 05'
    >>> (decode_gaussian(data, mu_units, sigma_units) * q).tolist()
    [0.0, 2.5, -20.0]

In a file, encoder and decoder compute mu_units and sigma_units in integers alone (`context.py`).

GAUSSIAN STREAM. It contains n symbols, |k| <= 2^31, whose mu_units and sigma_units the decoder
already knows. The stream of no symbols is empty. Otherwise it has two parts:

1. The rANS message (`rans.py`) of the blocks K = floor(k / 2^low), each coded with the frequency
   table of its symbol (`gaussian_table.py`). A block outside the window is coded as the escape, the
   last entry of the table.

2. The raw bits, which fill every byte from its lowest bit on. Unused bits of the last byte are 0.

   a. For every symbol in order, its `low` low bits, lowest first. There are none if
      sigma / q < 32.

   b. For every escape in order, an integer v >= 1 in Elias's gamma code: with v = 2^b + r and
      r < 2^b, first b zeros, then a one, then the b bits of r, lowest first. Above the window
      v = 2 (K - (c+W+1)) + 1, below it v = 2 (c-W - K). b is at most 33.

Both parts are read exactly to their end. Anything left over is an error, and so is a symbol beyond
+-2^31.

BIT STREAM. It contains n bits that share one probability, and it is empty for n = 0. Otherwise it
begins with f, the probability of a one times 2^24, as a 4-byte little-endian integer. f = 0 means
that all bits are zero and f = 2^24 that all are one; nothing follows. For any other f the rANS
message of the n bits follows. Its only table has the keys 0, 2^24 - f, 2^24: entry 0 is a zero,
entry 1 a one. An encoder takes f = max(floor(ones * 2^24 / n), 1), and 0 if there are no ones.

Worked example. The symbols 0, 5 and -40 above have mu_units = 307 and sigma_units = 9, so c = 0 and
W = 13 (`gaussian_table.py`). -40 is coded as an escape with v = 2 (-13 + 40) = 54 = 2^5 + 22: its
raw bits are 00000 1 01101, the bytes A0 05. The whole stream is

    80  CB 67 86 A4 03 00 00 00  FF FF FF 00  A0 05

The bits 1 1 1 0 have f = 12582912, and their stream is 00 00 C0 00  80 00 00 40 BE 04 00 00 00.
"""

import numpy as np

from . import rans
from .container import expect
from .gaussian_table import CHUNK, PRECISION, gaussian_model

MAX_SYMBOL = 2**31  # magnitude of a coded number
MAX_GAMMA = 33  # of the b of an escape


def encode_gaussian(symbols, mu_units, sigma_units, lanes=None, push_rows=None):
    """Encode symbols [n], each under its own Gaussian, and return the stream (Eqs. 10 and 11).

    All three are one-dimensional arrays of integers. Any symbol up to 2^31 in magnitude can be
    coded, however improbable. `lanes` and `push_rows` are passed to `rans.encode`.
    """
    model = gaussian_model(mu_units, sigma_units)
    entries, gamma = find_entries(symbols, model)
    widths = model.low[model.table]
    codes, code_widths = gamma_fields(gamma)
    return rans.encode(entries, model.keys, lanes, push_rows) + pack_fields(
        np.concatenate([symbols & (1 << widths) - 1, codes]),
        np.concatenate([widths, code_widths]),
    )


def decode_gaussian(data, mu_units, sigma_units, section="stream", pop_rows=None):
    """Return the symbols [n] of a stream, int64.

    Raises BitstreamError for data that `encode_gaussian` does not write.
    """
    return decode_symbols(data, gaussian_model(mu_units, sigma_units), section, pop_rows)


def decode_symbols(data, model, section="stream", pop_rows=None):
    """Do what `decode_gaussian` does with a model already built, so mu and sigma can be freed."""
    entries, start = rans.decode(data, model.table, model.keys, 0, section, pop_rows)
    # In pieces, so that only a few bytes per symbol are in use at any time.
    pieces = [slice(a, a + CHUNK) for a in range(0, len(entries), CHUNK)]
    symbols, at = np.empty(len(entries), np.int64), 8 * start
    end = at + sum(int(model.low[model.table[rows]].sum()) for rows in pieces)
    expect(end <= 8 * len(data), section, len(data), "the data end before the last raw bit")
    for rows in pieces:
        table = model.table[rows]
        place, widths = entries[rows] - model.first[table], model.low[table]
        escaped = np.flatnonzero(place == model.blocks[table])
        gamma, end = read_gammas(data, end, len(escaped), section)
        place[escaped] = np.where(gamma & 1, place[escaped] + (gamma >> 1), -(gamma >> 1))
        low = raw_bits(data, at, at + int(widths.sum()))
        symbols[rows] = (model.lowest[rows] + place << widths) + unpack_fields(low, widths)
        at += len(low)
        expect(
            np.abs(symbols[rows]).max() <= MAX_SYMBOL,
            section,
            start,
            "a symbol beyond +-2^31",
        )
    expect_end(data, end, section)
    return symbols


def raw_bits(data, start, stop):
    """Return the bits from start to stop of bytes, lowest first, as an array of 0 and 1."""
    raw = np.frombuffer(data, np.uint8, (stop + 7) // 8 - start // 8, start // 8)
    return np.unpackbits(raw, bitorder="little")[start % 8 :][: stop - start]


def expect_end(data, end, section):
    """Refuse data in which anything but unused zeros follows bit `end`."""
    rest = raw_bits(data, end, min(end + 8, 8 * len(data)))
    expect(len(rest) < 8 and not rest.any(), section, end // 8, "bits left over")


def ideal_bits_gaussian(symbols, mu_units, sigma_units):
    """Return the bits [n] that symbols cost at their integer frequencies, escapes and raw bits too.

    Their sum is the entropy of the stream.
    """
    model = gaussian_model(mu_units, sigma_units)
    entries, gamma = find_entries(symbols, model)
    bits = PRECISION - np.log2(np.diff(model.keys)[entries]) + model.low[model.table]
    escaped = entries - model.first[model.table] == model.blocks[model.table]
    bits[escaped] += 2 * rans.bit_length(gamma) - 1
    return bits


def find_entries(symbols, model):
    """Return the entry of every symbol in the model's tables, and v of the escapes."""
    place = (symbols >> model.low[model.table]) - model.lowest
    blocks = model.blocks[model.table]
    escaped = np.flatnonzero((place < 0) | (place >= blocks))
    beyond = place[escaped] - blocks[escaped]
    gamma = np.where(beyond < 0, -2 * place[escaped], 2 * beyond + 1)
    place[escaped] = blocks[escaped]
    return model.first[model.table] + place, gamma


def gamma_fields(values):
    """Return gamma codes of integers as two fields each: b zeros and a one, then r in b bits."""
    b = rans.bit_length(values) - 1
    fields = np.stack([1 << b, values - (1 << b)], axis=1).ravel()
    return fields, np.stack([b + 1, b], axis=1).ravel()


def read_gammas(data, start, count, section):
    """Read `count` gamma codes from bit `start` on; return the values and the bit after them."""
    stop = min(start + (2 * MAX_GAMMA + 1) * count, 8 * len(data))
    text = raw_bits(data, start, stop).tobytes()
    digits = bytes.maketrans(b"\0\1", b"01")
    values, at = np.empty(count, np.int64), 0
    for i in range(count):
        one = text.find(1, at)
        end = 2 * one - at + 1
        expect(
            0 <= one - at <= MAX_GAMMA and end <= len(text),
            section,
            (start + at) // 8,
            "an escape of more than 33 bits, or the data end before its last bit",
        )
        # Read backwards, the digits from the one on are the binary number 2 r + 1.
        r = int(text[one:end].translate(digits)[::-1], 2) >> 1
        values[i] = (1 << one - at) + r
        at = end
    return values, start + at


def pack_fields(values, widths):
    """Return bytes of values [n] in widths [n] bits each, lowest bit first."""
    raw, first = np.zeros(int(widths.sum()), np.uint8), np.cumsum(widths) - widths
    for bit in range(int(widths.max(initial=0))):
        wide = widths > bit
        raw[first[wide] + bit] = values[wide] >> bit & 1
    return np.packbits(raw, bitorder="little").tobytes()


def unpack_fields(raw, widths):
    """Return the values [n] of fields of widths [n] bits at the start of raw, an array of bits."""
    values, first = np.zeros(len(widths), np.int64), np.cumsum(widths) - widths
    for bit in range(int(widths.max(initial=0))):
        wide = widths > bit
        values[wide] |= raw[first[wide] + bit].astype(np.int64) << bit
    return values


def encode_bits(bits, lanes=None):
    """Encode booleans [n] that share one probability, and return the stream (Eq. 14)."""
    if len(bits) == 0:
        return b""
    f = probability_of_one(int(bits.sum()), len(bits))
    certain = f in (0, rans.CERTAIN)
    message = b"" if certain else rans.encode(bits.astype(np.int64), bit_keys(f), lanes)
    return f.to_bytes(4, "little") + message


def probability_of_one(ones, count):
    """Return f of the format above: 0 and 2^24 only if all bits are equal."""
    return max((ones << PRECISION) // count, 1) if ones else 0


def bit_keys(f):
    """Return the frequency table of a bit."""
    return np.array([0, rans.CERTAIN - f, rans.CERTAIN], np.int64)


def decode_bits(data, count, section="stream"):
    """Return the booleans [count] of a stream.

    Raises BitstreamError for data that `encode_bits` does not write.
    """
    end = 4 if count else 0
    expect(len(data) >= end, section, len(data), "the data end before the probability")
    f = int.from_bytes(data[:end], "little")
    expect(f <= rans.CERTAIN, section, 0, f"a probability of {f} / 2^24, expected at most 1")
    if f in (0, rans.CERTAIN):
        bits = np.full(count, f == rans.CERTAIN)
    else:
        bits, end = rans.decode(data, np.zeros(count, np.uint8), bit_keys(f), end, section)
    expect(len(data) == end, section, end, f"{len(data) - end} bytes left over")
    return bits.astype(bool)
