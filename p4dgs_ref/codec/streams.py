"""One section of symbols as bytes: Gaussian symbols with their own mean and deviation, and plain bits.

GAUSSIAN STREAM.  n symbols, |k| <= 2^31, whose mu_units and sigma_units the decoder already knows.
    1. the rANS message (`rans`) of the n blocks K = floor(k / 2^low), each from its own table (`gaussian_table`);
       a block outside its window is coded as the table's last entry, the escape;
    2. the raw bits, packed from the lowest bit of each byte on; the last byte is filled up with zeros:
       a. for every symbol in order, its `low` low bits, lowest first (none where sigma/q < 32);
       b. for every escape in order, v >= 1 in Elias's gamma code: with v = 2^b + r, b zeros, a one, and the b bits of
          r, lowest first.  v = 2 (K - (c+W+1)) + 1 above the window, v = 2 (c-W - K) below it; b <= 33.
Both parts are read exactly to their end; anything left over is an error, and so is a symbol beyond +-2^31.  The stream of
no symbols is empty.

BIT STREAM.  n bits.  Nothing for n = 0; else f, the probability of a one times 2^24 (4 bytes, little-endian).
f = 0: all bits are zero; f = 2^24: all are one; nothing follows.  Otherwise the rANS message of the n bits with the one
table keys = 0, 2^24 - f, 2^24; entry 0 is a zero, entry 1 a one.  The encoder takes f = max(floor(ones * 2^24 / n), 1).

WORKED NUMBERS.  Symbols 0, 5, -40, each with mu_units = 307, sigma_units = 9, so c = 0, W = 13 (`gaussian_table`).
-40 is an escape with v = 2 (-13 + 40) = 54 = 2^5 + 22: raw bits 00000 1 01101, bytes A0 05.  The whole stream:
    80  CB 67 86 A4 03 00 00 00  FF FF FF 00  A0 05
The bits 1 1 1 0: f = 12582912.  The whole stream: 00 00 C0 00  80 00 00 40 BE 04 00 00 00
"""

import numpy as np

from . import rans
from .container import BitstreamError
from .gaussian_table import CHUNK, PRECISION, gaussian_model

MAX_SYMBOL, MAX_GAMMA, CERTAIN = 1 << 31, 33, 1 << PRECISION


def encode_gaussian(symbols, mu_units, sigma_units, lanes=None, push_rows=None):
    """Code integer symbols under their own Gaussians.

    Shapes     symbols, mu_units, sigma_units (n,) integers -> bytes
    Units      symbols and mu in multiples of q; see `gaussian_table` for mu_units and sigma_units
    Domain     |symbols| <= 2^31, whatever the model says; `lanes`, `push_rows` as in `rans.encode`
    Raises     ValueError for other dtypes, shapes or ranges
    Reference  P-4DGS Eqs. (10), (11)
    """
    model = gaussian_model(mu_units, sigma_units)
    entries, gamma = _find_entries(symbols, model)
    widths = model.low[model.table]
    low = pack_fields(symbols & (1 << widths) - 1, widths, *_gamma_fields(gamma))
    return rans.encode(entries, model.keys, lanes, push_rows) + low


def decode_gaussian(data, mu_units, sigma_units, section="stream", pop_rows=None):
    """The symbols again.

    Shapes     data bytes, mu_units, sigma_units (n,) integers -> symbols (n,) int64
    Raises     BitstreamError(section, ...) where data are not what `encode_gaussian` writes;
               ValueError for mu_units and sigma_units outside their ranges
    """
    return decode_symbols(data, gaussian_model(mu_units, sigma_units), section, pop_rows)


def decode_symbols(data, model, section="stream", pop_rows=None):
    """`decode_gaussian` for a model already made, so that mu and sigma need not be kept while it runs."""
    entries, start = rans.decode(data, model.table, model.keys, 0, section, pop_rows)
    pieces = [
        slice(a, a + CHUNK) for a in range(0, len(entries), CHUNK)
    ]  # few bytes a symbol at any time
    low_bits = sum(int(model.low[model.table[rows]].sum()) for rows in pieces)
    escapes = sum(np.count_nonzero(entries[rows] == _escape(model, rows)) for rows in pieces)
    if len(data) - start > (low_bits + (2 * MAX_GAMMA + 1) * escapes + 7) // 8:
        raise BitstreamError(section, len(data), "bytes left over")
    if low_bits > 8 * (len(data) - start):
        raise BitstreamError(section, len(data), "the data end before the last raw bit")
    symbols, at, end = np.empty(len(entries), np.int64), 8 * start, 8 * start + low_bits
    for rows in pieces:
        table = model.table[rows]
        place, widths = entries[rows] - model.first[table], model.low[table]
        escaped, count = np.flatnonzero(entries[rows] == _escape(model, rows)), int(widths.sum())
        gamma, end = _read_gammas(data, end, len(escaped), section)
        place[escaped] = np.where(gamma & 1, place[escaped] + (gamma >> 1), -(gamma >> 1))
        symbols[rows] = (model.lowest[rows] + place << widths) + unpack_fields(
            _raw_bits(data, at, at + count), widths
        )
        at += count
        wrong = symbols[rows][np.abs(symbols[rows]) > MAX_SYMBOL]
        if len(wrong):
            raise BitstreamError(
                section, start, f"symbol {wrong[0]}, at most 2^31 in magnitude expected"
            )
    left = _raw_bits(data, end, 8 * len(data))
    if len(left) >= 8 or left.any():
        raise BitstreamError(section, end // 8, "bits left over")
    return symbols


def _escape(model, rows):
    """The entry that would be an escape, for each of some symbols."""
    return (model.first + model.blocks)[model.table[rows]]


def _raw_bits(data, start, stop):
    """Bits start to stop of bytes, the lowest of a byte first: an array of 0 and 1."""
    raw = np.frombuffer(data, np.uint8, (stop + 7) // 8 - start // 8, start // 8)
    return np.unpackbits(raw, bitorder="little")[start % 8 :][: stop - start]


def ideal_bits_gaussian(symbols, mu_units, sigma_units):
    """Bits of each symbol under the integer frequencies, escapes and raw bits included.

    Shapes     as `encode_gaussian` -> bits (n,) float64; their sum is the entropy of the stream
    """
    model = gaussian_model(mu_units, sigma_units)
    entries, gamma = _find_entries(symbols, model)
    bits = PRECISION - np.log2(np.diff(model.keys)[entries]) + model.low[model.table]
    bits[entries - model.first[model.table] == model.blocks[model.table]] += (
        2 * _bit_length(gamma) - 1
    )
    return bits


def _find_entries(symbols, model):
    """The entry of every symbol, and v of the escapes."""
    if symbols.dtype.kind != "i" or symbols.shape != model.table.shape:
        raise ValueError(
            f"symbols: signed integers of shape {model.table.shape} expected, "
            f"got {symbols.dtype} {symbols.shape}"
        )
    wrong = np.flatnonzero((symbols > MAX_SYMBOL) | (symbols < -MAX_SYMBOL))
    if len(wrong):
        raise ValueError(
            f"symbols[{wrong[0]}] = {symbols[wrong[0]]}: at most 2^31 in magnitude expected"
        )
    place = (symbols >> model.low[model.table]) - model.lowest
    blocks = model.blocks[model.table]
    escaped = np.flatnonzero((place < 0) | (place >= blocks))
    beyond = place[escaped] - blocks[escaped]
    gamma = np.where(beyond < 0, -2 * place[escaped], 2 * beyond + 1)
    place[escaped] = blocks[escaped]
    return model.first[model.table] + place, gamma


def _bit_length(values):
    return np.frexp(values.astype(np.float64))[1].astype(np.int64)  # exact: values below 2^53


def _gamma_fields(gamma):
    """Gamma codes as fields: b zeros and a one, then r in b bits."""
    b = _bit_length(gamma) - 1
    return [np.stack([1 << b, gamma - (1 << b)], 1).ravel(), np.stack([b + 1, b], 1).ravel()]


def _read_gammas(data, start, count, section):
    """`count` gamma codes from bit `start` of the data on: values (count,) and the bit after the last."""
    text = _raw_bits(data, start, min(start + (2 * MAX_GAMMA + 1) * count, 8 * len(data))).tobytes()
    at, values, ascii_bits = 0, np.empty(count, np.int64), bytes.maketrans(b"\0\1", b"01")
    for i in range(count):
        one = text.find(1, at, at + MAX_GAMMA + 1)
        if one < 0 and len(text) - at > MAX_GAMMA:
            raise BitstreamError(
                section, (start + at) // 8, f"an escape of more than {MAX_GAMMA} bits"
            )
        b = one - at
        if one < 0 or one + b >= len(text):
            raise BitstreamError(section, len(data), "the data end before the last raw bit")
        at = one + b + 1
        values[i] = (1 << b) + (
            int(text[one:at].translate(ascii_bits)[::-1], 2) >> 1
        )  # backwards it reads 2 r + 1
    return values, start + at


def pack_fields(values, widths, more_values, more_widths):
    """Bytes of values (n,) in widths (n,) bits each, lowest bit first, and of more such fields behind them."""
    values, widths = np.concatenate([values, more_values]), np.concatenate([widths, more_widths])
    raw, first = np.zeros(int(widths.sum()), np.uint8), np.cumsum(widths) - widths
    for bit in range(int(widths.max(initial=0))):
        wide = widths > bit
        raw[first[wide] + bit] = values[wide] >> bit & 1
    return np.packbits(raw, bitorder="little").tobytes()


def unpack_fields(raw, widths):
    """Values (n,) of fields of widths (n,) bits at the start of raw, an array of bits."""
    values, first = np.zeros(len(widths), np.int64), np.cumsum(widths) - widths
    for bit in range(int(widths.max(initial=0))):
        wide = widths > bit
        values[wide] |= raw[first[wide] + bit].astype(np.int64) << bit
    return values


def encode_bits(bits, lanes=None):
    """Code bits that share one probability.

    Shapes     bits (n,) bool -> bytes
    Raises     ValueError for other dtypes or shapes
    Reference  P-4DGS Eq. (14)
    """
    if bits.dtype != bool or bits.ndim != 1:
        raise ValueError(f"bits: booleans in one axis expected, got {bits.dtype} {bits.shape}")
    if len(bits) == 0:
        return b""
    f = probability_of_one(int(bits.sum()), len(bits))
    message = b"" if f in (0, CERTAIN) else rans.encode(bits.astype(np.int64), _bit_keys(f), lanes)
    return f.to_bytes(4, "little") + message


def probability_of_one(ones, count):
    """f of the format above: 0 and 2^24 only where all bits are equal."""
    return max((ones << PRECISION) // count, 1) if ones else 0


def _bit_keys(f):
    return np.array([0, CERTAIN - f, CERTAIN], np.int64)


def decode_bits(data, count, section="stream"):
    """The bits again.

    Shapes     data bytes -> bits (count,) bool
    Raises     BitstreamError(section, ...) where data are not what `encode_bits` writes
    """
    end = 4 if count else 0
    if len(data) < end:
        raise BitstreamError(section, len(data), "the data end before the probability")
    f = int.from_bytes(data[:end], "little")
    if f > CERTAIN:
        raise BitstreamError(section, 0, f"a probability of {f} / 2^24")
    if f in (0, CERTAIN):
        bits = np.full(count, f == CERTAIN)
    else:
        entries, end = rans.decode(data, np.zeros(count, np.uint8), _bit_keys(f), end, section)
        bits = entries.astype(bool)
    if len(data) != end:
        raise BitstreamError(section, end, f"{len(data) - end} bytes left over")
    return bits
