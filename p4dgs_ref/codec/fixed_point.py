"""Networks in integers: the same outputs on every machine and in any order of summation.

A number is represented by an integer n and a number of fractional bits a; its value is n times
2^-a. The fractional bits of a layer follow from its weights alone, never from the data. "Bits of B"
means the number of binary digits of an integer B, 0 for B = 0.

1. Input. The input x of a network is a vector of integers with |x| <= X = 2^15 and a = 15.

2. Layer. The weights W (I rows, J columns) and biases b (J) are the float16 numbers of the file.
   With

       p   = the least integer with max |W| < 2^p      (0 where all are zero)
       p_b = the least integer with max |b| < 2^p_b    (0 where all are zero)
       n   = min(15 - p, 50 - p_b - a, 24)

   they become integers, and the layer is computed in integers:

       W' = W 2^n         rounded to the nearest integer, ties to even;  |W'| < 2^15
       b' = b 2^(a + n)   rounded in the same way;                       |b'| <= 2^50
       y  = x W' + b'     in units of 2^-(a + n)

   Every output and every partial sum is bounded by

       B = X max_j sum_i |W'_ij| + max_j |b'_j|.

   Because I <= 2^14 and X <= 2^22, B is below 2^52. A float64, and therefore a JavaScript number,
   holds every partial sum exactly, so the products may be added in any order, with or without fused
   multiply-add.

3. Hidden layer. Let s = max(0, bits of B - 22). The input of the next layer is

       x = max(0, floor((y + floor(2^s / 2)) / 2^s))

   with a + n - s fractional bits and the bound X = floor((B + floor(2^s / 2)) / 2^s).

4. Last layer. Its output is y itself, with a + n fractional bits and the bound B.

Any of n, a and a + n may be negative.

Worked numbers. x = (16384, -8192), W = (0.5, -0.3)^T and b = (0.1); in float16, -0.3 is
-0.300048828125 and 0.1 is 0.0999755859375.

    p = 0, p_b = -3, n = min(15, 38, 24) = 15, W' = (16384, -9832)^T, b' = 107347968
    y = 456327168 in units of 2^-30, which is 0.42499
    B = 2^15 (16384 + 9832) + 107347968 = 966393856
    as a hidden layer: s = 8, x = 1782528, a = 22, X = 3774976
"""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

INPUT_BITS, ACTIVATION_BITS, WEIGHT_BITS, BIAS_BITS, MOST_SCALE = 15, 22, 15, 50, 24


class Layer(NamedTuple):
    """Integers held in float64, exact because none reaches 2^53."""

    W: np.ndarray  # [I, J]
    b: np.ndarray  # [J]
    bits: int  # fractional bits of the output y
    bound: int  # upper bound of |y| and of every partial sum
    s: int  # bits of y that a hidden layer rounds away


@cache
def table(name):
    """A table of `tables.json`, int64. The tables are part of the format: do not recompute them."""
    tables = json.loads(Path(__file__).with_name("tables.json").read_text())
    return np.array(tables[name], np.int64)


def exponent(values):
    """The least integer p with max |values| < 2^p; 0 where all values are zero."""
    return int(np.frexp(np.abs(values).max(initial=0.0))[1])


def halve(values, s):
    """values / 2^s rounded to the nearest integer, ties up: integers held in float64, s > 0."""
    return np.floor((values + 2**s // 2) * 2.0**-s) if s > 0 else values


def whole_layers(weights, biases):
    """The layers of a network in integers, from the weights and biases in the file."""
    layers, bits, X = [], INPUT_BITS, 2**INPUT_BITS
    for W, b in zip(weights, biases):
        n = min(WEIGHT_BITS - exponent(W), BIAS_BITS - exponent(b) - bits, MOST_SCALE)
        W, b, bits = np.rint(W * 2.0**n), np.rint(b * 2.0 ** (bits + n)), bits + n
        # |x_i| <= X, so by the triangle inequality no sum of some of the products x_i W_ij, with or
        # without b_j, exceeds the bound. Integers up to 2^53 are exact in float64.
        largest_sum = int(np.abs(W).sum(axis=0).max(initial=0.0))
        bound = X * largest_sum + int(np.abs(b).max(initial=0.0))
        assert bound < 2**52, "a partial sum could be rounded"
        s = max(0, bound.bit_length() - ACTIVATION_BITS)
        layers.append(Layer(W, b, bits, bound, s))
        bits, X = bits - s, bound + 2**s // 2 >> s
    return layers


def product(x, W):
    """x W, exact in any order of summation. Nothing else here calls a library's matrix product."""
    return x @ W


def run_network(x, layers):
    """The outputs y [A, J] of the last layer for inputs x [A, I] in units of 2^-15, |x| <= 2^15."""
    for layer in layers[:-1]:
        x = np.maximum(halve(product(x, layer.W) + layer.b, layer.s), 0.0)
    return product(x, layers[-1].W) + layers[-1].b


def rescale(y, unit, bits, limit):
    """Outputs y in units of 2^-unit converted to units of 2^-bits, clipped to +-limit: int64."""
    s = unit - bits
    if s < 0:  # few fractional bits: clip first, so that the multiplication stays exact
        y = np.clip(y, -limit, limit) * 2.0 ** min(-s, 30)
    return np.clip(halve(y, s), -limit, limit).astype(np.int64)


def bit_length(values):
    """The number of binary digits of integers from 0 to 2^53, int64."""
    return np.frexp(values.astype(float))[1].astype(np.int64)


def log2(values):
    """log2 of positive integers in units of 2^-16: the exponent, then a table of 256 steps."""
    length = bit_length(values)
    # Shift the leading one to bit 23; the 23 bits after it are 8 of the index and 15 of the rest.
    leading = values << np.maximum(24 - length, 0) >> np.maximum(length - 24, 0)
    steps, i, r = table("log2"), leading >> 15 & 255, leading & 2**15 - 1
    return (length - 1 << 16) + steps[i] + ((steps[i + 1] - steps[i]) * r >> 15)
