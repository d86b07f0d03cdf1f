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


def value(holds, expected, convert=lambda found: found):
    """A reader of a value that meets a condition, which it converts."""

    def read(found, where):
        require(holds(found), where, f"{found!r}; expected {expected}")
        return convert(found)

    return read


def number(low=-1e6, high=1e6, integer=False):
    """A reader of one number from low to high."""
    kind, types = ("an integer", [int]) if integer else ("a number", [int, float])
    return value(
        lambda found: is_number(found, *types) and low <= found <= high,
        f"{kind} in [{low:g}, {high:g}]",
    )


def choice(table):
    """A reader of a word from a table, which returns the entry of the table."""
    expected = f"one of {', '.join(table)}"
    return value(lambda found: isinstance(found, str) and found in table, expected, table.get)


def list_of(reader, n=None):
    """A reader of a list, of n entries if n is given, which `reader` reads."""
    of_length = value(
        lambda found: isinstance(found, list) and n in (None, len(found)),
        "a list" if n is None else f"a list of {n} numbers",
    )

    def read(found, where):
        entries = enumerate(of_length(found, where))
        return [reader(entry, f"{where}[{i}]") for i, entry in entries]

    return read


def vector(n, low=-1e6, high=1e6, integer=False):
    """A reader of n numbers from low to high."""
    read_entries = list_of(number(low, high, integer), n)
    return lambda found, where: np.array(read_entries(found, where), int if integer else float)


def direction(found, where):
    """Read three numbers that are not all zero."""
    axis = vector(3)(found, where)
    require(axis.any(), where, f"{found!r}; expected a direction, not zero")
    return axis


def fields(table):
    """A reader of an object with the fields of a table, {name: (reader, default)}."""
    names = ", ".join(table)
    an_object = value(lambda found: isinstance(found, dict), f"an object with {names}")

    def read(found, where):
        for name in an_object(found, where):
            require(name in table, below(where, name), f"unknown field; expected some of {names}")
        values = SimpleNamespace()
        for name, (reader, default) in table.items():
            place = below(where, name)
            require(name in found or default is not REQUIRED, place, "missing; expected a value")
            setattr(values, name, reader(found[name], place) if name in found else default)
        return values

    return read


def one_of(tables):
    """A reader of an object whose field `kind` chooses the table of its other fields."""
    known = choice({kind: kind for kind in tables})
    readers = {kind: fields({"kind": (known, REQUIRED), **rest}) for kind, rest in tables.items()}

    def read(found, where):
        kind = found.get("kind") if isinstance(found, dict) else None
        return readers[known(kind, f"{where}.kind")](found, where)

    return read


TEXT = value(lambda found: isinstance(found, str) and found, "some text")
FLAG = value(lambda found: isinstance(found, bool), "true or false")
NUMBER = number()
POSITIVE = number(low=1e-6)
SHARE = number(0, 1)
COUNT = number(1, 100_000, integer=True)
COLOR = vector(3, 0, 1)
POINT = vector(3)
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
            "direction": (direction, REQUIRED),
        },
    }
)
MOTION = one_of(
    {
        "line": {"by": (POINT, REQUIRED)},
        "bounce": {"height": (NUMBER, REQUIRED), **WAVE},
        "arc": {"center": (POINT, REQUIRED), "degrees": (NUMBER, REQUIRED), **WAVE},
        "swing": {"axis": (direction, REQUIRED), "degrees": (NUMBER, REQUIRED), **WAVE},
        "spin": {"axis": (direction, REQUIRED), "degrees": (NUMBER, REQUIRED)},
        "pulse": {"amount": (number(-0.99, 0.99), REQUIRED), **WAVE},
    }
)
BODY = fields(
    {
        "name": (TEXT, REQUIRED),
        "shape": (SHAPE, REQUIRED),
        "color": (COLOR, REQUIRED),
        "texture": (TEXTURE, None),
        "specular": (
            fields({"strength": (SHARE, REQUIRED), "exponent": (number(1, 1000), REQUIRED)}),
            None,
        ),
        "position": (POINT, ORIGIN),
        "turn": (
            fields({"axis": (direction, REQUIRED), "degrees": (NUMBER, REQUIRED)}),
            SimpleNamespace(axis=(0, 0, 1), degrees=0),
        ),
        "parent": (TEXT, None),
        "motion": (list_of(MOTION), ()),
        "faces_camera": (FLAG, False),
    }
)
LIGHT = one_of(
    {
        "sun": {"direction": (direction, REQUIRED), "ambient": (SHARE, REQUIRED)},
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
        "title": (TEXT, REQUIRED),
        "license": (TEXT, None),
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
