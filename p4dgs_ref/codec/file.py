"""The sections of a file: what each of them holds.

The sections stand in this order, that of their ids. Gaussian sections and bit sections are the
two kinds of streams in `streams.py`. A is the number of anchors.

    id  section          kind       content
    1   header           JSON       the design, A and the background (`header.py`)
    2   positions        plain      the box, 6 float32 (corner lo, then hi); 3 uint16 per anchor
    3   features         Gaussian   d symbols of f per anchor
    4   scales           Gaussian   3 symbols of s per anchor
    5   offset_scales    Gaussian   3 symbols of l per anchor
    6   offsets          Gaussian   3 symbols of O (x, y, z) per kept child, anchor by anchor and
                                    child by child
    7   masks            bits       k bits per anchor: 1 where the child is kept
    8   hash_grid        bits       level by level, T nodes of F entries, one bit each: 1 for an
                                    entry of +1, 0 for -1
    9   deformation_mlp  float16    psi_d, then psi_t where it exists; absent where nothing moves,
                                    also with `time_net`
    10  anchor_mlps      float16    psi_alpha, psi_c, psi_r, psi_s
    11  context_mlps     float16    psi_p, psi_q

In version 2, `version_2.py` says what follows the box in section 2 and what sections 9 to 11 hold.
All other sections are the same.

All numbers are little-endian. A decoder needs the sections in another order: it reads header,
positions, hash_grid and context_mlps and computes the coding context (`context.py`). It can then
read the Gaussian sections in any order, but masks before offsets.

Where a file has several mistakes, decoders may name different ones. This one names the first in
this order: the container; header and its limits; a section that is missing or unexpected, by id;
then positions, anchor_mlps, context_mlps, deformation_mlp, hash_grid, masks, features, scales,
offset_scales and offsets.

Every section is present, also an empty one (offsets where no child is kept), with one exception:
deformation_mlp is present if and only if the header lists translation, rotation or scaling. A
section of plain or float16 numbers has exactly their length. The box has lo <= hi and coordinates
of at most 1e30 (the double) in magnitude, and every weight is finite. The float32 next to 1e30 is
larger, so the largest coordinate is the float32 below it, 9.999999394896025e29.

Names. Every quantity has the same name everywhere, and the four groups of attributes always stand
in the order f, s, l, O:

    attribute of an anchor       base step   step   section
    f_a  its feature             Q_f         q_f    features
    s_a  its scale               Q_s         q_s    scales
    l_a  its offset scaling      Q_l         q_l    offset_scales
    O_a  its children's offsets  Q_O         q_O    offsets

The scales are coded as linear values. The header's Q_0 is the list of the four base steps. Of every
coded attribute, `symbol` is the integer in the file and q the step of its group. Its mean mu and
deviation sigma reach the coder as the integers mu_units and sigma_units, and q itself is q_units
times Q_0 2^-15. h is the hash feature from which psi_q predicts q, and psi_p predicts mu and sigma.
The anchors' positions x_a are in the section positions, the mask of their children in masks, and
the signs of the hash grid's entries in hash_grid.

Networks. A layer of I inputs and J outputs computes y = x W + b. It is stored as the I J numbers
W[i][j], j fastest, then the J numbers b[j]. The layers of a network lead from its inputs over the
hidden widths in the header to its outputs:

    psi_alpha, psi_c,   inputs: d, or d + 4 where the header lists the effect view_color (psi_c) or
    psi_r, psi_s        view_geometry (the others); hidden widths: `hidden`;
                        outputs: k, 3 k, 4 k and 3 k
    psi_p               inputs: h, F numbers per level; hidden widths: `context`;
                        outputs: 2 (d + 6 + 3 k), namely d means of f, d raw deviations of f,
                        3 means of s, 3 raw deviations of s, 3 and 3 of l, 3 k and 3 k of O
    psi_q               inputs and hidden widths as psi_p; outputs: 4, one each for f, s, l and O
    psi_d               inputs: 3 (1 + 2 L_x) + 1 + 2 L_t; hidden widths: `deformation`; then up to
                        three last layers side by side, each with its own W and b: 3, 3 and 4
                        outputs for translation, scaling and rotation, where the header lists them
    psi_t               only where the header has `time_net`: inputs 1 + 2 L_t, then its widths; its
                        outputs are inputs of psi_d instead of 1 + 2 L_t
                        With `skip`, the layer of psi_d after the middle one has the inputs of psi_d
                        before its others; of n widths it is number n // 2 + 1, counted from 0.

Values. A position is lo + n ((hi - lo) / 65535), n being its 16 bits, and an attribute is its
symbol times q, the step of its anchor and group. Each operation on doubles is rounded by itself (no
fused multiply-add). The offsets of masked children are 0.

Encoding again. Encoding a decoded model gives the same bytes if this encoder wrote the file.
Another valid file may give other bytes, because this encoder writes the header without spaces and
chooses the number of lanes, the length of the tail and the probability of a bit. In version 2 it
also chooses the base design, the raw bits of a gap, and the levels and codes of networks. The file
that it writes decodes to the same numbers, with three exceptions:

1. Anchors without children are dropped, except that one anchor always stays. The published stream
   `all_masked_but_one` has such anchors. The numbers of all other anchors stay.
2. In a scene without view effects, hidden units of the anchor networks that are 0 for every anchor
   are dropped. The pictures stay.
3. On an axis on which the box has no extent, every n stands for the same coordinate, so that a
   decoded model does not hold n, and 0 is stored. Where n was not 0 (only in version 1, as in
   `one_anchor`), the anchor gets another hash feature and therefore other steps, and its attributes
   move by half a new step at most. If a symbol would then exceed 2^31, the model is refused.

A model is also refused if the file that this encoder writes is too short for the limits of work in
`header.py`, which a longer file of the same model may meet.

Worked numbers. lo = -1.5, hi = 1.5 and n = 20000 give -1.5 + 20000 * (3 / 65535) =
-0.5844586861982147. With d = 4, k = 2, hidden = [8] and both view effects, anchor_mlps holds
(9 8 + 9 2) + (9 8 + 9 6) + (9 8 + 9 8) + (9 8 + 9 6) = 486 numbers, which are 972 bytes.
"""

import numpy as np

from ..model import ANCHOR_NETWORKS, CONTEXT_NETWORKS, Anchors, Model, unsnap
from .container import SECTIONS, BitstreamError, open_container, require, write_container
from .context import coding_context
from .gaussian_table import gaussian_model
from .header import check_work, read_header, write_header
from .quantise import BOX, EncodeError, Quantised, coded, dequantise, quantise, valid_box
from .streams import decode_bits, decode_symbols, encode_bits, encode_gaussian
from .version_2 import networks_of, read_gaps, read_weights, write_gaps, write_weights

NETWORK_SECTIONS = {
    "anchor_mlps": ANCHOR_NETWORKS,
    "context_mlps": CONTEXT_NETWORKS,
    "deformation_mlp": ("psi_d", "psi_t"),
}
ATTRIBUTE_SECTIONS = ("features", "scales", "offset_scales", "offsets")  # groups f, s, l, O


def attribute_columns(design):
    """The columns of `model.join` that each attribute section holds: [(section, slice), ...]."""
    ends = np.cumsum(design.widths)
    return [
        (name, slice(end - width, end))
        for name, end, width in zip(ATTRIBUTE_SECTIONS, ends, design.widths)
    ]


def sections_of(quantised):
    """The sections {name: bytes} of a quantised model.

    Raises EncodeError for a model that decoders refuse because it would cost them too much time.
    """
    model, ctx = quantised.model, quantised.context
    positions = np.concatenate(model.box).astype("<f4").tobytes()
    if model.design.coded:
        positions += write_gaps(quantised.positions, model.box, model.design.position_bits)
    else:
        positions += quantised.positions.astype("<u2").tobytes()
    signs = np.concatenate([grid.ravel() for grid in model.grids])
    sections = {
        "header": write_header(model),
        "positions": positions,
        "masks": encode_bits(model.anchors.mask.ravel()),
        "hash_grid": encode_bits(signs > 0),
    }
    for name, columns in attribute_columns(model.design):
        kept = quantised.kept[:, columns]
        arrays = (quantised.symbols, ctx.mu_units, ctx.sigma_units)
        sections[name] = encode_gaussian(*(array[:, columns][kept] for array in arrays))
    for name, members in NETWORK_SECTIONS.items():
        present = {member: model.networks[member] for member in members if member in model.networks}
        if present:
            sections[name] = (
                write_weights(present, model.steps)
                if model.design.coded
                else network_numbers(present).astype("<f2").tobytes()
            )
    try:
        check_work(model.design, len(model.anchors.mask), sum(map(len, sections.values())))
    except BitstreamError as error:
        raise EncodeError(f"design: {error.message}") from None
    return sections


def network_numbers(networks):
    """Weights and biases of some networks in the order of the file, as one array."""
    layers = [layer for network in networks.values() for layer in zip(*network)]
    return np.concatenate([array.ravel() for pair in layers for array in pair])


def encode(model: Model) -> bytes:
    """The file of a model, as bytes. The same model gives the same bytes.

    Raises EncodeError or OverflowError for a number that the format cannot hold.
    """
    quantised = quantise(model)
    return write_container(sections_of(quantised), 1 + quantised.model.design.coded)


def decode(data: bytes) -> Model:
    """The model in a file, bit for bit the one that `quantise` made of the encoded model.

    Raises BitstreamError, which names section and byte, for a file that is damaged or inconsistent.
    """
    return quantised_of(open_container(data), data[8]).model


def quantised_of(sections, version=1):
    """The quantised model in the sections of a file, the inverse of `sections_of`.

    Raises BitstreamError, which names section and byte.
    """
    require("header" in sections, "header", 0, "section is missing")
    design, A, background = read_header(sections["header"], version)
    check_work(design, A, sum(map(len, sections.values())))
    check_presence(sections, design.layers())
    box, positions = read_positions(sections["positions"], A, design)
    networks, steps, layers = {}, {}, design.layers()
    for name, members in NETWORK_SECTIONS.items():
        shapes = {member: layers[member] for member in members if member in layers}
        if shapes:
            read = read_weights if design.coded else read_networks
            decoded, codes = read(sections[name], name, shapes)
            networks, steps = networks | decoded, steps | codes
    grids = read_grids(sections["hash_grid"], design)
    mask = decode_bits(sections["masks"], A * design.k, "masks").reshape(A, design.k)
    ctx, kept = coding_context(design, networks, grids, positions), coded(mask, design)
    found = [
        (columns, read_symbols(sections[name], name, ctx, columns, kept))
        for name, columns in attribute_columns(design)
    ]
    # Allocated after decoding, because the memory limit leaves no room beside the coder's arrays.
    symbols = np.zeros(kept.shape, np.int64)
    for columns, values in found:
        symbols[:, columns][kept[:, columns]] = values
    del found, values
    anchors = Anchors(unsnap(positions, *box), *dequantise(symbols, ctx, design), mask)
    model = Model(design, anchors, networks, grids, box, background, steps or None)
    return Quantised(model, positions, symbols, kept, ctx)


def check_presence(sections, layers):
    """Refuse a file that lacks a section or has one that its scene does not need."""
    for name in SECTIONS:
        needed = name not in NETWORK_SECTIONS or layers.keys() & NETWORK_SECTIONS[name]
        require(name in sections or not needed, name, 0, "section is missing")
        unneeded = "scene lists no effect that needs this section"
        require(needed or name not in sections, name, 0, unneeded)


def read_symbols(data, name, ctx, columns, kept):
    """The coded symbols of one section, in the order of the file."""
    where = kept[:, columns]
    tables = gaussian_model(ctx.mu_units[:, columns][where], ctx.sigma_units[:, columns][where])
    return decode_symbols(data, tables, name)


def read_positions(data, A, design):
    """The box, two float32 arrays [3], and the positions [A, 3] int64."""
    least = 24 if design.coded else 24 + 6 * A
    require(
        len(data) >= least and (design.coded or len(data) == least),
        "positions",
        len(data),
        f"expected {least} bytes{' or more' * design.coded} for {A} anchors, found {len(data)}",
    )
    lo, hi = np.frombuffer(data, "<f4", 6).astype(np.float32).reshape(2, 3)
    require(valid_box(lo, hi), "positions", 0, f"expected a box with {BOX}")
    if design.coded:
        return (lo, hi), read_gaps(data, 24, A, (lo, hi), design.position_bits)
    return (lo, hi), np.frombuffer(data, "<u2", offset=24).astype(np.int64).reshape(A, 3)


def read_grids(data, design):
    """The levels [T, F] of the hash grid, +1 and -1."""
    shapes = design.levels()
    ends = np.cumsum([T * F for T, F in shapes])
    signs = np.split(decode_bits(data, int(ends[-1]), "hash_grid"), ends[:-1])
    return [np.where(part, 1.0, -1.0).reshape(shape) for part, shape in zip(signs, shapes)]


def read_networks(data, section, shapes):
    """The networks {name: (weights, biases)} of a section, float64, which have no steps: {}."""
    size = 2 * sum((I + 1) * J for network in shapes.values() for I, J in network)
    require(len(data) == size, section, len(data), f"expected {size} bytes, found {len(data)}")
    numbers = np.frombuffer(data, "<f2").astype(float)
    finite = np.isfinite(numbers)
    require(finite.all(), section, 2 * int(finite.argmin()), "expected finite weights")
    return networks_of(numbers, shapes), {}
