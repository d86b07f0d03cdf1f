"""Where did the first number that is none come from?  Runs one iteration again and watches every equation."""

import importlib
from contextlib import contextmanager

import numpy as np

from ..equations import EQUATIONS
from ..splatting import fast
from . import objective


class NotFinite(ArithmeticError):
    """Training met a NaN or an infinity; the message names the iteration, equation, array and index."""

    def __init__(self, iteration, found):
        super().__init__(f"iteration {iteration}: {found}")


class Found(ArithmeticError):
    """The first value that is none, in one sentence: equation, direction, array, index."""


def _arrays(value, name):
    """Every array in a (nested) NamedTuple, list or dictionary, with its name."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _arrays(item, str(key))
    elif hasattr(value, "_asdict"):
        yield from _arrays(value._asdict(), name)
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            yield from _arrays(item, f"{name}[{i}]")
    elif (
        isinstance(value, (np.ndarray, np.floating, float)) and np.asarray(value).dtype.kind == "f"
    ):
        yield name, np.asarray(value)


def _check(where, value):
    for name, array in _arrays(value, "value"):
        wrong = np.argwhere(~np.isfinite(array))
        if len(wrong):
            index = tuple(int(i) for i in wrong[0])
            raise Found(f"{where}: {name}{list(index) if index else ''} is {array[index]}")


@contextmanager
def intercepted(wrap):
    """Within it, `wrap(key, name, function)` stands for each forward and backward of equations and fast renderer."""
    modules = {
        equation.key: importlib.import_module(equation.module) for equation in EQUATIONS.values()
    }
    modules["compositing, fast"] = fast
    kept = {key: (module.forward, module.backward) for key, module in modules.items()}
    try:
        for key, module in modules.items():
            module.forward, module.backward = map(
                wrap, (key, key), ("forward", "backward"), kept[key]
            )
        yield
    finally:
        for key, module in modules.items():
            module.forward, module.backward = kept[key]


def watched():
    """Within it, every forward and backward of the table of equations raises Found at its first non-finite output."""
    running = []  # psi_d's network runs inside Eq. (5): name both

    def watch(key, name, function):
        direction = {"forward": "forward", "backward": "backward, gradient of"}[name]

        def run(*args, **kwargs):
            running.append(key)
            result = function(*args, **kwargs)
            outputs = result
            if name == "forward":
                outputs = EQUATIONS[key].named(result[0]) if key in EQUATIONS else result[0]
            _check(f"equation {', its '.join(map(repr, running))}, {direction}", outputs)
            running.pop()
            return result

        return run

    return intercepted(watch)


def find_first(p, *inputs):
    """A sentence that names the first equation and array in which an iteration stops being finite."""
    try:
        _check("parameter", p.arrays)
        with np.errstate(all="ignore"), watched():
            losses, _, res = objective.forward(p, *inputs)
            gradients, _ = objective.backward(res)
            _check("objective", losses._asdict())
            _check("gradient of", gradients.arrays)
    except Found as found:
        return str(found)
    return "a non-finite value that did not come back when the iteration was repeated"
