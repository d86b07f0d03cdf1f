"""Changed copies of the project's own code."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from p4dgs_ref import EQUATIONS
from tests.equations.rules import altered


def rewritten(module, changes, **names):
    """Return the names that a file defines with some of its text replaced, {old: new}.

    Every old text must stand in the file once. The new one may use `names`.
    """
    text = Path(find_spec(module).origin).read_text(encoding="utf-8")
    for old, new in changes.items():
        if text.count(old) != 1:
            raise ValueError(f"{module}: {old!r} stands there {text.count(old)} times, not once")
        text = text.replace(old, new)
    scratch = {"__name__": module, "__package__": module.rpartition(".")[0], "np": np, **names}
    exec(compile(text, f"{module}, rewritten", "exec"), scratch)
    return scratch


def edited(key, changes, helper=None):
    """Return a copy of an equation whose file has some of its text replaced, {old: new}.

    With `helper`, the text stands in that module, from which the equation imports functions.
    """
    eq = EQUATIONS[key]
    names = rewritten(eq.module.__name__, {} if helper else changes)
    if helper:
        right, others = vars(import_module(helper)), rewritten(helper, changes)
        names.update({n: others[n] for n, a in right.items() if names.get(n) is a})
    return altered(eq, forward=names["forward"], backward=names["backward"])
