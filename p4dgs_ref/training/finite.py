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


class _Found(Exception):
    pass


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
    elif isinstance(value, (np.ndarray, np.floating, float)) and np.asarray(value).dtype.kind == "f":
        yield name, np.asarray(value)


def _check(where, value):
    for name, array in _arrays(value, "value"):
        wrong = np.argwhere(~np.isfinite(array))
        if len(wrong):
            index = tuple(int(i) for i in wrong[0])
            raise _Found(f"{where}: {name}{list(index) if index else ''} is {array[index]}")


@contextmanager
def watched():
    """Within it, every forward and backward of the table of equations raises at its first non-finite output."""
    modules = {equation.key: importlib.import_module(equation.module) for equation in EQUATIONS.values()}
    modules["compositing, fast"] = fast
    kept = {key: (module.forward, module.backward) for key, module in modules.items()}

    running = []                                   # psi_d's network runs inside Eq. (5): name both

    def watch(key, function, direction, outputs_of):
        def run(*args, **kwargs):
            running.append(key)
            result = function(*args, **kwargs)
            _check(f"equation {', its '.join(map(repr, running))}, {direction}", outputs_of(result))
            running.pop()
            return result
        return run

    try:
        for key, module in modules.items():
            module.forward = watch(key, kept[key][0], "forward", lambda result: result[0])
            module.backward = watch(key, kept[key][1], "backward, gradient of", lambda gradients: gradients)
        yield
    finally:
        for key, module in modules.items():
            module.forward, module.backward = kept[key]


def find_first(p, *inputs):
    """A sentence that names the first equation and array in which an iteration stops being finite."""
    try:
        _check("parameter", p.arrays)
        with np.errstate(all="ignore"), watched():
            losses, _, res = objective.forward(p, *inputs)
            gradients, _ = objective.backward(res)
            _check("objective", losses._asdict())
            _check("gradient of", gradients.arrays)
    except _Found as found:
        return str(found)
    return "a non-finite value that did not come back when the iteration was repeated"
