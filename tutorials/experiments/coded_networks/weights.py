"""The sections of networks in version 2: integers times a step, with scales of rows and columns.

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

Worked example of networks. s = 186 is the step 26 2^-8 = 0.1015625, and the symbol -3 is
-0.3046875. With t = 1, r = -1 and c = 2 its sigma_units are 32: a deviation of 4 symbols.
"""

from functools import cache

import numpy as np

from p4dgs_ref.codec import rans
from p4dgs_ref.codec.gaussian_table import CHUNK, SIGMA_BITS, SIGMA_MAX, SIGMA_MIN, gaussian_model
from p4dgs_ref.codec.plain import networks_of, require_finite
from p4dgs_ref.codec.streams import (
    decode_symbols,
    encode_gaussian,
    find_entries,
    ideal_bits_gaussian,
)

from .networks import step_of_code

LEVELS = np.arange(SIGMA_MIN >> SIGMA_BITS, (SIGMA_MAX >> SIGMA_BITS) + 1)
CODES = np.arange(-6, 7)  # of rows and columns, that the encoder tries
SWEEPS = 4
MAX_STEPS = 2**15 - 1  # magnitude of a weight that is coded in steps
KNOWN_COSTS = 1024  # magnitudes whose cost the encoder knows; larger ones cost as the largest


def round_networks(networks, steps):
    """Networks with all numbers rounded to multiples of their steps, as a decoder has them.

    Raises EncodeError, which names the network.
    """
    rounded = {}
    for name, pair in networks.items():
        parts = zip(pair, steps[name])
        rounded[name] = tuple([round_weights(a, s) for a, s in zip(*part)] for part in parts)
        require_finite(name, rounded[name], f"of at most {MAX_STEPS} steps")
    return rounded


def round_weights(weights, code):
    """Weights as multiples of a step; NaN where the file cannot hold the multiple."""
    step = step_of_code(code)
    n = np.rint(np.array(weights, order="C") / step) + 0.0
    return np.where(np.abs(n) <= MAX_STEPS, n * step, np.nan)


def write_weights(networks, steps):
    """The section of networks whose numbers are multiples of the steps with these codes."""
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


def read_networks(data, section, shapes):
    """The networks in a section, from the shapes of their layers."""
    layers = [layer for network in shapes.values() for layer in network]
    steps, levels, start = read_head(data, layers)
    lengths = [length for I, J in layers for length in (I if J else 0, J)]
    tables = tables_of(np.zeros(sum(lengths), np.int64))
    entries, at = rans.decode(data, tables.table, tables.keys, start, section)
    codes = tables.lowest + entries - tables.first[tables.table]
    codes = iter(np.split(codes, np.cumsum(lengths)))
    scales = []
    for (_, J), (t_W, t_b) in zip(layers, levels):
        scales += [(t_W + next(codes)[:, None] + next(codes)).ravel(), np.full(J, t_b)]
    symbols = decode_symbols(data[at:], tables_of(np.concatenate(scales)), section)
    numbers = symbols * np.repeat(step_of_code(steps.ravel()), [len(part) for part in scales])
    return networks_of(numbers, shapes)


def read_head(data, layers):
    """The codes of steps and the levels [layers, 2] of W and b, and where the head ends."""
    full = np.array([J > 0 for _, J in layers])
    end = 4 * int(full.sum())
    head = np.zeros((len(layers), 2, 2), np.int64)
    head[full] = np.frombuffer(data, np.uint8, end).reshape(-1, 2, 2)
    return head[:, :, 0], head[:, :, 1] + LEVELS[0], end


def read_steps(data, shapes):
    """The codes of the steps of the networks in a section, in the form of `CodedModel.steps`."""
    layers = [layer for network in shapes.values() for layer in network]
    steps, _, _ = read_head(data, layers)
    parts = np.split(steps.T, np.cumsum([*map(len, shapes.values())])[:-1], axis=1)
    return dict(zip(shapes, map(tuple, parts)))


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
    """Bits, in units of 1/256, of magnitudes at every level [28, KNOWN_COSTS] and of CODES [13]."""
    scales = np.repeat(LEVELS, KNOWN_COSTS)
    magnitudes = np.tile(np.arange(KNOWN_COSTS), len(LEVELS))
    bits = ideal_bits_gaussian(magnitudes, 0 * scales, sigma_units(scales)).reshape(-1, KNOWN_COSTS)
    price = ideal_bits_gaussian(CODES, 0 * CODES, 0 * CODES)
    return np.rint(256 * bits), np.rint(256 * price)  # whole numbers: their sums are exact


def price(magnitudes, scales):
    """The bits, as in `costs`, of magnitudes at scales; the two have shapes that NumPy combines."""
    # One index is faster than two.
    return costs()[0].take(KNOWN_COSTS * level_index(scales) + magnitudes)


def fit(symbols, has_codes):
    """The level, row codes [I] and column codes [J] of symbols [I, J]; 0 unless `has_codes`."""
    magnitudes = np.minimum(np.abs(symbols), KNOWN_COSTS - 1)
    r, c = (np.zeros(length, np.int64) for length in symbols.shape)
    for _ in range(SWEEPS):
        before, t = (r, c), best_level(magnitudes, r[:, None] + c)
        if has_codes:
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


def best_level(magnitudes, codes):
    """The level that needs the fewest bits; `codes` [I, J] are sums of row and column codes.

    A tensor has few different pairs of a magnitude and a code, so each pair is looked up once and
    its bits are multiplied by its count.
    """
    pairs, counts = np.unique(codes * KNOWN_COSTS + magnitudes, return_counts=True)
    of_pairs = price(pairs % KNOWN_COSTS, np.add.outer(LEVELS, pairs // KNOWN_COSTS))
    return LEVELS[np.argmin(of_pairs @ counts)]
