"""The header section: one JSON object in ASCII.

    anchors       A, the number of anchors: 1 to 2^22
    background    three numbers, red, green and blue: -2^20 to 2^20
    d             width of an anchor's feature: 1 to 4096
    k             children per anchor: 1 to 256
    hidden        list of 0 to 8 hidden widths of the anchor networks: 1 to 2^14 each
    deformation   likewise, of psi_d
    L_x, L_t      frequencies of the positional encoding of x and of t: 1 to 64 each
    context       list of 0 to 8 hidden widths of psi_p and psi_q: 1 to 2^14 each
    grid          list of 1 to 64 levels [axes, R]: axes "xyz", "xy", "xz" or "yz", and resolution
                  R, 1 to 2^16
    table         [most nodes of a 3D level, most nodes of a 2D level]: 1 to 2^24 each
    F             entries per node of the hash grid: 1 to 64
    Q_0           list of the four base steps of f, s, l, O: 2^-100 to 2^100
    tau_alpha     opacity below which a Gaussian is not drawn: 0 to 1
    effects       list of the effects of the scene, none twice, in any order: some of "translation",
                  "rotation", "scaling", "view_color", "view_geometry", "occlusion", "background"

Every field occurs exactly once, in any order, and there are no others. background, Q_0 and
tau_alpha are numbers that are read as the nearest double, as JSON.parse and strtod do; the ranges
apply to this double. All other numbers are integers, written without point or exponent; a reader
that cannot tell 4 from 4.0 may accept both. JSON.parse is such a reader, and of two equal fields it
silently keeps the last. The port in `viewer/p4dgs.js` therefore counts the keys in the text and
marks numbers with a point or an exponent before it parses, and refuses repeated keys and such
numbers in place of integers.

A level with D axes stores T = min(R^D, its number in `table`) nodes with F entries each.

The header declares the following numbers: for every anchor 3 + d + 6 + 3 k attributes and k masks,
the entries of the grid, and the weights and biases of all networks that the file contains; if
nothing moves, psi_d does not count, whatever its widths. There are at most 2^24 entries of the grid
and at most 2^25 numbers in all. A decoder needs at most 64 MiB plus four times 8 bytes for each of
these numbers, beside the file itself. This is enough to decode a file and to list what its bytes
are spent on. Drawing holds all A k Gaussians at once: a picture of 64x64 needs up to 1 KiB for each
of them in addition, and 8 bytes for each hidden unit, of the four anchor networks for every anchor
and of psi_d for every Gaussian. The header has at most 2^14 bytes, because a JSON parser needs many
times the memory of its text.

Time is bounded by n, the number of bytes of all sections together. The header declares at most
2^22 + 2^4 n numbers. The coding context of one anchor needs a multiplication for every weight of
psi_p and psi_q, without biases, and reads 2^D nodes of F entries in every level of D axes. A node
counts as 64 (F + 8) multiplications, because memory is slower than arithmetic. All anchors together
need at most 2^34 + 2^15 n multiplications. The files of all presets stay within both limits,
whatever the number of their anchors. A decoder checks all limits before it reads other sections.
"""

import json

import numpy as np

from ..attributes import ATTRIBUTES
from ..limits import (
    MAX_ANCHORS,
    MAX_ENTRIES,
    MAX_HEADER_BYTES,
    MAX_LAYERS,
    MAX_OF,
    MAX_WIDTH,
)
from ..model import CONTEXT_NETWORKS, Design, declared_numbers, most_numbers, over_limits
from ..scenes.scene import MODEL_EFFECTS
from .container import expect

AXES = ("xyz", "xy", "xz", "yz")
MAX_DIGITS = 100  # of an integer that is read as one; every limit has fewer


def write_header(model):
    """Return the section's bytes: JSON without spaces, keys in a fixed order."""
    background = [float(c) for c in model.background]
    fields = {"anchors": len(model.anchors.mask), "background": background, **vars(model.design)}
    return json.dumps(fields, separators=(",", ":")).encode("ascii")


def read_header(data):
    """Return the design, the number of anchors and the background of a header section.

    Raises BitstreamError for anything but an object with exactly the fields above, in their ranges.
    """
    require_header(
        len(data) <= MAX_HEADER_BYTES, f"{len(data)} bytes, expected at most {MAX_HEADER_BYTES}"
    )
    try:
        pairs = json.loads(str(data, "ascii"), object_pairs_hook=tuple, parse_int=whole_number)
    except (ValueError, RecursionError):
        pairs = []
    whole = isinstance(pairs, tuple) and len(dict(pairs)) == len(pairs)
    require_header(whole, "expected a JSON object without repeated fields")
    fields = dict(pairs)
    require_header(
        fields.keys() == FIELDS.keys(), f"expected the fields {', '.join(FIELDS)}, once each"
    )
    values = {name: read(name, fields[name]) for name, read in FIELDS.items()}
    require_header(
        len(set(values["effects"])) == len(values["effects"]),
        "field 'effects': expected each effect at most once",
    )
    anchors, background = values.pop("anchors"), np.array(values.pop("background"))
    design = Design(**values)
    excess = over_limits(design, anchors)
    require_header(not excess, excess)
    return design, anchors, background


def check_work(design, anchors, size):
    """Refuse a header that declares more work than `size` bytes of sections may cause."""
    numbers, most = sum(declared_numbers(design, anchors).values()), most_numbers(size)
    require_header(
        numbers <= most,
        f"{numbers} numbers declared, expected at most {most} in sections of {size} bytes",
    )
    weights = sum(I * J for name in CONTEXT_NETWORKS for I, J in design.layers()[name])
    nodes = sum(2 ** len(axes) for axes, _ in design.grid)
    work, most = anchors * (weights + nodes * 64 * (design.F + 8)), 2**34 + 2**15 * size
    require_header(
        work <= most,
        f"{work} multiplications declared, expected at most {most} for sections of {size} bytes",
    )


def require_header(holds, message):
    """Refuse the header unless a condition holds."""
    expect(holds, "header", 0, message)


def field(holds, expected, convert=lambda value: value):
    """Return a reader that checks a field's value by the condition `holds` and converts it."""

    def read(name, value):
        require_header(holds(value), f"field {name!r}: expected {expected}")
        return convert(value)

    return read


def integer(most):
    """Return the reader of an integer field from 1 to `most`."""
    return field(  # a bool has another type
        lambda value: type(value) is int and 1 <= value <= most,
        f"a whole number from 1 to {most}",
    )


def whole_number(digits):
    """Return the integer that is written, or the nearest double if it has too many digits."""
    return int(digits) if len(digits) < MAX_DIGITS else float(digits)


def real(least, most):
    """Return the reader of a number whose nearest double is in a range."""
    return field(  # false for NaN
        lambda value: type(value) in (int, float) and least <= float(value) <= most,
        f"a number from {least:g} to {most:g}",
        float,
    )


def list_of(read_item, least, most):
    """Return the reader of a list of `least` to `most` items."""
    a_list = field(
        lambda values: isinstance(values, list) and least <= len(values) <= most,
        f"a list of {most if least == most else f'{least} to {most}'}",
    )
    return lambda name, values: tuple(read_item(name, value) for value in a_list(name, values))


def level(name, value):
    """Read a level of the hash grid, [axes, resolution]."""
    require_header(
        isinstance(value, list) and len(value) == 2 and value[0] in AXES,
        f"field {name!r}: expected [axes, resolution] with axes {', '.join(AXES)}",
    )
    return value[0], integer(2**16)(name, value[1])


EFFECT = field(lambda value: value in MODEL_EFFECTS, f"some of {', '.join(MODEL_EFFECTS)}")
WIDTHS = list_of(integer(MAX_WIDTH), 0, MAX_LAYERS)  # of hidden layers
FIELDS = {
    "anchors": integer(MAX_ANCHORS),
    "background": list_of(real(-(2.0**20), 2.0**20), 3, 3),
    "d": integer(MAX_OF["d"]),
    "k": integer(MAX_OF["k"]),
    "hidden": WIDTHS,
    "deformation": WIDTHS,
    "L_x": integer(MAX_OF["L_x"]),
    "L_t": integer(MAX_OF["L_t"]),
    "context": WIDTHS,
    "grid": list_of(level, 1, 64),
    "table": list_of(integer(MAX_ENTRIES), 2, 2),
    "F": integer(MAX_OF["F"]),
    "Q_0": list_of(real(2.0**-100, 2.0**100), len(ATTRIBUTES), len(ATTRIBUTES)),
    "tau_alpha": real(0.0, 1.0),
    "effects": list_of(EFFECT, 0, len(MODEL_EFFECTS)),
}
