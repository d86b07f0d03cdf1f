"""Changed copies of equations."""

from importlib import import_module

from p4dgs_ref import EQUATIONS
from tests.equations.rules import altered
from tests.workshop.mutate import rewritten


def edited(key, changes, helper=None):
    """A copy of an equation whose file has some of its text replaced, {old: new}.

    With `helper`, the text stands in that module, from which the equation imports functions.
    """
    eq = EQUATIONS[key]
    names = rewritten(eq.module.__name__, {} if helper else changes)
    if helper:
        right, others = vars(import_module(helper)), rewritten(helper, changes)
        names.update({n: others[n] for n, a in right.items() if names.get(n) is a})
    return altered(eq, forward=names["forward"], backward=names["backward"])
