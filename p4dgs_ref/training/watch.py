"""Watches calls of functions from outside, for the first NaN, for counts and for times.

Nothing is replaced, and outside the `with` block nothing is slower.
"""

import sys
from contextlib import contextmanager
from importlib import import_module

from ..splatting import fast
from ..table import BEYOND, EQUATIONS


def equation_codes():
    """{code object: (key, "forward" or "backward")} of all equations and of the fast renderer.

    The fast renderer has the key "compositing, fast".
    """
    modules = {key: import_module(eq.module) for key, eq in {**EQUATIONS, **BEYOND}.items()}
    modules["compositing, fast"] = fast
    return {
        getattr(module, name).__code__: (key, name)
        for key, module in modules.items()
        for name in ("forward", "backward")
    }


@contextmanager
def watching(codes, see):
    """A `with` block in which see(event, mark, frame, value) hears of every call in this thread.

    `codes` is {code object: mark}. The event "call" comes before the first line of a function, with
    the value None; "return" comes after the last one, with the value that is returned, or None
    where the call raised. `frame.f_locals` holds the arguments.
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
