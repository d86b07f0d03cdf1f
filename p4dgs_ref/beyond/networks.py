"""Networks that pay for their bits, from stage 4 of training on (B1).

A tensor is the weights or the biases of a layer. Each has a step, whose logarithm is learned, and
its numbers are rounded to multiples of that step. This is Eq. (7) with the error of rounding in the
place of the noise, so the gradient passes straight through to the numbers and reaches the step.
Equation `weight_bits` says what the numbers cost, and `scales` under which densities.
"""

import numpy as np

from ..equations import noise
from ..model import with_backward
from ..training.parameters import Parameters
from . import weight_bits

PSEUDO_COUNT = 4.0  # numbers that have the mean of their tensor, added to each row and column
MIN_SCALE = 0.4  # of a density, in steps: the gradient of the bits is at most 1 / MIN_SCALE a step


def step_code(step):
    """The codes of the steps that are nearest to some positive numbers: int64."""
    mantissa, exponent = np.frexp(np.clip(step, step_of_code(0), step_of_code(255)))
    return 16 * (exponent + 14) + np.rint(32 * mantissa).astype(np.int64) - 16


def step_of_code(code):
    """The steps of codes 0 to 255: (16 + code mod 16) 2^(floor(code / 16) - 19), 2^-15 to 1.94.

    The product of a step and an integer up to 2^19 is exact, also in float32.
    """
    return np.ldexp(16.0 + code % 16, code // 16 - 19)


def default_steps(networks):
    """Default step codes, for the weights and the biases of every layer.

    A tenth of the root mean square of the weights, and half of that for the biases, as
    {network: (codes, codes)}.
    """
    steps = {}
    for name, (weights, _) in networks.items():
        rms = np.sqrt([np.sum(W.astype(float) ** 2) / max(W.size, 1) for W in weights])
        steps[name] = step_code(0.1 * rms), step_code(0.05 * rms)
    return steps


class Layout:
    """Where the networks are in Parameters, and room for the rounded networks."""

    def __init__(self, p, names):
        arrays = {name: a for name, a in p.arrays.items() if name.startswith("psi_")}
        self.rounded = Parameters(arrays, p.vector.dtype)
        self.networks = {name: self.rounded.network(name) for name in names}
        part = np.flatnonzero(p.per_element(lambda name: name in arrays))
        self.part = slice(part[0], part[-1] + 1)  # of the flat vector, where networks are together
        # Biases [J] are a matrix of one column.
        shapes = np.array([(*a.shape, 1)[:2] for a in arrays.values()])
        self.tensor = np.repeat(np.arange(len(shapes)), shapes.prod(axis=1))
        first = np.cumsum(shapes, axis=0) - shapes  # rows and columns of all tensors are counted on
        places = [np.indices(s).reshape(2, -1) + f[:, None] for s, f in zip(shapes, first)]
        self.row, self.column = np.concatenate(places, axis=1)
        self.counts = [np.bincount(index) for index in (self.tensor, self.row, self.column)]


def initial_log_steps(networks):
    """Logarithms [T] of the steps before they are learned, tensors in the order of Parameters."""
    codes = [np.stack(pair, axis=1).ravel() for pair in default_steps(networks).values()]
    return np.log(step_of_code(np.concatenate(codes)))


def learned_steps(log_step, networks):
    """The codes of learned steps in the form of `Model.steps`."""
    ends = np.cumsum([2 * len(weights) for weights, _ in networks.values()])
    codes = np.split(step_code(np.exp(log_step)), ends[:-1])
    return {name: (part[::2], part[1::2]) for name, part in zip(networks, codes)}


def steps_of(log_step):
    """The steps that a file can hold, nearest to the learned ones; the gradient ignores this."""
    return step_of_code(step_code(np.exp(log_step)))


def means(a, index, count, mean):
    """The mean of the magnitudes a [n] that share an index, and of PSEUDO_COUNT times `mean`."""
    return (np.bincount(index, a)[index] + PSEUDO_COUNT * mean) / (count + PSEUDO_COUNT)[index]


def scales(k, layout):
    """The scale [n] of the density of each weight k [n], in steps.

    It is r c / m with the mean magnitudes m of the tensor, r of the weight's row and c of its
    column. It is an estimate, through which no gradient flows: the best scale has none.
    """
    a, (numbers, in_row, in_column) = np.abs(k).astype(float), layout.counts
    m = (np.bincount(layout.tensor, a) / np.maximum(numbers, 1))[layout.tensor]
    r, c = means(a, layout.row, in_row, m), means(a, layout.column, in_column, m)
    return np.maximum(r * c / np.maximum(m, 1e-9), MIN_SCALE).astype(k.dtype)


def rounded_networks(p, layout):
    """Return the rounded networks, their bits, and `back`.

    back(gradients, R_networks_bar) turns the gradients of the rounded networks, in place, into
    those of p, and adds those of the bits.
    """
    w, step = p.vector[layout.part], steps_of(p["log_step"]).astype(p.vector.dtype)[layout.tensor]
    error = np.rint(w / step) - w / step
    rounded, back_rounded = with_backward(noise, w[:, None], error[:, None], step[:, None])
    layout.rounded.vector[:] = w = rounded[:, 0]
    bits, back_bits = with_backward(weight_bits, w, step, scales(w / step, layout))

    def back(gradients, R_networks_bar):
        of_bits = back_bits(np.full_like(step, R_networks_bar))
        rounded_bar = gradients.vector[layout.part] + of_bits["w"]
        bars = back_rounded(rounded_bar[:, None])
        gradients.vector[layout.part] = bars["f"][:, 0]
        log_step_bar = (bars["q"][:, 0] + of_bits["step"]) * step
        tensors = len(gradients["log_step"])
        gradients["log_step"][...] = np.bincount(layout.tensor, log_step_bar, tensors)

    return layout.networks, bits.sum(dtype=np.float64), back
