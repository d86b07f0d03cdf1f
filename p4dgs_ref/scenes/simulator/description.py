"""Reads and checks scene.json, the description that the simulator draws. SCENE lists all fields.

Lengths are in scene units, z is up, angles are in degrees, colours are three numbers in [0, 1]. A
field that is not in the tables is refused, because a misspelt one would otherwise be ignored.

A reader is a function of a value and of the place where it stands. It returns the checked value or
raises a SceneError that names the place and what was expected.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..files import read_json
from ..scene import SIMULATOR_EFFECTS, check_effects, is_number, require

REQUIRED = object()


def below(where, name):
    """The place of a field: "scene.json: light", then "scene.json: light.kind"."""
    return f"{where}.{name}" if ": " in where else f"{where}: {name}"


def number(low=-1e6, high=1e6, integer=False):
    """A reader of one number from low to high."""
    kind, types = ("an integer", [int]) if integer else ("a number", [int, float])

    def read(value, where):
        require(
            is_number(value, *types) and low <= value <= high,
            where,
            f"{value!r}; expected {kind} in [{low:g}, {high:g}]",
        )
        return value

    return read


def vector(n, low=-1e6, high=1e6, integer=False, nonzero=False):
    """A reader of n numbers from low to high."""
    read_entry = number(low, high, integer)

    def read(value, where):
        require(
            isinstance(value, list) and len(value) == n,
            where,
            f"{value!r}; expected a list of {n} numbers",
        )
        entries = [read_entry(entry, f"{where}[{i}]") for i, entry in enumerate(value)]
        require(
            any(entries) or not nonzero,
            where,
            f"{value!r}; expected a direction, not zero",
        )
        return np.array(entries, int if integer else float)

    return read


def choice(table):
    """A reader of a word from a table, which returns the entry of the table."""

    def read(value, where):
        require(
            isinstance(value, str) and value in table,
            where,
            f"{value!r}; expected one of {', '.join(table)}",
        )
        return table[value]

    return read


def text(value, where):
    """Read a text that is not empty."""
    require(isinstance(value, str) and value, where, f"{value!r}; expected some text")
    return value


def flag(value, where):
    """Read true or false."""
    require(isinstance(value, bool), where, f"{value!r}; expected true or false")
    return value


def fields(table):
    """A reader of an object with the fields of a table, {name: (reader, default)}."""
    names = ", ".join(table)

    def read(value, where):
        require(isinstance(value, dict), where, f"{value!r}; expected an object with {names}")
        for name in value:
            require(name in table, below(where, name), f"unknown field; expected some of {names}")
        found = SimpleNamespace()
        for name, (reader, default) in table.items():
            place = below(where, name)
            require(name in value or default is not REQUIRED, place, "missing; expected a value")
            setattr(found, name, reader(value[name], place) if name in value else default)
        return found

    return read


def one_of(tables):
    """A reader of an object whose field `kind` chooses the table of its other fields."""
    readers = {kind: fields({"kind": (text, REQUIRED), **rest}) for kind, rest in tables.items()}

    def read(value, where):
        place = f"{where}.kind"
        require(
            isinstance(value, dict) and "kind" in value,
            place,
            f"missing; expected one of {', '.join(tables)}",
        )
        return choice(readers)(value["kind"], place)(value, where)

    return read


def list_of(reader):
    """A reader of a list whose entries `reader` reads."""

    def read(value, where):
        require(isinstance(value, list), where, f"{value!r}; expected a list")
        return [reader(entry, f"{where}[{i}]") for i, entry in enumerate(value)]

    return read


NUMBER = number()
POSITIVE = number(low=1e-6)
SHARE = number(0, 1)
COUNT = number(1, 100_000, integer=True)
COLOR = vector(3, 0, 1)
POINT = vector(3)
AXIS = vector(3, nonzero=True)
ORIGIN = np.zeros(3)
WAVE = {"period": (POSITIVE, 1.0), "phase": (NUMBER, 0.0)}  # the phase in fractions of a period

SHAPE = one_of(
    {
        "sphere": {"radius": (POSITIVE, REQUIRED), "center": (POINT, ORIGIN)},
        # `half` is half the length of the edges
        "box": {"half": (vector(3, low=1e-6), REQUIRED), "center": (POINT, ORIGIN)},
        "capsule": {
            "start": (POINT, REQUIRED),
            "end": (POINT, REQUIRED),
            "radius": (POSITIVE, REQUIRED),
        },
    }
)
TEXTURE = one_of(
    {
        "checker": {
            "color": (COLOR, REQUIRED),
            "cell": (POSITIVE, REQUIRED),
            "axes": (choice({"xy": [0, 1], "xyz": [0, 1, 2]}), [0, 1, 2]),
        },
        "stripes": {
            "color": (COLOR, REQUIRED),
            "period": (POSITIVE, REQUIRED),
            "direction": (AXIS, REQUIRED),
        },
    }
)
MOTION = one_of(
    {
        "line": {"by": (POINT, REQUIRED)},
        "bounce": {"height": (NUMBER, REQUIRED), **WAVE},
        "arc": {"center": (POINT, REQUIRED), "degrees": (NUMBER, REQUIRED), **WAVE},
        "swing": {"axis": (AXIS, REQUIRED), "degrees": (NUMBER, REQUIRED), **WAVE},
        "spin": {"axis": (AXIS, REQUIRED), "degrees": (NUMBER, REQUIRED)},
        "pulse": {"amount": (number(-0.99, 0.99), REQUIRED), **WAVE},
    }
)
BODY = fields(
    {
        "name": (text, REQUIRED),
        "shape": (SHAPE, REQUIRED),
        "color": (COLOR, REQUIRED),
        "texture": (TEXTURE, None),
        "specular": (
            fields({"strength": (SHARE, REQUIRED), "exponent": (number(1, 1000), REQUIRED)}),
            None,
        ),
        "position": (POINT, ORIGIN),
        "turn": (
            fields({"axis": (AXIS, REQUIRED), "degrees": (NUMBER, REQUIRED)}),
            SimpleNamespace(axis=(0, 0, 1), degrees=0),
        ),
        "parent": (text, None),
        "motion": (list_of(MOTION), ()),
        "faces_camera": (flag, False),
    }
)
LIGHT = one_of(
    {
        "sun": {"direction": (AXIS, REQUIRED), "ambient": (SHARE, REQUIRED)},
        "point": {"position": (POINT, REQUIRED), "ambient": (SHARE, REQUIRED)},
    }
)
VIEWS = {
    "train": (COUNT, REQUIRED),
    "test": (COUNT, REQUIRED),
    "radius": (POSITIVE, REQUIRED),
    "elevation": (vector(2, -89, 89), REQUIRED),
    "target": (POINT, ORIGIN),
}
CAMERAS = one_of({"scattered": VIEWS, "orbit": {**VIEWS, "turns": (NUMBER, REQUIRED)}})
SCENE = fields(
    {
        "title": (text, REQUIRED),
        "license": (text, None),
        "effects": (check_effects, SIMULATOR_EFFECTS),
        "resolution": (vector(2, 1, 4096, integer=True), REQUIRED),
        "lens": (
            # In pixels. The principal point counts from the corner, as in the transforms files.
            fields(
                {
                    "fl_x": (POSITIVE, REQUIRED),
                    "fl_y": (POSITIVE, REQUIRED),
                    "cx": (NUMBER, REQUIRED),
                    "cy": (NUMBER, REQUIRED),
                }
            ),
            REQUIRED,
        ),
        "cameras": (CAMERAS, REQUIRED),
        "light": (LIGHT, REQUIRED),
        "bodies": (list_of(BODY), REQUIRED),
    }
)


def describe(source):
    """The checked description, a namespace with the fields of SCENE, from a file or a dictionary.

    Raises SceneError with one line that names the file, the field and what was expected.
    """
    data, where = source, "scene"
    if not isinstance(source, dict):
        data = read_json(Path(source), "a scene.json like that of tiny_scenes/bouncing")
        where = str(source)
    description = SCENE(data, where)
    require(description.bodies, f"{where}: bodies", "empty; expected at least one body")
    known = set()
    for i, body in enumerate(description.bodies):
        place = f"{where}: bodies[{i}]"
        require(
            body.name not in known,
            f"{place}.name",
            f"{body.name!r} is taken; expected another name",
        )
        require(
            body.parent is None or body.parent in known,
            f"{place}.parent",
            f"{body.parent!r}; expected a body listed before",
        )
        require(
            body.shape.kind != "capsule" or not np.array_equal(body.shape.start, body.shape.end),
            f"{place}.shape.end",
            "the same as start; expected another point",
        )
        known.add(body.name)
    return description
