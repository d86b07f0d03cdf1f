"""Finds the first NaN or infinity of an iteration: runs it again and watches every equation."""

from contextlib import contextmanager
from importlib import import_module

import numpy as np

from ..splatting import fast
from ..table import BEYOND, EQUATIONS
from . import objective

TRAINED = {**EQUATIONS, **BEYOND}


class NotFinite(ArithmeticError):
    """Training met a NaN or an infinity; the message says where it was first seen."""

    def __str__(self):  # of both arguments, so that it can be sent to another process
        iteration, found = self.args
        return f"iteration {iteration}: {found}"


class Found(ArithmeticError):
    """The first NaN or infinity: equation, direction, array and index in one phrase."""


def first_bad(arrays):
    """A phrase like "f_a[3, 1] is nan" for the first NaN or infinity in {name: array}, or None.

    A list of arrays may stand in the place of an array.
    """
    for name, value in arrays.items():
        listed = isinstance(value, (list, tuple))
        for i, array in enumerate(value if listed else [value]):
            wrong = np.argwhere(~np.isfinite(array))
            if len(wrong):
                index = tuple(int(i) for i in wrong[0])
                place = f"{name}[{i}]" if listed else name
                return f"{place}{list(index) if index else ''} is {np.asarray(array)[index]}"
    return None


def check(where, arrays):
    """Raise Found if there is a NaN or an infinity in {name: array}."""
    if bad := first_bad(arrays):
        raise Found(f"{where}: {bad}")


@contextmanager
def intercepted(wrap):
    """Within this context, `wrap(key, name, function)` replaces every forward and backward.

    These are the functions of the 27 equations and of the fast renderer, which has the key
    "compositing, fast".
    """
    modules = {key: import_module(equation.module) for key, equation in TRAINED.items()}
    modules["compositing, fast"] = fast
    kept = {key: (module.forward, module.backward) for key, module in modules.items()}
    try:
        for key, module in modules.items():
            module.forward = wrap(key, "forward", module.forward)
            module.backward = wrap(key, "backward", module.backward)
        yield
    finally:
        for key, module in modules.items():
            module.forward, module.backward = kept[key]


def watched():
    """A context in which every forward and backward raises Found at a non-finite output."""
    running = []  # the equations that are running; psi_d's network runs inside Eq. (5)

    def watch(key, name, function):
        equation = TRAINED[key.split(",")[0]]

        def run(*args, **kwargs):
            running.append(key)
            result = function(*args, **kwargs)
            where = f"equation {', its '.join(map(repr, running))}"
            if name == "forward":
                check(f"{where}, forward", equation.named(result[0]))
            else:
                check(f"{where}, backward, gradient of", result)
            running.pop()
            return result

        return run

    return intercepted(watch)


def find_first(p, *inputs):
    """A phrase that names where an iteration first stops being finite."""
    try:
        check("parameter", p.arrays)
        with np.errstate(all="ignore"), watched():
            losses, _, back = objective.loss(p, *inputs)
            gradients, _ = back()
            check("objective", losses._asdict())
            check("gradient of", gradients.arrays)
    except Found as found:
        return str(found)
    return "a NaN or an infinity that did not come back when the iteration was repeated"
