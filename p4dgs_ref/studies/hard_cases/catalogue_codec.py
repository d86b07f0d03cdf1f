"""Hard cases of the codec: rows H-Q2 to H-Q6 and H-E1 to H-E9, each really encoded and decoded.

What is coded are symbols: whole numbers that Eq. (10) makes of attributes.  A precision is that of the attributes, so a row
begins with floats of that precision, and errors are counts or sizes of what comes back.
"""

import hashlib
import json
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from ...codec import published
from ...codec.container import BitstreamError, open_container, write_container
from ...codec.file import decode, encode, quantised_of
from ...codec.gaussian_table import (
    MU_BITS,
    SIGMA_BITS,
    SIGMA_MAX,
    SIGMA_MIN,
    build_keys,
    gaussian_model,
)
from ...codec.inspect import float_context
from ...codec.quantise import EncodeError, quantise, underflows
from ...codec.rans import PRECISION
from ...codec.streams import decode_gaussian, encode_gaussian, ideal_bits_gaussian
from ...equations import rounding
from ...model import LATTICE, join, snap
from ..random_inputs import sample_model
from .entry import DTYPES, Entry, Measured


def _model(dtype, seed=5, anchors=24):
    """A small model whose attributes have passed through the given precision."""
    model = sample_model(seed, anchors)
    return replace(
        model,
        anchors=model.anchors._replace(
            **{
                name: a.astype(DTYPES[dtype])
                for name, a in model.anchors._asdict().items()
                if a.dtype.kind == "f" and name != "x_a"
            }
        ),
    )


def _count(literal, ours, true, error):
    """Counts and sizes that must be exactly right."""
    return Measured(literal, ours, true, float(error), None, 0.0, None)


def _through(symbols, mu_units=0, sigma_units=0):
    """Symbols encoded and decoded again, and the bytes."""
    symbols = np.asarray(symbols, np.int64)
    mu, sigma = (np.full(len(symbols), v, np.int64) for v in (mu_units, sigma_units))
    data = encode_gaussian(symbols, mu, sigma)
    return decode_gaussian(data, mu, sigma), data


def _rounded(values, q, dtype):
    """Eq. (10) in the given precision: symbols (n,)."""
    return rounding.forward(np.array([values], DTYPES[dtype]), np.array([[q]], DTYPES[dtype]))[
        0
    ].symbols[0]


# --- the quantiser -------------------------------------------------------------------------------------------------------
def transmitted(dtype):
    """Values on multiples of q: rounding them again flips some; a decoder multiplies."""
    q = quantise(_model(dtype))
    decoded = quantised_of(open_container(encode(q.model)))
    again = np.floor(join(q.model.anchors)[:, :3] / q.context.q[:, :1] + 0.5).astype(
        np.int64
    )  # C's floor(x + 1/2)
    step_ulp = np.floor(join(q.model.anchors)[:, :3] / np.nextafter(q.context.q[:, :1], 9)).astype(
        np.int64
    )
    changed = int((again != q.symbols[:, :3]).sum() + (step_ulp != q.symbols[:, :3]).sum())
    wrong = int(
        (join(decoded.model.anchors) != join(q.model.anchors)).sum()
        + (decoded.symbols != q.symbols).sum()
    )
    return _count(f"{changed} flipped", f"{wrong} flipped", "0 flipped", wrong)


def large_symbols(dtype):
    """|f/q| beyond 15000 and 32767 comes back, beyond 2^31 is refused by name; literal is int16."""
    q, want = 0.25, np.array([15_001, -20_000, 32_767, 32_768, -40_000, 2**24, -(2**30)])
    symbols = _rounded(want * q, q, dtype)
    back, _ = _through(symbols)
    refused = 0
    for value in (2.0**31 * q, -(2.0**40) * q, np.inf, np.nan):
        try:
            _rounded([0.0, value], q, dtype)
        except OverflowError as error:
            refused += "f[0, 1]" in str(error)
    wrong = int((back != want).sum()) + 4 - refused
    return _count(int(np.array(want[4]).astype(np.int16)), int(back[4]), int(want[4]), wrong)


def step_of_decoder(dtype):
    """A step one ulp off at the decoder; ours is a whole number of units on both sides."""
    model = _model(dtype)
    q = quantise(model)
    decoded = quantised_of(open_container(encode(model)))
    nudged = np.nextafter(q.context.q, 9)
    off = float(
        np.abs(q.symbols[:, :3] * nudged[:, :1] - q.symbols[:, :3] * q.context.q[:, :1]).max()
    )
    error = float(np.abs(decoded.context.q - q.context.q).max())
    return _count(off, error, 0.0, error)


def positions(dtype):
    """Flat boxes, one anchor, coincident ones: 0/0; within half a step, lattice points exact."""
    worst, literal = 0.0, 0.0
    rng = np.random.default_rng(3)
    cloud = rng.uniform(-1, 1, size=(40, 3))
    for x_a in (
        cloud * [1, 0, 1] + [0, 0.3, 0],
        cloud[:1],
        np.repeat(cloud[:1], 9, axis=0),
        cloud * 1e-20,
        cloud * 1e8,
    ):
        x_a = x_a.astype(DTYPES[dtype])
        lo, hi = x_a.min(axis=0).astype(np.float32), x_a.max(axis=0).astype(np.float32)
        inside = np.clip(x_a.astype(float), lo, hi)
        symbols, back = snap(inside, lo, hi)
        half = (hi.astype(float) - lo) / LATTICE / 2
        allowed = half * (1 + 1e-9) + 4e-16 * np.abs(inside)
        worst = max(worst, float(np.max(np.abs(back - inside) - allowed)))
        worst = max(
            worst, float(np.abs(snap(back, lo, hi)[0] - symbols).max())
        )  # lattice points stay
        with np.errstate(all="ignore"):
            literal = np.nan if np.isnan((x_a - lo) / (hi - lo)).any() else literal
    return _count(str(literal), max(worst, 0.0), 0.0, max(worst, 0.0))


def half_weights(dtype):
    """Weights of 7e4, NaN and infinity are refused, 1e-8 is counted as lost."""
    model, refused = _model(dtype), 0
    name = next(iter(model.networks))
    small = 0
    for value in (7e4, np.nan, np.inf, 1e-8):
        weights, biases = model.networks[name]
        weights = [np.array(W, DTYPES[dtype]) for W in weights]
        weights[0][0, 0] = value
        changed = replace(model, networks={**model.networks, name: (weights, biases)})
        try:
            encode(changed)
            small += underflows(changed.networks) - underflows(model.networks)
        except EncodeError as error:
            refused += name in str(error)
    with np.errstate(over="ignore"):
        literal = str(float(np.float16(7e4)))
    return _count(
        literal,
        f"{refused} refused, {small} lost",
        "3 refused, 1 lost",
        abs(3 - refused) + abs(1 - small),
    )


# --- the entropy coder ---------------------------------------------------------------------------------------------------
def short_messages(dtype):
    """No symbol, one symbol, an alphabet of one; literal is bits per symbol of none."""
    wrong = size = 0
    for symbols, mu, sigma in (
        ([], 0, 0),
        ([0], 0, 0),
        ([-3], -3 << MU_BITS, SIGMA_MIN),
        ([7] * 5, 7 << MU_BITS, SIGMA_MIN),
    ):
        symbols = _rounded([s * 0.5 for s in symbols], 0.5, dtype)
        back, data = _through(symbols, mu, sigma)
        wrong, size = wrong + int(not np.array_equal(back, symbols)), size + len(data)
    with np.errstate(invalid="ignore"):
        literal = str(
            np.divide(DTYPES[dtype](0), DTYPES[dtype](0))
        )  # bits per symbol of no symbols
    return _count(literal, f"{wrong} wrong, {size} bytes", "0 wrong", wrong + (size > 40))


def improbable(dtype):
    """Symbols of probability below 2^-16; literal is the frequency of 9 sigma in 16 bits."""
    symbols = _rounded(np.array([9, -9, 11, 13, -40, 5000]) * 0.5, 0.5, dtype)
    back, data = _through(symbols)
    model = gaussian_model(np.zeros(1, np.int64), np.zeros(1, np.int64))
    least = int(np.diff(model.keys).min())
    p16 = np.floor(65536 * np.diff(ndtr(np.array([8.5, 9.5]))))[0]
    return _count(float(p16), float(least), 1.0, int((back != symbols).sum()) + (least < 1))


def totals(dtype):
    """Frequencies of every table are at least 1 and sum to 2^24; literal rounds each by itself."""
    sigma = np.repeat(np.arange(SIGMA_MIN, SIGMA_MAX + 1), 64)
    place = np.tile(np.arange(0, 1024, 16), SIGMA_MAX - SIGMA_MIN + 1)
    keys, first = build_keys(sigma, place)
    freqs = np.diff(keys)
    sums = np.add.reduceat(freqs, first)
    wrong = int((sums != 1 << PRECISION).sum() + (freqs < 1).sum())
    p = np.exp(-0.5 * np.arange(-12.0, 13) ** 2).astype(DTYPES[dtype])
    literal = int(np.rint(p / p.sum() * 2**PRECISION).sum())
    return _count(literal, int(sums[0]), 1 << PRECISION, wrong)


def escapes(dtype):
    """Symbols outside their table, their cost in bits counted; literal has no escape."""
    symbols = _rounded(np.array([0, 5, -40, 10**6, -(10**8), 2**30, 14, -14]) * 2.0, 2.0, dtype)
    mu = np.full(len(symbols), 307, np.int64)
    sigma = np.full(len(symbols), 9, np.int64)
    data = encode_gaussian(symbols, mu, sigma)
    wrong = int((decode_gaussian(data, mu, sigma) != symbols).sum())
    counted = float(ideal_bits_gaussian(symbols, mu, sigma).sum())
    clipped = int((np.clip(symbols, -13, 13) != symbols).sum())  # W = 13 at this deviation
    return _count(
        f"{clipped} clipped", 8 * len(data), counted, wrong + (8 * len(data) > counted + 80)
    )


def long_messages(dtype):
    """A million equal, alternating, unlikely symbols: 0.1 % and 8 bytes over the entropy; literal is a bit each."""
    wrong, excess, n, sizes = 0, 0.0, 10**6, []
    for values, mu, sigma in (
        (np.full(n, 3.5), 7 << MU_BITS, SIGMA_MIN),
        (0.5 * (np.arange(n) % 2), 512, SIGMA_MIN),
        (np.full(n, -0.5), 5 << MU_BITS, 2 << SIGMA_BITS),
    ):
        symbols = _rounded(values, 0.5, dtype)
        back, data = _through(symbols, mu, sigma)
        wrong += int((back != symbols).sum())
        entropy = (
            ideal_bits_gaussian(
                symbols, np.full(n, mu, np.int64), np.full(n, sigma, np.int64)
            ).sum()
            / 8
        )
        excess = max(excess, len(data) - 1.001 * entropy)
        sizes.append((len(data), entropy))
    return _count(n / 8, float(sizes[0][0]), float(sizes[0][1]), wrong + (excess > 8))


def damaged(dtype):
    """Truncated, extended, one bit flipped in every byte: refused, never garbage; literal has no checksum."""
    data = encode(_model(dtype))
    flip = lambda i: data[:i] + bytes([data[i] ^ 16]) + data[i + 1 :]
    broken = (
        [data[:n] for n in (0, 10, len(data) // 2, len(data) - 1)]
        + [data + b"\0"]
        + [flip(i) for i in range(len(data))]
    )
    refused = 0
    for other in broken:
        try:
            decode(other)
        except BitstreamError:
            refused += 1
    sections = open_container(data)
    body, silent = bytes(sections["features"]), 0
    for i in range(len(body)):  # the same flips under checksums that fit them again
        changed = body[:i] + bytes([body[i] ^ 16]) + body[i + 1 :]
        try:
            decode(write_container({**sections, "features": changed}))
            silent += 1
        except BitstreamError:
            pass
    return _count(
        f"{silent} of {len(body)} decode",
        f"{refused} of {len(broken)} refused",
        "all refused",
        len(broken) - refused,
    )


def same_bytes(dtype):
    """The same bytes on every machine: SHA-256 of the committed streams; literal sums floats in two orders."""
    rows = {
        row["name"]: row
        for row in json.loads((published.FOLDER / "manifest.json").read_text(encoding="utf-8"))[
            "good"
        ]
    }
    wrong = 0
    for name in ("full", "static", "hashed", "deviations"):
        data = (published.FOLDER / rows[name]["file"]).read_bytes()
        model = decode(data)
        model = replace(
            model, anchors=model.anchors._replace(f_a=model.anchors.f_a.astype(DTYPES[dtype]))
        )
        wrong += hashlib.sha256(encode(model)).hexdigest() != rows[name]["sha256"]
    h, W = np.random.default_rng(2).normal(size=(2, 40, 40)).astype(DTYPES[dtype])
    sums = int(
        (h @ W != h[:, ::-1] @ W[::-1]).sum()
    )  # the same sums in another order, as another library has them
    return _count(f"{sums} of {h.size} sums differ", f"{wrong} differ", "0 differ", wrong)


def perturbed(dtype):
    """Mean and deviation one ulp off before the table is looked up: 16-bit bounds of floats move."""
    model = _model(dtype, anchors=400)
    mu, sigma = (a.astype(DTYPES[dtype]).ravel() for a in float_context(model)[1:3])
    q = np.repeat(float_context(model)[0], model.design.widths, axis=1).astype(mu.dtype).ravel()
    bounds = lambda mu, sigma: np.rint(65536 * ndtr((q * np.rint(mu / q) + q / 2 - mu) / sigma))
    moved = int(
        (
            bounds(
                np.nextafter(mu, mu.dtype.type(np.inf)), np.nextafter(sigma, mu.dtype.type(np.inf))
            )
            != bounds(mu, sigma)
        ).sum()
    )
    mine, theirs = quantise(model), quantised_of(open_container(encode(model)))
    wrong = sum(
        int((getattr(mine.context, name) != getattr(theirs.context, name)).sum())
        for name in ("mu_units", "sigma_units")
    )
    return _count(f"{moved} of {mu.size} bounds moved", f"{wrong} moved", "0 moved", wrong)


def wide_symbols(dtype):
    """Symbols at the edges of 16, 17 and 24 bits and at 2^31; literal is int16."""
    want = np.concatenate(
        [s * np.array([2**k + d for d in (-1, 0, 1)]) for k in (15, 16, 23) for s in (1, -1)]
    )
    symbols = _rounded(want * 0.5, 0.5, dtype)
    wrong = 0
    for sigma in (0, SIGMA_MAX):
        wrong += int((_through(symbols, 0, sigma)[0] != want).sum())
    edge, _ = _through([2**31, -(2**31)])
    wrong += int((np.abs(edge) != 2**31).sum())
    return _count(int(np.array(2**15).astype(np.int16)), int(_through([2**15])[0][0]), 2**15, wrong)


def entries():
    """What a measure's docstring says is what the table says."""
    for id, part, measure in (
        ("H-Q2.transmitted", "codec.quantise", transmitted),
        ("H-Q3.large", "codec.streams", large_symbols),
        ("H-Q4.step", "codec.context", step_of_decoder),
        ("H-Q5.positions", "codec.quantise", positions),
        ("H-Q6.float16", "codec.quantise", half_weights),
        ("H-E1.short", "codec.streams", short_messages),
        ("H-E2.improbable", "codec.gaussian_table", improbable),
        ("H-E3.totals", "codec.gaussian_table", totals),
        ("H-E4.escapes", "codec.streams", escapes),
        ("H-E5.long", "codec.rans", long_messages),
        ("H-E6.damaged", "codec.container", damaged),
        ("H-E7.bytes", "codec.file", same_bytes),
        ("H-E8.one_ulp", "codec.context", perturbed),
        ("H-E9.int16", "codec.streams", wide_symbols),
    ):
        yield Entry(id, part, measure.__doc__, measure)
