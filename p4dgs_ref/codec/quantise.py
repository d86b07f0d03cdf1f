"""From a trained model to the integers of its file, and to the model that a decoder finds there."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..attributes import ATTRIBUTES, GROUPS
from ..equations import mlp, rounding
from ..model import ANCHOR_NETWORKS, Anchors, Model, groups, join, snap, split
from .container import BitstreamError, EncodeError, require_encodable
from .context import CodingContext, coding_context
from .header import read_header, write_header
from .plain import BOX, round_networks, valid_box


class Quantised(NamedTuple):
    """A model as its file contains it."""

    model: Model  # every array as a decoder will have it, float64
    positions: np.ndarray  # [A, 3]  0 to 65535, int64
    symbols: np.ndarray  # [A, n]  int64, columns as `model.join`; 0 if nothing is coded
    kept: np.ndarray  # [A, n]  bool: which symbols are coded; those of masked children are not
    context: CodingContext


def coded_columns(mask, design):
    """Return which columns of `model.join` are coded [A, n]: not the numbers of masked children."""
    parts = zip(ATTRIBUTES, design.widths)
    return np.concatenate(
        [
            np.repeat(mask, width // design.k, axis=1)
            if row.per_child
            else np.ones((len(mask), width), bool)
            for row, width in parts
        ],
        axis=1,
    )


def dequantise(symbols, ctx, design):
    """Return f, s, l and O [A, k, 3] from symbols [A, n]: symbol times step."""
    values = np.empty(symbols.shape)
    for i, (part, out) in enumerate(zip(groups(symbols, design), groups(values, design))):
        np.multiply(part, ctx.q[:, i : i + 1], out=out)
    return split(values, design)


def quantise(model):
    """Round a model to what its file will contain. P-4DGS Eq. (10); choices Q14, Q15, Q18, Q19.

    Anchors whose children are all masked are dropped, except that one anchor always stays. In a
    scene without view effects, hidden units that are zero for every anchor are dropped too. Dropped
    and masked numbers may have any value; all others must be finite.

    Raises EncodeError, which names the array, and OverflowError, which names the element, if
    |f / q| is more than 2^31.
    """
    check_shapes(model)
    anchors, box = with_children(model.anchors), round_box(model.box)
    positions, x_a = snap(check_finite("anchors x_a", anchors.x_a), *box)
    anchors = anchors._replace(x_a=x_a)
    rounded = replace(model, anchors=anchors, networks=round_networks(model), box=box)
    return quantise_attributes(rounded, positions)


def quantise_attributes(model, positions):
    """Do the same for a model whose positions and networks are already those of its file."""
    grids = [
        np.where(check_finite(f"hash grid level {i}", grid) >= 0, 1.0, -1.0)
        for i, grid in enumerate(model.grids)
    ]
    model = replace(model, grids=grids, background=np.array(model.background, float))
    design, anchors = decoded_design(model), model.anchors
    kept = coded_columns(anchors.mask, design)
    ctx = coding_context(design, model.networks, grids, positions)
    symbols = round_attributes(np.where(kept, join(anchors), 0), ctx.q, design)
    anchors = Anchors(anchors.x_a, *dequantise(symbols, ctx, design), anchors.mask)
    rounded = without_silent_units(replace(model, design=design, anchors=anchors))
    return Quantised(rounded, positions, symbols, kept, ctx)


def with_children(anchors):
    """Return the anchors that have a child, or the first one if none has."""
    alive = anchors.mask.any(axis=1)
    if not alive.any():
        alive[0] = True
    return Anchors(*(array[alive] for array in anchors))


def without_silent_units(model):
    """Return the model without the hidden units of anchor networks that are 0 for every anchor.

    Without view effects the only input of these networks is the list of features, so a ReLU that
    is 0 for each of them changes no picture. The four networks share their widths, so from each as
    many units are removed as the one with the fewest silent units can lose. With view effects the
    input is not known, and the model is returned as it is. Features and weights must be the rounded
    ones of the file, because a unit that is 0 with these can be positive with others.

    A sum of fewer terms can differ in its last bit, which matters for a unit whose terms cancel.
    Units are therefore removed until none is silent, so that a decoded model encodes to its file.
    """
    if {"view_color", "view_geometry"} & set(model.design.effects) or not model.design.hidden:
        return model
    active = {name: active_units(model, name) for name in ANCHOR_NETWORKS}
    widths = tuple(int(max(1, *map(np.sum, layers))) for layers in zip(*active.values()))
    networks = dict(model.networks)
    for name, layers in active.items():
        # Active units first, then silent ones if another network of this width needs more.
        kept = [
            np.sort(np.argsort(~layer, kind="stable")[:width])
            for layer, width in zip(layers, widths)
        ]
        weights, biases = model.networks[name]
        rows, columns = [slice(None), *kept], [*kept, slice(None)]
        networks[name] = (
            # In row order, as a decoder has them: the order may affect the last bit, too.
            [np.array(W[i][:, j], order="C") for W, i, j in zip(weights, rows, columns)],
            [b[after] for b, after in zip(biases, columns)],
        )
    smaller = replace(model, design=replace(model.design, hidden=widths), networks=networks)
    return model if widths == tuple(model.design.hidden) else without_silent_units(smaller)


def active_units(model, name):
    """Return which units of each hidden layer of a network are positive for some anchor."""
    _, (layer_inputs, _) = mlp.forward(model.anchors.f_a, *model.networks[name])
    return [units.any(axis=0) for units in layer_inputs[1:]]


def round_attributes(values, q, design):
    """Return the symbols of attributes [A, n], by Eq. (10), group by group."""
    columns = []
    for i, part in enumerate(groups(values, design)):
        name = f"anchors {GROUPS[i]}_a"
        try:
            outputs, _ = rounding.forward(check_finite(name, part), q[:, i : i + 1])
        except OverflowError as error:
            raise OverflowError(f"{name}, kept children: {error}") from None
        columns.append(outputs[0])
    return np.concatenate(columns, axis=1)


def check_finite(name, array):
    """Return the array if all its numbers are finite, or raise EncodeError."""
    require_encodable(np.isfinite(array).all(), f"{name}: expected finite numbers")
    return array


def round_box(box):
    """Return the corners of the box in the precision of the file."""
    with np.errstate(over="ignore"):
        lo, hi = (np.asarray(corner, np.float32) for corner in box)
    require_encodable(
        lo.shape == hi.shape == (3,) and valid_box(lo, hi),
        f"box: expected two corners [3] with {BOX}",
    )
    return lo, hi


def decoded_design(model):
    """Return the design as a decoder will read it.

    Raises EncodeError for a design that it would refuse.
    """
    try:
        return read_header(write_header(model))[0]
    except BitstreamError as error:
        raise EncodeError(f"design: {error.message}") from None


def check_shapes(model):
    """Raise EncodeError unless every array has the shape that the design says."""
    design, A = model.design, len(model.anchors.mask)
    expected = {
        "anchors x_a": (A, 3),
        **{f"anchors {row.name}": (A, *row.sizes(design)) for row in ATTRIBUTES},
        "anchors mask": (A, design.k),
        "hash grid": design.levels(),
        **{
            f"network {name}": ([*pairs], [(columns,) for _, columns in pairs])
            for name, pairs in design.layers().items()
        },
    }
    shapes = {
        **{f"anchors {name}": array.shape for name, array in model.anchors._asdict().items()},
        "hash grid": [grid.shape for grid in model.grids],
        **{
            f"network {name}": tuple([a.shape for a in arrays] for arrays in pair)
            for name, pair in model.networks.items()
        },
    }
    for name in {**expected, **shapes}:
        require_encodable(
            shapes.get(name) == expected.get(name),
            f"{name}: expected {expected.get(name)} as the design says, got {shapes.get(name)}",
        )
    require_encodable(
        model.anchors.mask.dtype == bool and A,
        "anchors mask: expected booleans for at least one anchor",
    )
