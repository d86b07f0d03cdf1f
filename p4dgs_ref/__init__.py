"""P-4DGS in NumPy: the paper equation by equation, trained, compressed to bytes, decoded, rendered.

    import p4dgs_ref as p4
    p4.prepare()
    scene = p4.load_scene("bouncing")
    model = p4.train(scene, preset="tiny", seed=0)
    data = p4.encode(model)
    view = scene.test[0]
    image = p4.decode(data).render(view.camera, view.time)

The public names are listed in `__init__.pyi`, where type checkers and editors read them, too. Each
is imported when it is first used, so that a program can call `prepare` before NumPy loads.
"""

import re
from importlib import import_module
from pathlib import Path

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOME = {name: module for module, name in re.findall(r"from (\S+) import (\w+) as", _STUB)}

__all__ = [*_HOME]


def __getattr__(name):
    """Return a public name, from the module that defines it; `oracle` is itself a module."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _HOME[name] == ".":
        return import_module(f".{name}", __name__)
    return getattr(import_module(_HOME[name], __name__), name)


def __dir__():
    """Return the names of the module and those that `__getattr__` imports."""
    return sorted({*globals(), *__all__})
