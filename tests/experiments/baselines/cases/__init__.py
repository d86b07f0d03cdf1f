"""The named inputs on which the equations of the baselines are tested."""

from importlib import import_module


def cases_of(key):
    """The cases of the equation with that key."""
    return list(import_module(f"{__name__}.{key}").cases())
