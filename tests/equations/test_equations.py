"""Every equation of the table: gradients, shapes, closed forms, purity, precision.

At the end of the file are the tests of these tests.
"""

import inspect
from functools import wraps
from importlib import import_module

import numpy as np
import pytest

from p4dgs_ref import EQUATIONS
from p4dgs_ref.equations import likelihood
from tests.equations import adjoint, rules
from tests.equations.adjoint import close, is_float
from tests.equations.rules import altered
from tests.sampling import few
from tests.workshop.cases import FLAGS, case_of, cases_of

EACH = pytest.mark.parametrize("eq", EQUATIONS.values(), ids=lambda eq: eq.key)


# --- the gradient test --------------------------------------------------------------------------


def differentiable(eq, case):
    """The function that `backward` differentiates: straight-through parts have a surrogate."""
    cases = import_module(f"tests.workshop.cases.{eq.key}")
    if not hasattr(cases, "surrogate"):
        return eq
    smooth = cases.surrogate(**case.inputs)
    return lambda **inputs: eq.by_name(smooth(**inputs))


def check_adjoint(eq, case):
    """Check the gradients of a case against differences of the function that they belong to."""
    adjoint.check_adjoint(eq, case, differentiable(eq, case))


@EACH
def test_backward_is_the_adjoint_of_the_derivative(eq):
    for case in cases_of(eq.key):
        if case.smooth:
            check_adjoint(eq, case)
        else:
            what = f"{eq.key}, case {case.name}"
            assert case.expected, f"{what}: on a kink only a closed form says what holds"


# --- the rules ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", rules.RULES, ids=lambda rule: rule.__name__)
@EACH
def test_rules(rule, eq):
    for case in cases_of(eq.key):
        rule(eq, case)


def test_the_printed_likelihood_agrees_on_the_ordinary_case():
    inputs = case_of("likelihood").inputs
    bits = EQUATIONS["likelihood"](**inputs)["bits"]
    close(likelihood.literal(**inputs), bits, 1e-9, "Eq. (11) as printed")


# --- comments, table and cases ------------------------------------------------------------------


@EACH
def test_every_alternative_of_a_comment_occurs(eq):
    arguments, outputs = rules.specs_of(eq)
    met = [rules.check_shapes(eq, case, arguments, outputs)[2] for case in cases_of(eq.key)]
    for name, spec in arguments.items():
        if len(spec.shapes) > 1:
            assert set(spec.shapes) == {shapes[name] for shapes in met}, f"{eq.key}, {name}"


@EACH
def test_table_and_cases_fit_the_functions(eq):
    cases = cases_of(eq.key)
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    flags = {flag for case in cases for flag in case.flags}
    assert "ordinary" in flags and len(flags) > 1 and flags <= set(FLAGS), flags
    assert all(case.flags for case in cases)

    assert eq.formula and eq.module.__name__.rpartition(".")[2] == eq.key
    parameters = inspect.signature(eq.forward).parameters
    needed = {name for name, p in parameters.items() if p.default is inspect.Parameter.empty}
    for case in cases:
        assert needed <= set(case.inputs) <= set(parameters), case.name
    assert set(eq.gradients) <= needed
    floats = [f"{name}_bar" for name, a in eq(**cases[0].inputs).items() if is_float(a)]
    asked = list(inspect.signature(eq.backward).parameters)
    assert asked in (["saved", *floats], ["saved", *floats, "needs_x"])


def test_every_flag_marks_a_case():
    """Those of "replay" are trainings (tests/workshop/replay.py)."""
    marked = {flag for key in EQUATIONS for case in cases_of(key) for flag in case.flags}
    assert marked == set(FLAGS) - {"replay"}


def test_the_table_is_in_the_order_of_the_paper():
    numbers = [eq.number for eq in EQUATIONS.values() if eq.number]
    assert numbers == sorted(numbers, key=lambda n: float(n.replace("'", ".5")))
    assert all(key == eq.key for key, eq in EQUATIONS.items())


# --- the tests of the tests ---------------------------------------------------------------------


def spoiled(eq, spoil):
    """A copy of an equation whose first gradient is wrong."""
    right = eq.backward

    @wraps(right)
    def backward(saved, **cotangents):
        gradients, first = right(saved, **cotangents), eq.gradients[0]
        return {**gradients, first: spoil(gradients[first])}

    return altered(eq, backward=backward)


@pytest.mark.usefixtures("right_reference")
@pytest.mark.parametrize("key", few(["offsets", "view", "deformed"], 1))
def test_the_gradient_test_rejects_mistakes(key):
    eq, case = EQUATIONS[key], case_of(key)
    check_adjoint(spoiled(eq, lambda g: g), case)
    for spoil in (
        lambda g: -g,
        lambda g: 0.5 * g,
        lambda g: 1.00001 * g,
        lambda g: np.roll(g, 1, axis=0),
        lambda g: g.T.reshape(g.shape),
        lambda g: g[..., ::-1],
        np.zeros_like,
        lambda g: g * np.nan,
    ):
        where = f"{key}, case ordinary, input {eq.gradients[0]}"
        with pytest.raises(AssertionError, match=where):
            check_adjoint(spoiled(eq, spoil), case)
