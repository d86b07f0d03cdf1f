"""From a trained model to the integers of a file, and to the model that a decoder will find in it."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..equations import rounding
from ..model import GROUPS, Anchors, Model, join, snap, split, without_silent_units
from .container import BitstreamError
from .context import coding_context
from .header import read_header, write_header

LARGEST = 1e30  # of a box's corners, so that an extent is finite in float32


class EncodeError(ValueError):
    """A model that the format cannot hold; the message names the array and what was expected."""


class Quantised(NamedTuple):
    model: Model  # every array as the decoder will have it, float64
    positions: np.ndarray  # (A, 3) int64, 0 ... 65535
    symbols: np.ndarray  # (A, n) int64, columns as `model.join`; 0 where nothing is coded
    kept: np.ndarray  # (A, n) bool: coded; offsets of masked children are not
    context: object  # context.CodingContext


def coded(mask, design):
    """Which columns of `model.join` are in the file (A, n): everything but the offsets of masked children."""
    always = np.ones((len(mask), sum(design.widths[:3])), bool)
    return np.concatenate([always, np.repeat(mask, 3, axis=1)], axis=1)


def dequantise(symbols, ctx, design):
    """f, s, l, O (A, k, 3) from symbols (A, n): symbol times step."""
    values, starts = np.empty(symbols.shape), np.cumsum(design.widths[:3])
    for i, (part, out) in enumerate(
        zip(np.split(symbols, starts, axis=1), np.split(values, starts, axis=1))
    ):
        np.multiply(part, ctx.q[:, i : i + 1], out=out)
    return split(values, design)


def quantise(model):
    """Round a model to what its file will hold.

    Anchors whose children are all masked are dropped, except that one always stays; so are hidden units that no anchor
    wakes, where no view effect is listed.  What is dropped or masked may hold any numbers; everything else must be finite.

    Raises     EncodeError naming the array; OverflowError naming the element where |f/q| is not below 2^31
    Choice     Q14: positions; Q15: masked children are not coded; Q18: float16 networks; Q19: rounding
    Reference  P-4DGS Eq. (10), Fig. 2
    """
    _check_shapes(model)
    alive = model.anchors.mask.any(axis=1)
    alive[0] |= not alive.any()
    anchors, box = Anchors(*(a[alive] for a in model.anchors)), _round_box(model.box)
    networks = round_networks(model.networks)
    grids = [
        np.where(_finite(f"hash grid level {i}", grid) >= 0, 1.0, -1.0)
        for i, grid in enumerate(model.grids)
    ]
    background = np.array(model.background, float)
    design = _as_decoded(replace(model, anchors=anchors, background=background))
    positions, x_a = snap(_finite("anchors x_a", anchors.x_a), *box)
    ctx, kept = coding_context(design, networks, grids, positions), coded(anchors.mask, design)
    symbols = _round_attributes(np.where(kept, join(anchors), 0), ctx.q, design)
    f, s, l, O = dequantise(symbols, ctx, design)
    rounded = Model(
        design, Anchors(x_a, f, s, l, O, anchors.mask), networks, grids, box, background
    )
    return Quantised(without_silent_units(rounded), positions, symbols, kept, ctx)


def round_networks(networks):
    """Networks rounded to float16 (Q18), as float64 arrays, row by row in memory: as a decoder lays them out.

    Raises     EncodeError naming the network where a weight is not finite or beyond float16's range
    """
    rounded = {}
    for name, pair in networks.items():
        with np.errstate(over="ignore"):
            rounded[name] = tuple(
                [np.array(a, np.float16, order="C").astype(float) for a in arrays]
                for arrays in pair
            )
        if not all(np.isfinite(a).all() for arrays in rounded[name] for a in arrays):
            raise EncodeError(
                f"network {name}: expected finite weights within float16's range, +-65504"
            )
    return rounded


def underflows(networks):
    """How many weights that are not 0 become 0 in float16: what Q18 loses without a word, below 3e-8."""
    return sum(
        int(np.count_nonzero(a)) - int(np.count_nonzero(np.asarray(a).astype(np.float16)))
        for pair in networks.values()
        for arrays in pair
        for a in arrays
        if np.isfinite(a).all()
    )


def _round_attributes(values, q, design):
    """The symbols of attributes (A, n); of Eq. (10) group by group."""
    starts, columns = np.cumsum(design.widths[:3]), []
    for i, part in enumerate(np.split(values, starts, axis=1)):
        try:
            _finite(f"anchors {GROUPS[i]}_a", part)
            (symbols, _), _ = rounding.forward(part, q[:, i : i + 1])
            columns.append(symbols)
        except OverflowError as error:
            raise OverflowError(f"anchors {GROUPS[i]}_a, those kept: {error}") from None
    return np.concatenate(columns, axis=1)


def _finite(name, array):
    if not np.isfinite(array).all():
        raise EncodeError(f"{name}: expected finite numbers")
    return array


def _round_box(box):
    """The box in the precision of the file, which positions are snapped to."""
    with np.errstate(over="ignore"):
        lo, hi = (np.asarray(corner, np.float32) for corner in box)
    if not (
        lo.shape == hi.shape == (3,) and (np.abs([lo, hi]) <= LARGEST).all() and (lo <= hi).all()
    ):
        raise EncodeError(f"box: expected two corners (3,) with lo <= hi, finite, to {LARGEST:g}")
    return lo, hi


def _as_decoded(model):
    """The design as a decoder will read it, which proves that it can."""
    try:
        return read_header(write_header(model))[0]
    except BitstreamError as error:
        raise EncodeError(f"design: {error.message}") from None


def _check_shapes(model):
    """Every array's shape against the design, so that no file is written that cannot be read."""
    design, A = model.design, len(model.anchors.mask)
    shapes = {
        "x_a": (A, 3),
        "f_a": (A, design.d),
        "s_a": (A, 3),
        "l_a": (A, 3),
        "O_a": (A, design.k, 3),
        "mask": (A, design.k),
    }
    found = [
        (f"anchors {name}", getattr(model.anchors, name).shape, shape)
        for name, shape in shapes.items()
    ]
    found.append(("hash grid", [grid.shape for grid in model.grids], design.levels()))
    layers = {
        name: ([*pairs], [(columns,) for _, columns in pairs])
        for name, pairs in design.layers().items()
    }
    given = {
        name: tuple([a.shape for a in arrays] for arrays in pair)
        for name, pair in model.networks.items()
    }
    found += [
        (f"network {name}", given.get(name), layers.get(name)) for name in sorted({*layers, *given})
    ]
    for name, shape, expected in found:
        if shape != expected:
            raise EncodeError(f"{name}: expected {expected} as the design says, got {shape}")
    if model.anchors.mask.dtype != bool or not A:
        raise EncodeError("anchors mask: expected booleans of one anchor or more")
