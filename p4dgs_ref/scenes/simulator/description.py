"""Reads and checks scene.json, the description that the simulator draws. SCENE lists all fields.

Lengths are in scene units, z is up, angles are in degrees, colours are three numbers in [0, 1]. A
field that is not in the tables is refused, because a misspelt one would otherwise be ignored.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..fields import (
    MAX_COORDINATE,
    REQUIRED,
    choice,
    fields,
    list_of,
    numbers,
    one_of,
    require_field,
    text,
)
from ..files import read_json
from ..scene import COLOR, NUMBER, POINT, SHARE, SIMULATOR_EFFECTS, check_effects


def direction(value, where):
    """Return three numbers that are not all zero."""
    axis = POINT(value, where)
    require_field(axis.any(), where, f"{value!r}; expected a direction, not zero")
    return axis


def in_range(low, high, shape=(), kind=float):
    """Return the check of a number, or of an array of that shape."""
    return lambda value, where: numbers(value, where, low, high, shape, kind)


def axes(value, where):
    """Return the axes along which a checker alternates."""
    return choice(value, where, ("xy", "xyz"))


def objects(table):
    """Return the check of an object with the fields of a table."""
    return lambda value, where: fields(value, where, table)


def kinds(tables):
    """Return the check of an object whose field `kind` names one of the tables."""
    return lambda value, where: one_of(value, where, tables)


def lists(check):
    """Return the check of a list."""
    return lambda value, where: list_of(value, where, check)


POSITIVE = in_range(1e-6, MAX_COORDINATE)
HALF_EDGES = in_range(1e-6, MAX_COORDINATE, (3,))
COUNT = in_range(1, 100_000, kind=int)
SIZE = in_range(1, 4096, (2,), int)
ELEVATION = in_range(-89, 89, (2,))
AMOUNT = in_range(-0.99, 0.99)
EXPONENT = in_range(1, 1000)
ORIGIN = np.zeros(3)
WAVE = {"period": (POSITIVE, 1.0), "phase": (NUMBER, 0.0)}  # the phase in fractions of a period
TURN = {"axis": (direction, REQUIRED), "degrees": (NUMBER, REQUIRED)}
VIEWS = {
    "train": (COUNT, REQUIRED),
    "test": (COUNT, REQUIRED),
    "radius": (POSITIVE, REQUIRED),
    "elevation": (ELEVATION, REQUIRED),
    "target": (POINT, ORIGIN),
}

# The fields of every kind of shape, texture, motion, light and camera path.
SHAPES = {
    "sphere": {"radius": (POSITIVE, REQUIRED)},
    "box": {"half": (HALF_EDGES, REQUIRED)},
    "capsule": {
        "start": (POINT, REQUIRED),
        "end": (POINT, REQUIRED),
        "radius": (POSITIVE, REQUIRED),
    },
}
TEXTURES = {
    "checker": {
        "color": (COLOR, REQUIRED),
        "cell": (POSITIVE, REQUIRED),
        "axes": (axes, "xyz"),
    },
    "stripes": {
        "color": (COLOR, REQUIRED),
        "period": (POSITIVE, REQUIRED),
        "direction": (direction, REQUIRED),
    },
}
MOTIONS = {
    "line": {"by": (POINT, REQUIRED)},
    "bounce": {"height": (NUMBER, REQUIRED), **WAVE},
    "arc": {"center": (POINT, REQUIRED), "degrees": (NUMBER, REQUIRED), **WAVE},
    "swing": {**TURN, **WAVE},
    "spin": TURN,
    "pulse": {"amount": (AMOUNT, REQUIRED), **WAVE},
}
LIGHTS = {
    "sun": {"direction": (direction, REQUIRED), "ambient": (SHARE, REQUIRED)},
    "point": {"position": (POINT, REQUIRED), "ambient": (SHARE, REQUIRED)},
}
CAMERAS = {"scattered": VIEWS, "orbit": {**VIEWS, "turns": (NUMBER, REQUIRED)}}

SPECULAR = {
    "strength": (SHARE, REQUIRED),
    "exponent": (EXPONENT, REQUIRED),
}
BODY = {
    "name": (text, REQUIRED),
    "shape": (kinds(SHAPES), REQUIRED),
    "color": (COLOR, REQUIRED),
    "texture": (kinds(TEXTURES), None),
    "specular": (objects(SPECULAR), None),
    "position": (POINT, ORIGIN),
    "turn": (objects(TURN), SimpleNamespace(axis=(0, 0, 1), degrees=0)),
    "parent": (text, None),
    "motion": (lists(kinds(MOTIONS)), ()),
}
LENS = {  # in pixels; the principal point counts from the corner, as in the transforms files
    "fl_x": (POSITIVE, REQUIRED),
    "fl_y": (POSITIVE, REQUIRED),
    "cx": (NUMBER, REQUIRED),
    "cy": (NUMBER, REQUIRED),
}
SCENE = {
    "title": (text, REQUIRED),
    "license": (text, None),
    "effects": (check_effects, SIMULATOR_EFFECTS),
    "resolution": (SIZE, REQUIRED),
    "lens": (objects(LENS), REQUIRED),
    "cameras": (kinds(CAMERAS), REQUIRED),
    "light": (kinds(LIGHTS), REQUIRED),
    "bodies": (lists(objects(BODY)), REQUIRED),
}


def read_description(source):
    """Read the checked description, a namespace with the fields of SCENE, from a file or a dict.

    Raises SceneError with one line that names the file, the field and what was expected.
    """
    is_read, expected = isinstance(source, dict), "a scene.json like that of tiny_scenes/bouncing"
    where = "scene" if is_read else str(source)
    description = fields(source if is_read else read_json(Path(source), expected), where, SCENE)
    require_field(description.bodies, f"{where}: bodies", "empty; expected at least one body")
    known = {None}
    for i, body in enumerate(description.bodies):
        require_field(
            body.name not in known and body.parent in known,
            f"{where}: bodies[{i}]",
            f"name {body.name!r}, parent {body.parent!r}; expected a name that no body before it "
            "has, and as parent a body listed before it",
        )
        known.add(body.name)
    return description
