"""Reads and checks scene.json, the simulator's description of a scene; the tables below are the format.

Lengths are scene units, z is up, angles are degrees, colours are three numbers in [0, 1].  A field that is
not in the tables is refused: a misspelt one would otherwise be silently ignored.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..dnerf import read_json
from ..scene import SIMULATOR_EFFECTS, SceneError, check_effects

REQUIRED = object()


def below(where, name):
    """The place of a field: "scene.json: light", then "scene.json: light.kind"."""
    return f"{where}.{name}" if ": " in where else f"{where}: {name}"


def number(low=-1e6, high=1e6, integer=False):
    """A reader of one number between low and high."""

    def read(value, where):
        kinds = int if integer else (int, float)
        if isinstance(value, bool) or not isinstance(value, kinds) or not low <= value <= high:
            kind = "an integer" if integer else "a number"
            raise SceneError(where, f"{value!r}; expected {kind} in [{low:g}, {high:g}]")
        return value

    return read


def vector(n, low=-1e6, high=1e6, integer=False, nonzero=False):
    """A reader of n numbers between low and high."""

    def read(value, where):
        if not isinstance(value, list) or len(value) != n:
            raise SceneError(where, f"{value!r}; expected a list of {n} numbers")
        entries = [
            number(low, high, integer)(entry, f"{where}[{i}]") for i, entry in enumerate(value)
        ]
        if nonzero and not any(entries):
            raise SceneError(where, f"{value!r}; expected a direction, not zero")
        return np.array(entries, int if integer else float)

    return read


def choice(table):
    """A reader of one word out of a table; the result is the table's value."""

    def read(value, where):
        if not isinstance(value, str) or value not in table:
            raise SceneError(where, f"{value!r}; expected one of {', '.join(table)}")
        return table[value]

    return read


def text(value, where):
    if not isinstance(value, str) or not value:
        raise SceneError(where, f"{value!r}; expected some text")
    return value


def flag(value, where):
    if not isinstance(value, bool):
        raise SceneError(where, f"{value!r}; expected true or false")
    return value


def fields(table):
    """A reader of an object with the fields of a table, {name: (reader, default)}."""

    def read(value, where):
        if not isinstance(value, dict):
            raise SceneError(where, f"{value!r}; expected an object with {', '.join(table)}")
        for name in value:
            if name not in table:
                raise SceneError(
                    below(where, name), f"unknown field; expected some of {', '.join(table)}"
                )
        found = SimpleNamespace()
        for name, (reader, default) in table.items():
            if name not in value and default is REQUIRED:
                raise SceneError(below(where, name), "missing; expected a value")
            setattr(
                found, name, reader(value[name], below(where, name)) if name in value else default
            )
        return found

    return read


def one_of(tables):
    """A reader of an object whose field `kind` chooses the table for the rest."""
    kinds = {kind: kind for kind in tables}

    def read(value, where):
        if not isinstance(value, dict) or "kind" not in value:
            raise SceneError(f"{where}.kind", f"missing; expected one of {', '.join(tables)}")
        kind = choice(kinds)(value["kind"], f"{where}.kind")
        return fields({"kind": (choice(kinds), REQUIRED), **tables[kind]})(value, where)

    return read


def list_of(reader):
    def read(value, where):
        if not isinstance(value, list):
            raise SceneError(where, f"{value!r}; expected a list")
        return [reader(entry, f"{where}[{i}]") for i, entry in enumerate(value)]

    return read


POSITIVE = number(low=1e-6)
COLOR = vector(3, 0, 1)
POINT = vector(3)
AXIS = vector(3, nonzero=True)
ORIGIN = np.zeros(3)
WAVE = {"period": (POSITIVE, 1.0), "phase": (number(), 0.0)}  # fractions of a turn

SHAPE = one_of(
    {
        "sphere": {"radius": (POSITIVE, REQUIRED), "center": (POINT, ORIGIN)},
        "box": {
            "half": (vector(3, low=1e-6), REQUIRED),
            "center": (POINT, ORIGIN),
        },  # half the edges
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
        "bounce": {"height": (number(), REQUIRED), **WAVE},
        "arc": {"center": (POINT, REQUIRED), "degrees": (number(), REQUIRED), **WAVE},
        "swing": {"axis": (AXIS, REQUIRED), "degrees": (number(), REQUIRED), **WAVE},
        "spin": {"axis": (AXIS, REQUIRED), "degrees": (number(), REQUIRED)},
        "pulse": {"amount": (number(-0.99, 0.99), REQUIRED), **WAVE},
    }
)
TURN = fields({"axis": (AXIS, REQUIRED), "degrees": (number(), REQUIRED)})
SPECULAR = fields({"strength": (number(0, 1), REQUIRED), "exponent": (number(1, 1000), REQUIRED)})
BODY = fields(
    {
        "name": (text, REQUIRED),
        "shape": (SHAPE, REQUIRED),
        "color": (COLOR, REQUIRED),
        "texture": (TEXTURE, None),
        "specular": (SPECULAR, None),
        "position": (POINT, ORIGIN),
        "turn": (TURN, SimpleNamespace(axis=(0, 0, 1), degrees=0)),
        "parent": (text, None),
        "motion": (list_of(MOTION), ()),
        "faces_camera": (flag, False),
    }
)
LIGHT = one_of(
    {
        "sun": {"direction": (AXIS, REQUIRED), "ambient": (number(0, 1), REQUIRED)},
        "point": {"position": (POINT, REQUIRED), "ambient": (number(0, 1), REQUIRED)},
    }
)
VIEWS = {
    "train": (number(1, 100_000, integer=True), REQUIRED),
    "test": (number(1, 100_000, integer=True), REQUIRED),
    "radius": (POSITIVE, REQUIRED),
    "elevation": (vector(2, -89, 89), REQUIRED),
    "target": (POINT, ORIGIN),
}
CAMERAS = one_of({"scattered": VIEWS, "orbit": {**VIEWS, "turns": (number(), REQUIRED)}})
# pixels; the principal point counts from the image's corner, as in the files that are written
LENS = fields(
    {
        "fl_x": (POSITIVE, REQUIRED),
        "fl_y": (POSITIVE, REQUIRED),
        "cx": (number(), REQUIRED),
        "cy": (number(), REQUIRED),
    }
)
SCENE = fields(
    {
        "title": (text, REQUIRED),
        "license": (text, None),
        "effects": (check_effects, SIMULATOR_EFFECTS),
        "resolution": (vector(2, 1, 4096, integer=True), REQUIRED),
        "lens": (LENS, REQUIRED),
        "cameras": (CAMERAS, REQUIRED),
        "light": (LIGHT, REQUIRED),
        "bodies": (list_of(BODY), REQUIRED),
    }
)


def read_file(file):
    """The contents of a scene.json.

    Raises     SceneError where there is none, or no JSON object in it
    """
    if not file.exists():
        raise SceneError(file, "missing; expected a scene.json, as tiny_scenes/ holds six")
    return read_json(file)


def describe(source):
    """A checked description from a scene.json or from the dictionary that it holds.

    Shapes     a path or a dict -> a namespace with the fields of SCENE
    Raises     SceneError, one line: file, field, expectation
    """
    data, where = (
        (source, "scene") if isinstance(source, dict) else (read_file(Path(source)), str(source))
    )
    description = SCENE(data, where)
    known = set()
    for i, body in enumerate(description.bodies):
        if body.name in known:
            raise SceneError(
                f"{where}: bodies[{i}].name", f"{body.name!r} is taken; expected another name"
            )
        if body.parent is not None and body.parent not in known:
            raise SceneError(
                f"{where}: bodies[{i}].parent", f"{body.parent!r}; expected a body listed before"
            )
        if body.shape.kind == "capsule" and np.array_equal(body.shape.start, body.shape.end):
            raise SceneError(
                f"{where}: bodies[{i}].shape.end", "the same as start; expected another point"
            )
        known.add(body.name)
    if not known:
        raise SceneError(f"{where}: bodies", "empty; expected at least one body")
    return description
