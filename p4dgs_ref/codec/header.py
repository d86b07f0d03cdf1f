"""The header section: one JSON object (ASCII) with the number of anchors, the background and the fields of `Design`.

anchors            A, how many anchors the positions section holds: 1 to 2^22
background         three numbers, red, green, blue: -2^20 to 2^20
d, k, F            widths: of a feature, of the children, of a hash grid's node: 1 to 4096, 256, 64
hidden, context, deformation      lists of 0 to 8 hidden widths: anchor networks, psi_p and psi_q, psi_d: 1 to 2^14 each
L_x, L_t           frequencies of the positional encoding: 1 to 64
grid               list of 1 to 64 levels [axes, resolution R]: axes "xyz", "xy", "xz" or "yz", R from 1 to 2^16
table              most nodes of a level: [of a 3D one, of a 2D one]: 1 to 2^24 each; a level of D axes stores
                   T = min(R^D, table[0] where D = 3, table[1] where D = 2) nodes of F entries each
Q_0                four base steps: f, s, l, O: 2^-100 to 2^100
tau_alpha          the opacity below which a Gaussian is not drawn: -1 to 1
effects            the model's effects that the scene lists, none twice: some of "translation", "rotation", "scaling",
                   "view_color", "view_geometry", "occlusion", "background"; their order means nothing

Every field is there once, in any order, and no other.  Whole numbers are written without point and exponent (a reader
that cannot tell 4 from 4.0 may take both); the others are read as the nearest double, as JSON.parse and strtod do.

The declared model are the arrays that this header promises, every number counted as 8 bytes: of each anchor 3 + d + 6
+ 3 k attributes and k of the mask, the entries of the grid, the weights and biases of all networks.  At most 2^24
entries and 2^25 numbers in all; a decoder takes at most 64 MiB plus four times that, beside the file itself.  The
header has at most 2^14 bytes, as a parser of JSON takes many times its text.
"""

import json

import numpy as np

from ..model import Design
from ..scenes.scene import MODEL_EFFECTS
from .container import BitstreamError

LIMITS = {
    "anchors": 2**22,
    "d": 4096,
    "k": 256,
    "F": 64,
    "L_x": 64,
    "L_t": 64,
    "width": 2**14,
    "layers": 8,
    "levels": 64,
    "resolution": 2**16,
    "table": 2**24,
    "entries": 2**24,
    "numbers": 2**25,
    "bytes": 2**14,
}
RANGES = {
    "background": (3, -(2.0**20), 2.0**20),
    "Q_0": (4, 2.0**-100, 2.0**100),
    "tau_alpha": (1, -1.0, 1.0),
}


def write_header(model):
    """The section's bytes: JSON without spaces, keys in a fixed order, every number as Python prints it."""
    fields = {
        "anchors": len(model.anchors.mask),
        "background": [float(c) for c in model.background],
        **model.design._asdict(),
    }
    return json.dumps(fields, separators=(",", ":")).encode("ascii")


def read_header(data):
    """(design, number of anchors, background).

    Raises     BitstreamError for anything that is not an object with exactly these fields within LIMITS and RANGES
    """
    if len(data) > LIMITS["bytes"]:
        raise _refusal(f"{len(data)} bytes, at most {LIMITS['bytes']} expected")
    try:
        fields = json.loads(str(data, "ascii"), object_pairs_hook=_once_each)
    except (UnicodeDecodeError, ValueError, RecursionError):
        raise _refusal("expected a JSON object, no field twice") from None
    expected = {"anchors", "background", *Design._fields}
    if not isinstance(fields, dict) or set(fields) != expected:
        raise _refusal(f"expected exactly the fields {', '.join(sorted(expected))}")
    anchors = _whole("anchors", fields.pop("anchors"), LIMITS["anchors"])
    background = np.array(_numbers("background", fields.pop("background")))
    for name in ("d", "k", "F", "L_x", "L_t"):
        _whole(name, fields[name], LIMITS[name])
    for name in ("hidden", "deformation", "context"):
        fields[name] = tuple(
            _whole(name, n, LIMITS["width"])
            for n in _listed(name, fields[name], 0, LIMITS["layers"])
        )
    fields["grid"] = tuple(
        _level(level) for level in _listed("grid", fields["grid"], 1, LIMITS["levels"])
    )
    fields["table"] = tuple(
        _whole("table", size, LIMITS["table"]) for size in _listed("table", fields["table"], 2, 2)
    )
    fields["Q_0"] = _numbers("Q_0", fields["Q_0"])
    (fields["tau_alpha"],) = _numbers("tau_alpha", [fields["tau_alpha"]])
    effects = _listed("effects", fields["effects"], 0, len(MODEL_EFFECTS))
    if any(effect not in MODEL_EFFECTS for effect in effects) or len(set(effects)) != len(effects):
        raise _refusal(f"field 'effects': expected some of {', '.join(MODEL_EFFECTS)}, none twice")
    fields["effects"] = tuple(effects)
    design = Design(**fields)
    _check_size(design, anchors)
    return design, anchors, background


def declared_numbers(design, anchors):
    """How many numbers the arrays of the decoded model hold: (anchors' attributes and masks, grid, networks)."""
    weights = sum(
        (rows + 1) * columns for layers in design.layers().values() for rows, columns in layers
    )
    return (
        anchors * (3 + sum(design.widths) + design.k),
        sum(T * F for T, F in design.levels()),
        weights,
    )


def _check_size(design, anchors):
    """The largest model: 256 MiB, for example 400,000 anchors of `paper_real`."""
    per_kind = declared_numbers(design, anchors)
    if per_kind[1] > LIMITS["entries"]:
        raise _refusal(
            f"field 'grid': {per_kind[1]} entries declared, at most {LIMITS['entries']} expected"
        )
    if sum(per_kind) > LIMITS["numbers"]:
        raise _refusal(
            f"{sum(per_kind)} numbers declared (anchors {per_kind[0]}, grid {per_kind[1]}, networks "
            f"{per_kind[2]}), at most {LIMITS['numbers']} expected"
        )


def _refusal(message):
    return BitstreamError("header", 0, message)


def _once_each(pairs):
    if len(dict(pairs)) != len(pairs):
        raise ValueError
    return dict(pairs)


def _whole(name, value, limit):
    if type(value) is not int or not 1 <= value <= limit:  # type: a bool is not a number
        raise _refusal(f"field {name!r}: expected a whole number from 1 to {limit}")
    return value


def _numbers(name, values):
    count, least, most = RANGES[name]
    if (
        not isinstance(values, list)
        or len(values) != count
        or any(type(v) not in (int, float) or not least <= v <= most for v in values)
    ):  # also false for NaN
        raise _refusal(
            f"field {name!r}: expected {'a number' if count == 1 else f'{count} numbers'} "
            f"from {least:g} to {most:g}"
        )
    return tuple(float(v) for v in values)


def _listed(name, values, least, most):
    if not isinstance(values, list) or not least <= len(values) <= most:
        raise _refusal(f"field {name!r}: expected a list of {least} to {most}")
    return values


def _level(level):
    if not isinstance(level, list) or len(level) != 2 or level[0] not in ("xyz", "xy", "xz", "yz"):
        raise _refusal("field 'grid': expected [axes, resolution] with axes xyz, xy, xz or yz")
    return level[0], _whole("grid", level[1], LIMITS["resolution"])
