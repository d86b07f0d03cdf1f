"""The sections of a file: what each of them contains.

The sections are in this order, that of their ids. Gaussian sections and bit sections are the two
kinds of streams in `streams.py`. A is the number of anchors.

    id  section          kind       content
    1   header           JSON       the design, A and the background (`header.py`)
    2   positions        plain      the box, 6 float32 (corner lo, then hi); 3 uint16 per anchor
    3   features         Gaussian   d symbols of f per anchor
    4   scales           Gaussian   3 symbols of s per anchor
    5   offset_scales    Gaussian   3 symbols of l per anchor
    6   offsets          Gaussian   3 symbols of O (x, y, z) per kept child, anchor by anchor and
                                    child by child
    7   masks            bits       k bits per anchor: 1 if the child is kept
    8   hash_grid        bits       level by level, T nodes of F entries, one bit each: 1 for an
                                    entry of +1, 0 for -1
    9   deformation_mlp  float16    psi_d; absent if nothing moves
    10  anchor_mlps      float16    psi_alpha, psi_c, psi_r, psi_s
    11  context_mlps     float16    psi_p, psi_q

All numbers are little-endian. A decoder needs the sections in another order: it reads header,
positions, hash_grid and context_mlps and computes the coding context (`context.py`). It can then
read the Gaussian sections in any order, but masks before offsets.

If a file has several mistakes, decoders may name different ones. This one names the first in
this order: the container; header and its limits; a section that is missing or unexpected, by id;
then positions, anchor_mlps, context_mlps, deformation_mlp, hash_grid, masks, features, scales,
offset_scales and offsets.

Every section is present, even an empty one (offsets if no child is kept), with one exception:
deformation_mlp is present if and only if the header lists translation, rotation or scaling. A
section of plain or float16 numbers has exactly their length. The box has lo <= hi and coordinates
of at most 1e30 (the double) in magnitude, and every weight is finite. The float32 nearest to 1e30
is larger, so the largest coordinate is the float32 below it, 9.999999394896025e29.

Names. Every quantity has the same name everywhere, and the four groups of attributes are always in
the order f, s, l, O:

    attribute of an anchor       base step   step   section
    f_a  its feature             Q_f         q_f    features
    s_a  its scale               Q_s         q_s    scales
    l_a  its offset scaling      Q_l         q_l    offset_scales
    O_a  its children's offsets  Q_O         q_O    offsets

The scales are coded as linear values. The header's Q_0 is the list of the four base steps. For each
coded attribute, `symbol` is the integer in the file and q the step of its group. Its mean mu and
deviation sigma reach the coder as the integers mu_units and sigma_units, and q itself is q_units
times Q_0 2^-15. h is the hash feature from which psi_q predicts q, and psi_p predicts mu and sigma.
The anchors' positions x_a are in the section positions, the mask of their children in masks, and
the signs of the hash grid's entries in hash_grid.

Networks. A layer of I inputs and J outputs computes y = x W + b. It is stored as the I J numbers
W[i][j], j fastest, then the J numbers b[j]. The layers of a network lead from its inputs over the
hidden widths in the header to its outputs:

    psi_alpha, psi_c,   inputs: d, or d + 4 if the header lists the effect view_color (psi_c) or
    psi_r, psi_s        view_geometry (the others); hidden widths: `hidden`;
                        outputs: k, 3 k, 4 k and 3 k
    psi_p               inputs: h, F numbers per level; hidden widths: `context`;
                        outputs: 2 (d + 6 + 3 k), namely d means of f, d raw deviations of f,
                        3 means of s, 3 raw deviations of s, 3 and 3 of l, 3 k and 3 k of O
    psi_q               inputs and hidden widths as psi_p; outputs: 4, one each for f, s, l and O
    psi_d               inputs: 3 (1 + 2 L_x) + 1 + 2 L_t; hidden widths: `deformation`; then up to
                        three last layers side by side, each with its own W and b: 3, 3 and 4
                        outputs for translation, scaling and rotation, if the header lists them

Values. A position is lo + n ((hi - lo) / 65535), n being its 16 bits, and an attribute is its
symbol times q, the step of its anchor and group. Each operation on doubles is rounded separately
(no fused multiply-add). The offsets of masked children are 0.

Encoding again. Encoding a decoded model gives the same bytes if this encoder wrote the file.
Another valid file may give other bytes, because this encoder writes the header without spaces and
chooses the number of lanes, the length of the tail and the probability of a bit. The file that it
writes decodes to the same numbers, with three exceptions:

1. Anchors without children are dropped, except that one anchor always stays. The published stream
   `all_masked_but_one` has such anchors. The numbers of all other anchors stay the same.
2. In a scene without view effects, hidden units of the anchor networks that are 0 for every anchor
   are dropped. The pictures stay the same.
3. On an axis on which the box has no extent, every n stands for the same coordinate, so that a
   decoded model does not contain n, and 0 is stored. If n was not 0 (as in `one_anchor`), the
   anchor gets another hash feature and therefore other steps, and its attributes move by half a new
   step at most. If a symbol would then exceed 2^31, the model is refused.

A model is also refused if the file that this encoder writes is too short for the limits of work in
`header.py`, which a longer file of the same model may meet.

Worked example. lo = -1.5, hi = 1.5 and n = 20000 give -1.5 + 20000 * (3 / 65535) =
-0.5844586861982147. With d = 4, k = 2, hidden = [8] and both view effects, anchor_mlps contains
(9 8 + 9 2) + (9 8 + 9 6) + (9 8 + 9 8) + (9 8 + 9 6) = 486 numbers, which are 972 bytes.
"""

from dataclasses import replace

import numpy as np

from ..attributes import ATTRIBUTES
from ..model import ANCHOR_NETWORKS, CONTEXT_NETWORKS, Anchors, Model, unsnap
from .container import (
    SECTIONS,
    BitstreamError,
    EncodeError,
    expect,
    read_container,
    write_container,
)
from .context import coding_context
from .gaussian_table import gaussian_model
from .header import check_work, read_header, write_header
from .plain import read_networks, read_positions, write_networks, write_positions
from .quantise import Quantised, coded_columns, dequantise, quantise
from .streams import decode_bits, decode_symbols, encode_bits, encode_gaussian

NETWORK_SECTIONS = {
    "anchor_mlps": ANCHOR_NETWORKS,
    "context_mlps": CONTEXT_NETWORKS,
    "deformation_mlp": ("psi_d",),
}
ATTRIBUTE_SECTIONS = tuple(row.section for row in ATTRIBUTES)


def attribute_columns(design):
    """Return the columns of `model.join` in each attribute section: [(section, slice), ...]."""
    ends = np.cumsum(design.widths)
    return [
        (name, slice(end - width, end))
        for name, end, width in zip(ATTRIBUTE_SECTIONS, ends, design.widths)
    ]


def sections_of(quantised):
    """Return the sections {name: bytes} of a quantised model.

    Raises EncodeError for a model that decoders would refuse because it costs too much time.
    """
    model, ctx = quantised.model, quantised.context
    signs = np.concatenate([grid.ravel() for grid in model.grids])
    sections = {
        "header": write_header(model),
        "positions": write_positions(model, quantised.positions),
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
            sections[name] = write_networks(present)
    try:
        check_work(model.design, len(model.anchors.mask), sum(map(len, sections.values())))
    except BitstreamError as error:
        raise EncodeError(f"design: {error.message}") from None
    return sections


def encode(model: Model) -> bytes:
    """Return the file of a model, as bytes; the same model gives the same bytes.

    Raises EncodeError or OverflowError for a number that the format cannot store.
    """
    return write_container(sections_of(quantise(model)))


def decode(data: bytes) -> Model:
    """Return the model in a file, bit for bit what `quantise` made of the encoded model.

    Raises BitstreamError, which names section and byte, for a file that is damaged or inconsistent.
    """
    return quantised_of(read_container(data)).model


def quantised_of(sections):
    """Return the quantised model in the sections of a file, the inverse of `sections_of`.

    Raises BitstreamError, which names section and byte.
    """
    expect("header" in sections, "header", 0, "section is missing")
    design, A, background = read_header(sections["header"])
    check_work(design, A, sum(map(len, sections.values())))
    check_presence(sections, design.layers())
    box, positions = read_positions(sections["positions"], A)
    networks, layers = {}, design.layers()
    for name, members in NETWORK_SECTIONS.items():
        shapes = {member: layers[member] for member in members if member in layers}
        if shapes:
            networks |= read_networks(sections[name], name, shapes)
    model = Model(design, None, networks, [], box, background)
    return decode_attributes(sections, model, positions)


def decode_attributes(sections, model, positions):
    """Decode grids, masks and attributes of a model whose other parts have been read."""
    design, A = model.design, len(positions)
    grids = read_grids(sections["hash_grid"], design)
    mask = decode_bits(sections["masks"], A * design.k, "masks").reshape(A, design.k)
    kept = coded_columns(mask, design)
    ctx = coding_context(design, model.networks, grids, positions)
    decoded = [
        (columns, read_symbols(sections[name], name, ctx, columns, kept))
        for name, columns in attribute_columns(design)
    ]
    # Allocated after decoding, because the memory limit leaves no room beside the coder's arrays.
    symbols = np.zeros(kept.shape, np.int64)
    for columns, values in decoded:
        symbols[:, columns][kept[:, columns]] = values
    del decoded, values
    anchors = Anchors(unsnap(positions, *model.box), *dequantise(symbols, ctx, design), mask)
    return Quantised(replace(model, anchors=anchors, grids=grids), positions, symbols, kept, ctx)


def check_presence(sections, layers):
    """Refuse a file that lacks a section or has one that its scene does not need."""
    for name in SECTIONS:
        needed = name not in NETWORK_SECTIONS or layers.keys() & NETWORK_SECTIONS[name]
        expect(name in sections or not needed, name, 0, "section is missing")
        unneeded = "scene lists no effect that needs this section"
        expect(needed or name not in sections, name, 0, unneeded)


def read_symbols(data, name, ctx, columns, kept):
    """Return the coded symbols of one section, in the order of the file."""
    where = kept[:, columns]
    tables = gaussian_model(ctx.mu_units[:, columns][where], ctx.sigma_units[:, columns][where])
    return decode_symbols(data, tables, name)


def read_grids(data, design):
    """Return the levels [T, F] of the hash grid, +1 and -1."""
    shapes = design.levels()
    ends = np.cumsum([T * F for T, F in shapes])
    signs = np.split(decode_bits(data, int(ends[-1]), "hash_grid"), ends[:-1])
    return [np.where(part, 1.0, -1.0).reshape(shape) for part, shape in zip(signs, shapes)]
