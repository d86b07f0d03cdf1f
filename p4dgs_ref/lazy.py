"""Names that a package offers and imports only when they are first used, so that NumPy loads after the threads are set."""

import sys
from importlib import import_module


def offer(package, home, rooms=()):
    """`__getattr__` and `__dir__` of a package: `home` says in which module a name stands, `rooms` are whole packages."""

    def get(name):
        if name in rooms:
            return import_module(f"{package}.{name}")
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{home[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *home, *rooms})
