"""Hard cases of the codec: rows H-Q2 to H-Q6 and H-E1 to H-E9, each really encoded and decoded.

The codec codes symbols, the integers that Eq. (10) makes of attributes. The precision of a case is
therefore that of the attributes. Errors are counts, or sizes of the decoded numbers.
"""

import hashlib
import json
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from p4dgs_ref.codec import published
from p4dgs_ref.codec.container import BitstreamError, open_container, write_container
from p4dgs_ref.codec.file import decode, encode, quantised_of
from p4dgs_ref.codec.gaussian_table import (
    MU_BITS,
    SIGMA_BITS,
    SIGMA_MAX,
    SIGMA_MIN,
    build_keys,
    gaussian_model,
)
from p4dgs_ref.codec.quantise import EncodeError, quantise, underflows
from p4dgs_ref.codec.rans import PRECISION
from p4dgs_ref.codec.streams import decode_gaussian, encode_gaussian, ideal_bits_gaussian
from p4dgs_ref.equations import rounding
from p4dgs_ref.model import LATTICE, join, snap
from p4dgs_ref.report.inspect import float_context
from tests.golden.sample_model import sample_model

from .verdicts import exact, refuses


def _model(dtype, seed=5, anchors=24):
    """A small model whose attributes have passed through the given precision."""
    model = sample_model(seed, anchors)
    arrays = model.anchors._asdict()
    rounded = {name: a.astype(dtype) for name, a in arrays.items() if name not in ("x_a", "mask")}
    return replace(model, anchors=model.anchors._replace(**rounded))


def _decoded(model):
    """The quantised model that a decoder finds in the model's file."""
    return quantised_of(open_container(encode(model)))


def _coded(symbols, mu_units=0, sigma_units=0):
    """Symbols encoded and decoded again, the bytes, and the ideal number of bits."""
    symbols = np.asarray(symbols, np.int64)
    units = [np.full(len(symbols), value, np.int64) for value in (mu_units, sigma_units)]
    data = encode_gaussian(symbols, *units)
    return decode_gaussian(data, *units), data, ideal_bits_gaussian(symbols, *units).sum()


def _rounded(values, q, dtype):
    """Eq. (10) in the given precision: the symbols of a vector."""
    (symbols, _), _ = rounding.forward(np.array([values], dtype), np.array([[q]], dtype))
    return symbols[0]


# --- the quantiser -------------------------------------------------------------------------------
def transmitted(dtype):
    """A decoder multiplies by q, so no value flips; rounding the values again flips some."""
    q = quantise(_model(dtype))
    decoded = _decoded(q.model)
    features, steps, symbols = join(q.model.anchors)[:, :3], q.context.q[:, :1], q.symbols[:, :3]
    again = np.floor(features / steps + 0.5)
    one_ulp = np.floor(features / np.nextafter(q.context.q, 9)[:, :1])
    flipped = np.count_nonzero(again != symbols) + np.count_nonzero(one_ulp != symbols)
    wrong = np.count_nonzero(join(decoded.model.anchors) != join(q.model.anchors))
    wrong += np.count_nonzero(decoded.symbols != q.symbols)
    return exact(f"{flipped} flipped", f"{wrong} flipped", "0 flipped", wrong)


def large_symbols(dtype):
    """Large symbols come back; those beyond 2^31 are refused with their index."""
    q, want = 0.25, np.array([15_001, -20_000, 32_767, 32_768, -40_000, 2**24, -(2**30)])
    back, *_ = _coded(_rounded(want * q, q, dtype))
    wrong = np.count_nonzero(back != want)
    for value in (2.0**32 * q, -(2.0**40) * q, np.inf, np.nan):
        pair = [0.0, value]
        wrong += not refuses(lambda: _rounded(pair, q, dtype), OverflowError, "f[0, 1]")
    return exact(int(want[4].astype(np.int16)), int(back[4]), int(want[4]), wrong)


def step_of_decoder(dtype):
    """A step is a whole number of units, so encoder and decoder have the same one."""
    q = quantise(_model(dtype))
    decoded = _decoded(_model(dtype))
    nudged = np.nextafter(q.context.q, 9)
    symbols = q.symbols[:, :3]
    moved = np.abs(symbols * nudged[:, :1] - symbols * q.context.q[:, :1]).max()
    error = float(np.abs(decoded.context.q - q.context.q).max())
    return exact(float(moved), error, 0.0, error)


def positions(dtype):
    """Positions come back within half a step, points of the lattice exactly."""
    worst, literal = 0.0, 0.0
    cloud = np.random.default_rng(3).uniform(-1, 1, size=(40, 3))
    flat, one, same = cloud * [1, 0, 1] + [0, 0.3, 0], cloud[:1], np.repeat(cloud[:1], 9, axis=0)
    for x_a in (flat, one, same, cloud * 1e-20, cloud * 1e8):
        x_a = x_a.astype(dtype)
        lo, hi = x_a.min(axis=0).astype(np.float32), x_a.max(axis=0).astype(np.float32)
        inside = np.clip(x_a.astype(float), lo, hi)
        symbols, back = snap(inside, lo, hi)
        half = (hi.astype(float) - lo) / LATTICE / 2
        allowed = half * (1 + 1e-9) + 4e-16 * np.abs(inside)
        beyond = (np.abs(back - inside) - allowed).max()
        worst = max(worst, float(beyond), float(np.abs(snap(back, lo, hi)[0] - symbols).max()))
        with np.errstate(all="ignore"):
            literal = np.nan if np.isnan((x_a - lo) / (hi - lo)).any() else literal
    return exact(str(literal), worst, 0.0, worst)


def half_weights(dtype):
    """Weights are stored as float16: too large ones are refused, underflows are counted."""
    model, refused, lost = _model(dtype), 0, 0
    name = next(iter(model.networks))
    for value in (7e4, np.nan, np.inf, 1e-8):
        weights, biases = model.networks[name]
        weights = [np.array(W, dtype) for W in weights]
        weights[0][0, 0] = value
        changed = replace(model, networks={**model.networks, name: (weights, biases)})
        if refuses(lambda: encode(changed), EncodeError, name):
            refused += 1
        else:
            lost += underflows(changed.networks) - underflows(model.networks)
    error = abs(3 - refused) + abs(1 - lost)
    # Literal is 7e4 as float16.
    return exact("inf", f"{refused} refused, {lost} lost", "3 refused, 1 lost", error)


# --- the entropy coder ---------------------------------------------------------------------------
def short_messages(dtype):
    """No symbol, one symbol, an alphabet of one."""
    wrong = size = 0
    for symbols, mu, sigma in (
        ([], 0, 0),
        ([0], 0, 0),
        ([-3], -3 << MU_BITS, SIGMA_MIN),
        ([7] * 5, 7 << MU_BITS, SIGMA_MIN),
    ):
        symbols = _rounded([s * 0.5 for s in symbols], 0.5, dtype)
        back, data, _ = _coded(symbols, mu, sigma)
        wrong += not np.array_equal(back, symbols)
        size += len(data)
    # Literal is 0/0 bits per symbol.
    return exact("nan", f"{wrong} wrong, {size} bytes", "0 wrong", wrong + (size > 40))


def improbable(dtype):
    """Every symbol has a frequency of at least 1."""
    symbols = _rounded(np.array([9, -9, 11, 13, -40, 5000]) * 0.5, 0.5, dtype)
    back, *_ = _coded(symbols)
    model = gaussian_model(np.zeros(1, np.int64), np.zeros(1, np.int64))
    least = int(np.diff(model.keys).min())
    in_16_bits = np.floor(65536 * np.diff(ndtr(np.array([8.5, 9.5]))))[0]
    wrong = np.count_nonzero(back != symbols) + (least < 1)
    return exact(float(in_16_bits), float(least), 1.0, wrong)


def totals(dtype):
    """The frequencies of all tables add up."""
    deviations = np.arange(SIGMA_MIN, SIGMA_MAX + 1)
    places = np.arange(0, 1024, 16)
    keys, first = build_keys(np.repeat(deviations, len(places)), np.tile(places, len(deviations)))
    frequencies = np.diff(keys)
    sums = np.add.reduceat(frequencies, first)
    wrong = np.count_nonzero(sums != 1 << PRECISION) + np.count_nonzero(frequencies < 1)
    p = np.exp(-0.5 * np.arange(-12.0, 13) ** 2).astype(dtype)
    literal = int(np.rint(p / p.sum() * 2**PRECISION).sum())
    return exact(literal, int(sums[0]), 1 << PRECISION, wrong)


def escapes(dtype):
    """Symbols outside their table come back, at the cost that was counted."""
    symbols = _rounded(np.array([0, 5, -40, 10**6, -(10**8), 2**30, 14, -14]) * 2.0, 2.0, dtype)
    back, data, counted = _coded(symbols, 307, 9)
    clipped = np.count_nonzero(np.clip(symbols, -13, 13) != symbols)  # the table reaches to 13 here
    wrong = np.count_nonzero(back != symbols) + (8 * len(data) > counted + 80)
    return exact(f"{clipped} clipped", 8 * len(data), float(counted), wrong)


def long_messages(dtype):
    """A million symbols take at most 0.1 % and 8 bytes more than their entropy."""
    wrong, n, sizes = 0, 10**6, []
    for values, mu, sigma in (
        (np.full(n, 3.5), 7 << MU_BITS, SIGMA_MIN),
        (0.5 * (np.arange(n) % 2), 512, SIGMA_MIN),
        (np.full(n, -0.5), 5 << MU_BITS, 2 << SIGMA_BITS),
    ):
        symbols = _rounded(values, 0.5, dtype)
        back, data, bits = _coded(symbols, mu, sigma)
        sizes.append((float(len(data)), float(bits / 8)))
        wrong += np.count_nonzero(back != symbols) + (len(data) > 1.001 * bits / 8 + 8)
    return exact(n / 8, *sizes[0], wrong)


def damaged(dtype):
    """Damaged files are refused; literal is how many decode if the checksums fit the damage."""
    data = encode(_model(dtype))
    broken = [data[:n] for n in (0, 10, len(data) // 2, len(data) - 1)]
    broken += [data + b"\0", *_flipped(data)]
    refused = sum(map(_refused, broken))
    sections = open_container(data)
    bodies = list(_flipped(bytes(sections["features"])))
    silent = sum(not _refused(write_container({**sections, "features": body})) for body in bodies)
    return exact(
        f"{silent} of {len(bodies)} decode",
        f"{refused} of {len(broken)} refused",
        "all refused",
        len(broken) - refused,
    )


def _flipped(data):
    """Copies of the data with one bit flipped, one for each byte."""
    for i in range(len(data)):
        yield data[:i] + bytes([data[i] ^ 16]) + data[i + 1 :]


def _refused(data):
    """Whether the decoder refuses the data."""
    return refuses(lambda: decode(data), BitstreamError)


def same_bytes(dtype):
    """Published streams are encoded again to the same bytes."""
    manifest = json.loads((published.FOLDER / "manifest.json").read_text(encoding="utf-8"))
    wrong = 0
    for row in manifest["good"]:
        if row["name"] not in ("full", "static", "hashed", "deviations"):
            continue
        model = decode((published.FOLDER / row["file"]).read_bytes())
        f_a = model.anchors.f_a.astype(dtype)
        again = encode(replace(model, anchors=model.anchors._replace(f_a=f_a)))
        wrong += hashlib.sha256(again).hexdigest() != row["sha256"]
    h, W = np.random.default_rng(2).normal(size=(2, 40, 40)).astype(dtype)
    other_order = h[:, ::-1] @ W[::-1]  # as another library may add
    differ = np.count_nonzero(h @ W != other_order)
    return exact(f"{differ} of {h.size} sums differ", f"{wrong} differ", "0 differ", wrong)


def one_ulp(dtype):
    """The integer context is the same on both sides; 16-bit bounds made of floats would move."""
    model = _model(dtype, anchors=400)
    context = float_context(model)
    mu, sigma = context.mu.astype(dtype).ravel(), context.sigma.astype(dtype).ravel()
    q = np.repeat(context.q, model.design.widths, axis=1).astype(dtype).ravel()

    def bounds(mu, sigma):
        return np.rint(65536 * ndtr((q * np.rint(mu / q) + q / 2 - mu) / sigma))

    up = mu.dtype.type(np.inf)
    nudged = bounds(np.nextafter(mu, up), np.nextafter(sigma, up))
    moved = np.count_nonzero(nudged != bounds(mu, sigma))
    ours, theirs = quantise(model).context, _decoded(model).context
    wrong = np.count_nonzero(ours.mu_units != theirs.mu_units)
    wrong += np.count_nonzero(ours.sigma_units != theirs.sigma_units)
    return exact(f"{moved} of {mu.size} bounds moved", f"{wrong} moved", "0 moved", wrong)


def wide_symbols(dtype):
    """Symbols at the limits of integer types come back."""
    edges = [np.array([2**bits - 1, 2**bits, 2**bits + 1]) for bits in (15, 16, 23)]
    want = np.concatenate([sign * edge for edge in edges for sign in (1, -1)])
    symbols = _rounded(want * 0.5, 0.5, dtype)
    wrong = sum(np.count_nonzero(_coded(symbols, 0, s)[0] != want) for s in (0, SIGMA_MAX))
    widest, *_ = _coded([2**31, -(2**31)])
    wrong += np.count_nonzero(np.abs(widest) != 2**31)
    return exact(int(np.array(2**15).astype(np.int16)), int(_coded([2**15])[0][0]), 2**15, wrong)


CODING = {
    "H-Q2.transmitted": transmitted,
    "H-Q3.large": large_symbols,
    "H-Q4.step": step_of_decoder,
    "H-Q5.positions": positions,
    "H-Q6.float16": half_weights,
    "H-E1.short": short_messages,
    "H-E2.improbable": improbable,
    "H-E3.totals": totals,
    "H-E4.escapes": escapes,
    "H-E5.long": long_messages,
    "H-E6.damaged": damaged,
    "H-E7.bytes": same_bytes,
    "H-E8.one_ulp": one_ulp,
    "H-E9.int16": wide_symbols,
}
