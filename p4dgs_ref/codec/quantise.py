"""From a trained model to the integers of a file, and to the model that a decoder will find in it."""
from typing import NamedTuple

import numpy as np

from ..equations import rounding
from ..model import Anchors, Model, join, snap, split
from .context import coding_context


class EncodeError(ValueError):
    """A model that the format cannot hold; the message names the array and the limit."""


class Quantised(NamedTuple):
    model: Model               # every array as the decoder will have it, float64
    positions: np.ndarray      # (A, 3) int64, 0 ... 65535
    symbols: np.ndarray        # (A, n) int64, columns as `model.join`
    kept: np.ndarray           # (A, n) bool: coded; offsets of masked children are not
    context: object            # context.CodingContext


def half(networks):
    """Networks rounded to float16 (Q18), as float64 arrays.

    Raises     EncodeError naming the network where a weight is not finite or beyond float16's range
    """
    rounded = {}
    for name, pair in networks.items():
        with np.errstate(over="ignore"):
            rounded[name] = tuple([a.astype(np.float16).astype(float) for a in arrays] for arrays in pair)
        if not all(np.isfinite(a).all() for arrays in rounded[name] for a in arrays):
            raise EncodeError(f"network {name}: a weight does not fit float16 (largest magnitude 65504)")
    return rounded


def coded(mask, design):
    """Which columns of `model.join` are in the file (A, n): everything but the offsets of masked children."""
    always = np.ones((len(mask), sum(design.widths[:3])), bool)
    return np.concatenate([always, np.repeat(mask, 3, axis=1)], axis=1)


def dequantise(symbols, kept, ctx, design):
    """f, s, l, O (A, k, 3) from symbols: symbol times step, zero where nothing was coded."""
    return split(np.where(kept, symbols * np.repeat(ctx.q, design.widths, axis=1), 0.0), design)


def quantise(model):
    """Round a model to what its file will hold.

    Anchors whose children are all masked are dropped, except that one always stays.

    Choice     Q10 in the README's list is another one: Q14 positions, Q15 masks, Q18 networks, Q19 rounding
    Raises     EncodeError; OverflowError naming the element where |f/q| is not below 2^31
    Reference  P-4DGS Eq. (10)
    """
    design, alive = model.design, model.anchors.mask.any(axis=1)
    if not alive.any():
        alive = np.arange(len(alive)) == 0
    anchors = Anchors(*(a[alive] for a in model.anchors))
    networks = half(model.networks)
    grids = [np.where(grid >= 0, 1.0, -1.0) for grid in model.grids]
    positions, x_a = snap(anchors.x_a, *model.box)
    ctx = coding_context(design, networks, grids, x_a, model.box)
    starts = np.cumsum(design.widths[:3])
    columns = [rounding.forward(values, ctx.q[:, i:i + 1])[0].symbols
               for i, values in enumerate(np.split(join(anchors), starts, axis=1))]
    kept = coded(anchors.mask, design)
    symbols = np.where(kept, np.concatenate(columns, axis=1), 0)
    f, s, l, O = dequantise(symbols, kept, ctx, design)
    background = model.background.astype(np.float32).astype(float)
    rounded = Model(design, Anchors(x_a, f, s, l, O, anchors.mask), networks, grids, model.box, background)
    return Quantised(rounded, positions, symbols, kept, ctx)
