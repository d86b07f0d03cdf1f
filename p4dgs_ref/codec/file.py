"""A model as a file: which section holds what, in which order, written and read.

Section          content
header           JSON: design, number of anchors A, background                                (header.py)
positions        the box, 6 float32 (lo, then hi), then A times 3 uint16                      (raw)
masks            A k bits, anchor by anchor: 1 where a child is kept                           (Bernoulli)
hash_grid        level by level T nodes of F entries, a bit each: 1 for +1, 0 for -1           (Bernoulli)
features         A d symbols of f, anchor by anchor                                            (Gaussian)
scales           A 3 symbols of s                                                              (Gaussian)
offset_scales    A 3 symbols of l                                                              (Gaussian)
offsets          3 symbols (x, y, z) per kept child, anchor by anchor, child by child          (Gaussian)
anchor_mlps      psi_alpha, psi_c, psi_r, psi_s: layer by layer W (row by row), then b         (float16)
context_mlps     psi_p, psi_q                                                                  (float16)
deformation_mlp  psi_d; absent where nothing moves                                             (float16)

All numbers are little-endian.  A decoder reads header, positions, hash_grid and context_mlps, computes the coding
context (context.py), and can then read the Gaussian sections in any order; masks before offsets.  Every section is
there, but for deformation_mlp, which is there if and only if the header lists translation, rotation or scaling; empty
ones (no kept child: offsets) too.  Sections of plain numbers have exactly their length, lo <= hi, |lo| and |hi| at most
1e30 (the double), and every weight is finite.

NETWORKS.  A layer of I inputs and J outputs is y = x W + b: I J numbers W[i][j], j fastest, then J numbers b[j].  Layers
lead from the inputs over the widths that the header lists to the outputs:
    psi_alpha, psi_c, psi_r, psi_s   inputs d, or d + 4 with the effect view_color (psi_c) or view_geometry (the others);
                                     hidden; outputs k, 3 k, 4 k, 3 k
    psi_p, psi_q                     inputs h, one of every level and entry of a node: levels x F;  context;  outputs
                                     2 (d + 6 + 3 k): d mu of f, d raw sigma of f, 3 mu of s, 3 raw of s, 3 and 3 of l,
                                     3 k and 3 k of O; and 4: one of f, s, l, O each
    psi_d                            inputs 3 (1 + 2 L_x) + 1 + 2 L_t; deformation; then three layers beside each other
                                     on the last of those, W and b each: 3, 3, 4 outputs for translation, scaling,
                                     rotation, or 0 for what the header does not list

NUMBERS.  Each operation on doubles is rounded by itself (no fused multiply-add).  A position is lo + n ((hi - lo) /
65535) of its uint16 n, an attribute symbol times q, q being its anchor's and group's (context.py).  What is masked is 0.

WORKED NUMBERS.  lo = -1.5, hi = 1.5, n = 20000: -1.5 + 20000 * (3 / 65535) = -0.5844586861982147.
With d = 4, k = 2, hidden = [8] and both view effects, anchor_mlps holds (9 8 + 9 2) + (9 8 + 9 6) + (9 8 + 9 8) +
(9 8 + 9 6) = 486 numbers, 972 bytes.
"""

import numpy as np

from ..model import ANCHOR_NETWORKS, CONTEXT_NETWORKS, Anchors, Model, unsnap
from .container import BitstreamError, open_container, write_container
from .context import coding_context
from .gaussian_table import gaussian_model
from .header import read_header, write_header
from .quantise import LARGEST, Quantised, coded, dequantise, quantise
from .streams import decode_bits, decode_symbols, encode_bits, encode_gaussian

NETWORK_SECTIONS = {
    "anchor_mlps": ANCHOR_NETWORKS,
    "context_mlps": CONTEXT_NETWORKS,
    "deformation_mlp": ("psi_d",),
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
    """The sections {name: bytes} of a quantised model."""
    model, ctx = quantised.model, quantised.context
    box = np.concatenate(model.box).astype("<f4").tobytes()
    grid = np.concatenate([g.ravel() for g in model.grids])
    sections = {
        "header": write_header(model),
        "positions": box + quantised.positions.astype("<u2").tobytes(),
        "masks": encode_bits(model.anchors.mask.ravel()),
        "hash_grid": encode_bits(grid > 0),
    }
    for name, columns in attribute_columns(model.design):
        kept = quantised.kept[:, columns]
        sections[name] = encode_gaussian(
            *(a[:, columns][kept] for a in (quantised.symbols, ctx.mu_units, ctx.sigma_units))
        )
    for name, members in NETWORK_SECTIONS.items():
        numbers = network_numbers(model.networks, members)
        if numbers.size:
            sections[name] = numbers.astype("<f2").tobytes()
    return sections


def network_numbers(networks, members):
    """Weights and biases of some networks in the order of the file, as one array."""
    present = [networks[name] for name in members if name in networks]
    layers = [layer for network in present for layer in zip(*network)]
    return np.concatenate([np.zeros(0), *(array.ravel() for pair in layers for array in pair)])


def encode(model):
    """The file of a model, as bytes; the same model gives the same bytes.

    Raises     EncodeError, OverflowError where a number does not fit the format
    """
    return write_container(sections_of(quantise(model)))


def decode(data):
    """The model in a file: bit for bit the one that `quantise` made of what was encoded.

    Raises     BitstreamError naming section and offset for anything but a whole and consistent file
    """
    return quantised_of(open_container(data)).model


def quantised_of(sections):
    """The inverse of `sections_of`; the same names in the same order as in `quantise`.

    Raises     BitstreamError
    """
    design, A, background = read_header(_section(sections, "header"))
    box, positions = _read_positions(_section(sections, "positions"), A)
    networks, grids = (
        _read_networks(sections, design),
        _read_grids(_section(sections, "hash_grid"), design),
    )
    mask = decode_bits(_section(sections, "masks"), A * design.k, section="masks").reshape(
        A, design.k
    )
    x_a = unsnap(positions, *box)
    ctx, kept = coding_context(design, networks, grids, positions), coded(mask, design)
    found = [
        (columns, _read_symbols(sections, name, ctx, columns, kept))
        for name, columns in attribute_columns(design)
    ]
    symbols = np.zeros(
        kept.shape, np.int64
    )  # not before: beside the coder's arrays there is no room for it
    for columns, values in found:
        symbols[:, columns][kept[:, columns]] = values
    del found, values
    f, s, l, O = dequantise(symbols, ctx, design)
    model = Model(design, Anchors(x_a, f, s, l, O, mask), networks, grids, box, background)
    return Quantised(model, positions, symbols, kept, ctx)


def _section(sections, name):
    if name not in sections:
        raise BitstreamError(name, 0, "section is missing")
    return sections[name]


def _read_symbols(sections, name, ctx, columns, kept):
    """The symbols of one section that are coded, in the order of the file."""
    data, where = _section(sections, name), kept[:, columns]
    model = gaussian_model(ctx.mu_units[:, columns][where], ctx.sigma_units[:, columns][where])
    return decode_symbols(data, model, section=name)


def _read_positions(data, A):
    """The box, two (3,) float32, and the symbols (A, 3) int64."""
    if len(data) != 24 + 6 * A:
        raise BitstreamError(
            "positions",
            len(data),
            f"expected {24 + 6 * A} bytes for {A} anchors, found {len(data)}",
        )
    lo, hi = np.frombuffer(data, "<f4", 6).astype(np.float32).reshape(2, 3)
    if not ((np.abs([lo, hi]) <= LARGEST).all() and (lo <= hi).all()):  # also false for NaN
        raise BitstreamError(
            "positions", 0, f"expected a box with lo <= hi, finite, to {LARGEST:g}"
        )
    return (lo, hi), np.frombuffer(data, "<u2", offset=24).astype(np.int64).reshape(A, 3)


def _read_grids(data, design):
    """Levels (T, F) of +-1."""
    shapes = design.levels()
    ends = np.cumsum([T * F for T, F in shapes])
    bits = decode_bits(data, int(ends[-1]), section="hash_grid")
    return [
        np.where(part, 1.0, -1.0).reshape(shape)
        for part, shape in zip(np.split(bits, ends[:-1]), shapes)
    ]


def _read_networks(sections, design):
    """Networks {name: (weights, biases)} in float64, in the order in which they are stored."""
    networks, layers = {}, design.layers()
    for section, members in NETWORK_SECTIONS.items():
        present = [name for name in members if name in layers]
        if not present:
            if section in sections:
                raise BitstreamError(
                    section, 0, "the scene lists no effect that needs this section"
                )
            continue
        data, start = _section(sections, section), 0
        count = sum((rows + 1) * columns for name in present for rows, columns in layers[name])
        if len(data) != 2 * count:
            raise BitstreamError(
                section, len(data), f"expected {2 * count} bytes, found {len(data)}"
            )
        numbers = np.frombuffer(data, "<f2").astype(float)
        if not np.isfinite(numbers).all():
            raise BitstreamError(
                section, 2 * int(np.argmin(np.isfinite(numbers))), "expected finite weights"
            )
        for name in present:
            weights, biases = [], []
            for rows, columns in layers[name]:
                weights.append(numbers[start : start + rows * columns].reshape(rows, columns))
                biases.append(numbers[start + rows * columns : start + (rows + 1) * columns])
                start += (rows + 1) * columns
            networks[name] = (weights, biases)
    return networks
