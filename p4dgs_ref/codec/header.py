"""The header section: one JSON object with the design, the number of anchors and the background."""
import json
import math

import numpy as np

from ..model import Design
from ..scenes.scene import MODEL_EFFECTS
from .container import BitstreamError

LIMITS = {"anchors": 2**22, "d": 4096, "k": 256, "F": 64, "L_x": 64, "L_t": 64, "width": 2**14, "levels": 64,
          "resolution": 2**16, "table": 2**24, "numbers": 2**27}


def write_header(model):
    """The section's bytes: JSON without spaces, keys in a fixed order, every number as Python prints it."""
    fields = {"anchors": len(model.anchors.mask), "background": [float(c) for c in model.background],
              **model.design._asdict()}
    return json.dumps(fields, separators=(",", ":")).encode("ascii")


def read_header(data):
    """(design, number of anchors, background).

    Raises     BitstreamError for anything that is not an object with exactly these fields within LIMITS
    """
    def refuse(message):
        raise BitstreamError("header", 0, message)

    def whole(name, value, limit, least=1):
        if type(value) is not int or not least <= value <= limit:
            refuse(f"field {name!r}: expected a whole number from {least} to {limit}")
        return value

    try:
        fields = json.loads(data.decode("ascii"))
    except (UnicodeDecodeError, ValueError, RecursionError):
        refuse("expected a JSON object")
    expected = {"anchors", "background", *Design._fields}
    if not isinstance(fields, dict) or set(fields) != expected:
        refuse(f"expected exactly the fields {', '.join(sorted(expected))}")
    for name in ("anchors", "d", "k", "F", "L_x", "L_t"):
        whole(name, fields[name], LIMITS[name])
    for name in ("hidden", "deformation", "context", "grid", "table", "Q_0", "effects", "background"):
        if not isinstance(fields[name], list) or len(fields[name]) > LIMITS["levels"]:
            refuse(f"field {name!r}: expected a list of at most {LIMITS['levels']}")
    for name in ("hidden", "deformation", "context"):
        fields[name] = tuple(whole(name, n, LIMITS["width"]) for n in fields[name])
    _check_numbers(fields, refuse)
    fields["grid"] = tuple(_level(level, whole, refuse) for level in fields["grid"])
    if len(fields["table"]) != 2:
        refuse("field 'table': expected two sizes")
    fields["table"] = tuple(whole("table", size, LIMITS["table"]) for size in fields["table"])
    listed = tuple(fields["effects"])
    if any(effect not in MODEL_EFFECTS for effect in listed) or len(set(listed)) != len(listed):
        refuse(f"field 'effects': expected some of {', '.join(MODEL_EFFECTS)}, none twice")
    fields["effects"], fields["Q_0"] = listed, tuple(float(q) for q in fields["Q_0"])
    anchors, background = fields.pop("anchors"), np.array(fields.pop("background"), float)
    design = Design(**fields)
    if anchors * sum(design.widths) + sum(T * F for T, F in design.levels()) > LIMITS["numbers"]:
        refuse(f"more than {LIMITS['numbers']} numbers declared")
    return design, anchors, background


def _check_numbers(fields, refuse):
    for name, count, least in (("background", 3, -1e6), ("Q_0", 4, 2.0**-100)):
        values = fields[name]
        if len(values) != count or any(type(v) not in (int, float) or not least <= v <= 2.0**100 for v in values):
            refuse(f"field {name!r}: expected {count} finite numbers from {least} to 2^100")
    tau = fields["tau_alpha"]
    if type(tau) not in (int, float) or not math.isfinite(tau):
        refuse("field 'tau_alpha': expected a finite number")


def _level(level, whole, refuse):
    if not isinstance(level, list) or len(level) != 2 or level[0] not in ("xyz", "xy", "xz", "yz"):
        refuse("field 'grid': expected [axes, resolution] with axes xyz, xy, xz or yz")
    return level[0], whole("grid", level[1], LIMITS["resolution"], 2)
