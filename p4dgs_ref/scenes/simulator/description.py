"""Reads and checks scene.json, the description that the simulator draws. SCENE lists all fields.

Lengths are in scene units, z is up, angles are in degrees, colours are three numbers in [0, 1]. A
field that is not in the tables is refused, because a misspelt one would otherwise be ignored.
"""

from functools import partial
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
    require,
    text,
    typed,
)
from ..files import read_json
from ..scene import COLOR, NUMBER, POINT, SHARE, SIMULATOR_EFFECTS, check_effects


def direction(value, where):
    """Three numbers that are not all zero."""
    axis = POINT(value, where)
    require(axis.any(), where, f"{value!r}; expected a direction, not zero")
    return axis


POSITIVE = partial(numbers, low=1e-6, high=MAX_COORDINATE)
COUNT = partial(numbers, low=1, high=100_000, kind=int)
SIZE = partial(numbers, low=1, high=4096, shape=(2,), kind=int)
ELEVATION = partial(numbers, low=-89, high=89, shape=(2,))
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
    # `half` is half the length of the edges
    "box": {"half": (partial(POSITIVE, shape=(3,)), REQUIRED)},
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
        "axes": (partial(choice, words=("xy", "xyz")), "xyz"),
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
    "pulse": {"amount": (partial(numbers, low=-0.99, high=0.99), REQUIRED), **WAVE},
}
LIGHTS = {
    "sun": {"direction": (direction, REQUIRED), "ambient": (SHARE, REQUIRED)},
    "point": {"position": (POINT, REQUIRED), "ambient": (SHARE, REQUIRED)},
}
CAMERAS = {"scattered": VIEWS, "orbit": {**VIEWS, "turns": (NUMBER, REQUIRED)}}

SPECULAR = {
    "strength": (SHARE, REQUIRED),
    "exponent": (partial(numbers, low=1, high=1000), REQUIRED),
}
BODY = {
    "name": (text, REQUIRED),
    "shape": (partial(one_of, tables=SHAPES), REQUIRED),
    "color": (COLOR, REQUIRED),
    "texture": (partial(one_of, tables=TEXTURES), None),
    "specular": (partial(fields, table=SPECULAR), None),
    "position": (POINT, ORIGIN),
    "turn": (partial(fields, table=TURN), SimpleNamespace(axis=(0, 0, 1), degrees=0)),
    "parent": (text, None),
    "motion": (partial(list_of, check=partial(one_of, tables=MOTIONS)), ()),
    "faces_camera": (partial(typed, kind=bool), False),
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
    "lens": (partial(fields, table=LENS), REQUIRED),
    "cameras": (partial(one_of, tables=CAMERAS), REQUIRED),
    "light": (partial(one_of, tables=LIGHTS), REQUIRED),
    "bodies": (partial(list_of, check=partial(fields, table=BODY)), REQUIRED),
}


def read_description(source):
    """The checked description, a namespace with the fields of SCENE, from a file or a dictionary.

    Raises SceneError with one line that names the file, the field and what was expected.
    """
    is_read, expected = isinstance(source, dict), "a scene.json like that of tiny_scenes/bouncing"
    where = "scene" if is_read else str(source)
    description = fields(source if is_read else read_json(Path(source), expected), where, SCENE)
    require(description.bodies, f"{where}: bodies", "empty; expected at least one body")
    known = {None}
    for i, body in enumerate(description.bodies):
        require(
            body.name not in known and body.parent in known,
            f"{where}: bodies[{i}]",
            f"name {body.name!r}, parent {body.parent!r}; expected a name that no body before it "
            "has, and as parent a body listed before it",
        )
        known.add(body.name)
    return description
