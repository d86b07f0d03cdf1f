"""The same trained model written otherwise: what the harness of files measures.

Each function below returns {(line, value): model}, from dear to cheap; nothing is trained again.
"""

from dataclasses import replace

import numpy as np

from ...codec.quantise import quantise
from ...equations.prior import layout
from ...model import Model, join, step_code

LEAST_DEVIATION = 0.05  # of a channel, in steps: a constant channel still has a finite prior


def redesigned(model, **changes) -> Model:
    """The model with other fields of its design."""
    return replace(model, design=model.design._replace(**changes))


def weight_bits(model):
    """Weights as float16, then as entropy-coded integers of so many bits."""
    choices = {("", "16"): model}
    for bits in (10, 9, 8, 7, 6, 5, 4):
        steps = {
            name: tuple(
                step_code(np.array([2.0 * np.abs(a).max(initial=0) for a in arrays]) / 2**bits)
                for arrays in pair
            )
            for name, pair in model.networks.items()
        }
        choices["", f"{bits}"] = replace(redesigned(model, coded=True), steps=steps)
    return choices


def position_bits(model):
    """Bits of a position per axis, in the coded design."""
    bits = (16, 12, 11, 10, 9, 8, 7, 6)
    return {("", f"{n}"): redesigned(model, coded=True, position_bits=n) for n in bits}


def scaled(model, factor):
    """The model with other base steps."""
    return redesigned(model, Q_0=tuple(factor * Q for Q in model.design.Q_0))


def fixed(model):
    """The model with every step at Q_0: the last layer of psi_q is zero (Eq. 8)."""
    psi_q = tuple([*arrays[:-1], np.zeros_like(arrays[-1])] for arrays in model.networks["psi_q"])
    return replace(model, networks={**model.networks, "psi_q": psi_q})


def steps(model):
    """Base steps, with the learned factors and without them."""
    lines = {"steps of every anchor": model, "one step for all": fixed(model)}
    factors = (0.25, 0.5, 1, 2, 4, 8)
    return {(line, f"{n:g}"): scaled(m, n) for line, m in lines.items() for n in factors}


def without_context(model):
    """The model with one Gaussian and one step per channel.

    The hash grid has one node, and the networks of the context have no hidden layer and zero
    weights; the last bias of psi_p holds the means and deviations.
    """
    q = quantise(fixed(model))
    values, kept = join(q.model.anchors), q.kept
    count = np.maximum(kept.sum(axis=0), 1)
    mean = np.where(kept, values, 0).sum(axis=0) / count
    variance = (np.where(kept, values - mean, 0) ** 2).sum(axis=0) / count
    least = LEAST_DEVIATION * np.repeat(model.design.Q_0, model.design.widths)
    small = redesigned(model, context=(), grid=(("xyz", 1),), F=1)
    networks = {
        name: ([np.zeros(shape)], [np.zeros(shape[1])])
        for name in ("psi_p", "psi_q")
        for shape in small.design.layers()[name]
    }
    mu, raw = layout(model.design.widths)
    bias = networks["psi_p"][1][0]
    bias[mu], bias[raw] = mean, 0.5 * np.log(np.maximum(variance, least**2))
    grids = [np.ones(shape) for shape in small.design.levels()]
    return replace(small, networks={**model.networks, **networks}, grids=grids)


def context(model):
    """The paper's context, and one Gaussian per channel; all steps are Q_0 in both."""
    return {("", "grid and ψ_p"): fixed(model), ("", "one Gaussian"): without_context(model)}
