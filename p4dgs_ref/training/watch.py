"""Watches calls of functions from outside, for the first NaN, for counts and for times.

Nothing is replaced, and outside the `with` block nothing is slower. `first_not_finite` runs an
iteration again to name the equation, array and index that was the first to be NaN or infinite.
"""

import sys
from contextlib import contextmanager

import numpy as np

from ..splatting import factored, fast
from ..splatting.table import EQUATIONS
from . import objective


def equation_codes():
    """Return {code object: (key, "forward" or "backward")} of equations and of their twins.

    The twins have the keys "projection, factored" and "compositing, fast".
    """
    twins = {"projection, factored": factored, "compositing, fast": fast}
    return {
        getattr(module, name).__code__: (key, name)
        for key, module in {**EQUATIONS, **twins}.items()
        for name in ("forward", "backward")
    }


@contextmanager
def watch_calls(codes, see):
    """Call see(event, mark, frame, value) for calls in this thread, in a `with` block.

    `codes` is {code object: mark}. The event "call" comes before the first line of a function, with
    the value None; "return" comes after the last one, with the value that is returned, or None
    if the call raised. `frame.f_locals` has the arguments.
    """

    def profile(frame, event, value):
        if event in ("call", "return") and frame.f_code in codes:
            see(event, codes[frame.f_code], frame, value)

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        yield
    finally:
        sys.setprofile(before)


class NotFinite(ArithmeticError):
    """Training met a NaN or an infinity; the message says where it was first seen."""


def first_bad(arrays, where=""):
    """Return a phrase like "f_a[3, 1] is nan" for the first NaN or infinity, or None.

    A list of arrays may take the place of an array. The phrase begins with `where`.
    """
    for name, value in arrays.items():
        listed = isinstance(value, (list, tuple))
        for i, array in enumerate(value if listed else [value]):
            wrong = np.argwhere(~np.isfinite(array))
            if len(wrong):
                index, place = wrong[0].tolist(), f"{name}[{i}]" if listed else name
                return f"{where}{place}{index or ''} is {np.asarray(array)[tuple(index)]}"
    return None


def first_not_finite(inputs):
    """Return a phrase that names where `objective.loss(*inputs)` and its `back` first fail."""
    phrases, running = [first_bad(inputs[0].arrays, "parameter: ")], []

    def see(event, mark, frame, value):
        key, name = mark
        if event == "call":
            running.append(key)
            return
        # a network that runs inside Eq. (5) is named with it
        where = f"equation {', its '.join(map(repr, running))}"
        running.pop()
        if value is None:  # the call raised, such as an interrupt
            return
        if name == "forward":
            value = EQUATIONS[key.split(",")[0]].by_name(value[0])
        else:
            name = "backward, gradient of"
        phrases.append(first_bad(value, f"{where}, {name}: "))

    with watch_calls(equation_codes(), see):
        losses, _, back = objective.loss(*inputs)
        gradients, _ = back()
    phrases += [
        first_bad(losses._asdict(), "objective: "),
        first_bad(gradients.arrays, "gradient of: "),
        "a NaN or an infinity that did not come back when the iteration was repeated",
    ]
    return next(filter(None, phrases))
