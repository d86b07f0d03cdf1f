"""What the tests ask of any case of an equation, and changed copies of equations."""

from importlib import import_module

import numpy as np

from p4dgs_ref.lab.baselines.table import ALL_EQUATIONS
from p4dgs_ref.table import Equation
from tests.core import shape_comments
from tests.core.adjoint import leaves
from tests.golden.mutate import rewritten

EPS = np.finfo(float).eps


def frozen(tree):
    """The bytes of every array, by name."""
    return {name: [b.tobytes() for b in leaves(a)] for name, a in tree.items()}


def draw_cotangents(eq, outputs, seed):
    """Normal numbers for every float output, in its precision; none without gradients."""
    rng = np.random.default_rng(seed)
    return {
        name + "_bar": np.asarray(rng.standard_normal(np.shape(a)), np.asarray(a).dtype)
        for name, a in outputs.items()
        if eq.gradients and np.asarray(a).dtype.kind == "f"
    }


def check_shapes(eq, case):
    """Arguments, outputs and gradients have the shapes that the comments of `forward` tell."""
    outputs, pullback = eq.vjp(**case.inputs)
    specs = shape_comments.arguments(eq.forward)
    for name, spec in shape_comments.outputs(eq.forward, eq.outputs).items():
        specs[f"output {name}"] = spec
    named = {**case.inputs, **{f"output {name}": a for name, a in outputs.items()}}
    shape_comments.compare(specs, named, "off" in case.flags)
    if not eq.gradients:
        return
    gradients = pullback(**draw_cotangents(eq, outputs, 1))
    assert set(gradients) == set(eq.gradients)
    for name, gradient in gradients.items():
        shapes = [np.shape(b) for b in leaves(case.inputs[name])]
        assert [np.shape(g) for g in leaves(gradient)] == shapes, name


def check_pure(eq, case):
    """Forward and backward change nothing that they are given, and repeat to the bit."""
    before = frozen(case.inputs)
    outputs, pullback = eq.vjp(**case.inputs)
    cotangents = draw_cotangents(eq, outputs, 2)
    given, primal = frozen(cotangents), frozen(outputs)
    again, pullback_again = eq.vjp(**case.inputs)
    if eq.gradients:
        first = frozen(pullback(**cotangents))
        assert frozen(pullback(**cotangents)) == first
        assert frozen(pullback_again(**cotangents)) == first
    assert frozen(again) == primal == frozen(outputs)
    assert frozen(case.inputs) == before and frozen(cotangents) == given


def check_linear_and_finite(eq, case):
    """The gradient is a finite linear function of the cotangents."""
    outputs, pullback = eq.vjp(**case.inputs)
    if not eq.gradients:
        return
    u, v = draw_cotangents(eq, outputs, 3), draw_cotangents(eq, outputs, 4)
    a, b = 0.7, -1.9
    of_u, of_v = pullback(**u), pullback(**v)
    of_both = pullback(**{name: np.asarray(a * u[name] + b * v[name]) for name in u})
    for name in eq.gradients:
        gradients = of_u[name], of_v[name], of_both[name]
        for x, y, both in zip(*map(leaves, gradients), strict=True):
            what = f"{eq.key}, case {case.name}, {name}"
            assert np.isfinite(x).all() and np.isfinite(y).all(), what
            largest = np.abs([x, y]).max(initial=0)
            assert np.all(np.abs(a * x + b * y - both) <= 1e-10 * largest + EPS), what


def edited(key, changes, helper=None):
    """A copy of an equation whose file has some of its text replaced, {old: new}.

    With `helper`, the text stands in that module, from which the equation imports functions.
    """
    eq = ALL_EQUATIONS[key]
    names = rewritten(eq.module, {} if helper else changes)
    if helper:
        right, others = vars(import_module(helper)), rewritten(helper, changes)
        names.update({n: others[n] for n, a in right.items() if names.get(n) is a})
    return altered(eq, forward=names["forward"], backward=names["backward"])


def altered(eq, **functions):
    """A copy of an equation with another forward or backward."""
    members = {name: staticmethod(function) for name, function in functions.items()}
    return type("Altered", (Equation,), members)(*eq)
