"""Networks in integers: the same outputs on every machine, in any order of summation.

FORMAT.  A number is an integer times 2^-a; a is fixed per layer by the weights, never by the data.

1. Input.  |x| <= X = 2^15, a = 15.
2. Layer.  Weights and biases are the float16 numbers of the file, W (I, J) and b (J,), with
       p = the least integer with max |W| < 2^p        p_b = the same for max |b|        (0 where all are zero)
       n = min(15 - p, 50 - p_b - a, 24)
       W' = rint(W 2^n),  b' = rint(b 2^(a + n))       ties to even; |W'| < 2^15, |b'| <= 2^50
       y = x W' + b'                                    units 2^-(a + n)
   |y| <= B = X max_j sum_i |W'_ij| + max_j |b'_j|.  With I <= 2^14 and X <= 2^22 that is below 2^52: a float64, hence
   a JavaScript number, holds every partial sum exactly, so a product may add in any order, fused or not.
3. Hidden layers.  s = max(0, bits of B - 22);  x = max(0, floor((y + floor(2^s / 2)) / 2^s));
   a becomes a + n - s and X becomes floor((B + floor(2^s / 2)) / 2^s).
4. The last layer is left as y, with its units a + n and its bound B.  Any of n, a and a + n may be negative.

WORKED NUMBERS.  x = (16384, -8192), W = (0.5, -0.3)^T, b = (0.1), in float16 -0.300048828125 and 0.0999755859375:
p = 0, p_b = -3, n = min(15, 38, 24) = 15, W' = (16384, -9832)^T, b' = 107347968, y = 456327168 in units of 2^-30
(0.42499), B = 2^15 (16384 + 9832) + 107347968 = 966393856.  As a hidden layer: s = 8, x = 1782528, a = 22, X = 3774976.
"""

import json
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

INPUT_BITS, ACTIVATION_BITS, WEIGHT_BITS, BIAS_BITS, MOST_SCALE = 15, 22, 15, 50, 24


class Layer(NamedTuple):
    """Whole numbers held in float64, exact because none reaches 2^53."""

    W: np.ndarray  # (I, J)
    b: np.ndarray  # (J,)
    bits: int  # outputs y in units of 2^-bits
    bound: int  # |y| <= bound, and so is every partial sum
    s: int  # how many bits of y a hidden layer rounds away


@cache
def table(name):
    """A normative table of `tables.json` as int64; `make_tables.py` says what it holds."""
    return np.array(
        json.loads(files(__package__).joinpath("tables.json").read_text())[name], np.int64
    )


def exponent(values):
    """The least p with max |values| < 2^p; 0 for nothing but zeros."""
    return int(np.frexp(np.abs(values).max(initial=0.0))[1])


def halve(values, s):
    """floor((values + floor(2^s / 2)) / 2^s) of whole numbers in float64: round to nearest, ties up."""
    return np.floor((values + 2**s // 2) * 2.0**-s) if s > 0 else values


def whole_layers(weights, biases):
    """The layers of a network in whole numbers, from its stored weights and biases.

    Raises     nothing: limits of the header keep widths within 2^14, and float16 keeps weights finite
    """
    layers, bits, X = [], INPUT_BITS, 2**INPUT_BITS
    for W, b in zip(weights, biases):
        n = min(WEIGHT_BITS - exponent(W), BIAS_BITS - exponent(b) - bits, MOST_SCALE)
        W, b = W * 2.0**n, b * 2.0 ** (bits + n)
        np.rint(W, out=W), np.rint(b, out=b)
        largest_sum, bits = int(np.abs(W).sum(axis=0).max(initial=0.0)), bits + n
        # Any sum of some of the products x_i W_ij, with or without b_j, is whole and at most `bound` in magnitude:
        # |x_i| <= X and the triangle inequality.  Whole numbers to 2^53 are doubles, so no addition, in no order, rounds.
        bound = X * largest_sum + int(np.abs(b).max(initial=0.0))
        assert bound < 2**52, "a partial sum could round"
        s = max(0, bound.bit_length() - ACTIVATION_BITS)
        layers.append(Layer(W, b, bits, bound, s))
        bits, X = bits - s, bound + 2**s // 2 >> s
    return layers


def product(x, W):
    """x W, exact whatever the order of its sums: the one place where a library's matrix product is called."""
    return x @ W


def run_network(x, layers):
    """The outputs y (A, J) of the last layer, on whole numbers x (A, I), |x| <= 2^15 in units of 2^-15."""
    for layer in layers[:-1]:
        x = np.maximum(halve(product(x, layer.W) + layer.b, layer.s), 0.0)
    return product(x, layers[-1].W) + layers[-1].b


def rescale(y, unit, bits, limit):
    """Outputs y (A, n) in units of 2^-unit brought to units of 2^-bits, clipped to +-limit: int64."""
    s = unit - bits
    if s < 0:  # few fractional bits: saturate first, so that the shift stays exact
        y = np.clip(y, -limit, limit) * 2.0 ** min(-s, 30)
    return np.clip(halve(y, s), -limit, limit).astype(np.int64)


def bit_length(values):
    """Bits of positive whole numbers below 2^53, int64."""
    return np.frexp(values.astype(float))[1].astype(np.int64)


def log2(values):
    """log2 of positive whole numbers, in units of 2^-16: bits before the leading one, then a table of 256 steps."""
    length = bit_length(values)
    leading = np.where(
        length > 24, values >> np.maximum(length - 24, 0), values << np.maximum(24 - length, 0)
    )
    steps, i, r = table("log2"), leading >> 15 & 255, leading & 2**15 - 1
    return (length - 1 << 16) + steps[i] + ((steps[i + 1] - steps[i]) * r >> 15)
