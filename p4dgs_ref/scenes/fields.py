"""Checks the fields of scenes; tables describe those of their JSON files.

A check is a function of a value and of its place in the file. It returns the value, converted, or
raises a SceneError that names the place and what was expected. A table has one row for each field
of an object, {name: (check, default)}; the default is not checked.
"""

from collections.abc import Collection
from contextlib import suppress
from numbers import Integral, Real
from reprlib import repr as shown
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..messages import shorten

MAX_COORDINATE = 1e6  # scene units from the origin to a camera or point, along any axis
MIN_LENS, MAX_LENS = 1e-9, 1e9  # pixels, of a focal length; of a principal point up to MAX_LENS
KINDS = {int: Integral, float: Real}


class Missing:
    """The default of a required field; messages show it as `missing`."""

    def __repr__(self):
        return "missing"


REQUIRED = Missing()


class SceneError(ValueError):
    """A mistake in a scene: one line that names the file, the field and what was expected."""

    def __init__(self, where: object, expected: str):
        super().__init__(" ".join(shorten(f"{where}: {expected}").split()))


def require_field(condition, where, expected):
    """Raise a SceneError unless the condition holds."""
    if not condition:
        raise SceneError(where, expected)


def numbers(value, where, low, high, shape=(), kind=float) -> Any:
    """Return an array of that shape with numbers in [low, high]; a number for shape ().

    The kind is float or int; Booleans are refused.
    """
    values = np.array(np.nan)
    with suppress(ValueError, OverflowError):  # rows of unequal lengths, integers of 400 digits
        entries = np.asarray(value, dtype=object)
        known = (isinstance(x, KINDS[kind]) and not isinstance(x, bool) for x in entries.flat)
        if entries.shape == shape and all(known):
            values = entries.astype(kind)
    if not np.all((values >= low) & (values <= high)):  # nor for NaN
        name = "integer" if kind is int else "number"
        expected = f"{name}s of shape {list(shape)}" if shape else f"one {name}"
        raise SceneError(where, f"{shown(value)}; expected {expected} in [{low:g}, {high:g}]")
    return values if shape else values.item()


def value_of_type(value, where, kind):
    """Return a value of the Python type `kind`."""
    if not isinstance(value, kind):  # formatting a value takes longer than checking it
        raise SceneError(where, f"{shown(value)}; expected a {kind.__name__}")
    return value


def text(value, where):
    """Return a text that can be printed on one line."""
    require_field(
        isinstance(value, str) and value.isprintable(),
        where,
        f"{value!r:.200}; expected a text without control characters",
    )
    return value


def choice(value, where, words):
    """Return one of some words."""
    require_field(
        isinstance(value, str) and value in words,
        where,
        f"{shown(value)}; expected one of {', '.join(words)}",
    )
    return value


def list_of(value, where, check, unique=False):
    """Return a list of checked values; no two may be equal if they are `unique`."""
    require_field(
        isinstance(value, Collection) and not isinstance(value, (str, dict)),
        where,
        f"{shown(value)}; expected a list",
    )
    items = [check(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if unique and len({*items}) < len(items):
        raise SceneError(where, f"{shown(items)}; expected each of them once")
    return items


def fields(value, where, table, others=False):
    """Return an object's values as a namespace; `others` allows fields that the table lacks."""
    unknown = sorted(value_of_type(value, where, dict).keys() - table)
    require_field(
        others or not unknown,
        where,
        f"unknown field {unknown}; expected some of {', '.join(table)}",
    )
    values = SimpleNamespace()
    for name, (check, default) in table.items():
        place = f"{where}.{name}" if ": " in str(where) else f"{where}: {name}"
        given = name in value or default is REQUIRED
        setattr(values, name, check(value.get(name, default), place) if given else default)
    return values


def one_of(value, where, tables):
    """Return an object whose field `kind` chooses the table of its other fields."""
    kind = choice(value_of_type(value, where, dict).get("kind"), f"{where}.kind", tables)
    return fields(value, where, {"kind": (text, REQUIRED), **tables[kind]})
