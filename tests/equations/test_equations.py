"""Every equation of the table: gradients, shapes, closed forms, purity, precision.

At the end of the file are the tests of these tests.
"""

import inspect
from functools import wraps
from importlib import import_module

import numpy as np
import pytest

from p4dgs_ref import table
from p4dgs_ref.designs import EQUATIONS
from p4dgs_ref.equations import likelihood
from tests.equations import adjoint, rules
from tests.equations.adjoint import close, is_float
from tests.equations.rules import altered
from tests.golden.cases import FLAGS, case_of, cases_of

ALL = [
    pytest.param(eq, case, id=f"{key}-{case.name}")
    for key, eq in EQUATIONS.items()
    for case in cases_of(key)
]
EVERY = pytest.mark.parametrize("eq, case", ALL)
EACH = pytest.mark.parametrize("eq", EQUATIONS.values(), ids=lambda eq: eq.key)


# --- the gradient test --------------------------------------------------------------------------


def differentiable(eq, case):
    """The function that `backward` differentiates: straight-through parts have a surrogate."""
    cases = import_module(f"tests.golden.cases.{eq.key}")
    if not hasattr(cases, "surrogate"):
        return eq
    smooth = cases.surrogate(**case.inputs)
    return lambda **inputs: eq.named(smooth(**inputs))


def check_adjoint(eq, case):
    """Check the gradients of a case against differences of the function that they belong to."""
    adjoint.check_adjoint(eq, case, differentiable(eq, case))


@EVERY
def test_backward_is_the_adjoint_of_the_derivative(eq, case):
    if case.smooth:
        check_adjoint(eq, case)
    else:
        what = f"{eq.key}, case {case.name}"
        assert case.expected, f"{what}: on a kink only a closed form says what holds"


# --- the rules ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", rules.RULES, ids=lambda rule: rule.__name__)
@EVERY
def test_rules(rule, eq, case):
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

    assert eq.formula and eq.module.rpartition(".")[2] == eq.key
    parameters = inspect.signature(eq.forward).parameters
    needed = {name for name, p in parameters.items() if p.default is inspect.Parameter.empty}
    for case in cases:
        assert needed <= set(case.inputs) <= set(parameters), case.name
    assert set(eq.gradients) <= needed
    floats = [f"{name}_bar" for name, a in eq(**cases[0].inputs).items() if is_float(a)]
    asked = list(inspect.signature(eq.backward).parameters)
    assert asked in (["saved", *floats], ["saved", *floats, "needs_x"])


def test_every_flag_marks_a_case():
    """Those of "replay" are trainings (tests/golden/replay.py)."""
    assert {flag for p in ALL for flag in p.values[1].flags} == set(FLAGS) - {"replay"}


def test_the_table_is_in_the_order_of_the_paper():
    numbers = [eq.number for eq in table.EQUATIONS.values() if eq.number]
    assert numbers == sorted(numbers, key=lambda n: float(n.replace("'", ".5")))
    assert all(key == eq.key for key, eq in table.EQUATIONS.items())


# --- the tests of the tests ---------------------------------------------------------------------


def spoiled(eq, spoil):
    """A copy of an equation whose first gradient is wrong."""
    right = eq.backward

    @wraps(right)
    def backward(saved, **cotangents):
        gradients, first = right(saved, **cotangents), eq.gradients[0]
        return {**gradients, first: spoil(gradients[first])}

    return altered(eq, backward=backward)


@pytest.mark.parametrize("key", ["offsets", "view", "mlp", "deformed"])
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


def impure(x_a, **others):
    """Eq. (1) that changes an input."""
    x_a += 1
    return EQUATIONS["offsets"].forward(x_a=x_a, **others)


def doubled(**inputs):
    """Eq. (1) that always returns float64."""
    x, saved = EQUATIONS["offsets"].forward(**inputs)
    return x.astype(np.float64), saved


def counting():
    """Eq. (1) that returns other numbers at every call."""
    calls = []

    def forward(**inputs):
        calls.append(inputs)
        x, saved = EQUATIONS["offsets"].forward(**inputs)
        return x + len(calls), saved

    return forward


def imprecise(gradient):
    """A float32 gradient with the digits of float16."""
    if gradient.dtype == np.float32:
        return gradient.astype(np.float16).astype(np.float32)
    return gradient


def test_the_other_tests_reject_mistakes():
    eq, case, hand = EQUATIONS["offsets"], case_of("offsets"), case_of("offsets", "by_hand")
    wrong = {**hand.expected, "l_a_bar": -hand.expected["l_a_bar"]}
    for test, bad, on in (
        (rules.closed_forms, eq, hand._replace(expected=wrong)),
        (rules.gradients_have_the_shapes_of_the_inputs, spoiled(eq, np.transpose), case),
        (rules.pure_and_repeatable, altered(eq, forward=impure), case),
        (rules.pure_and_repeatable, altered(eq, forward=counting()), case),
        (rules.backward_is_linear_and_finite, spoiled(eq, np.abs), case),
        (rules.backward_is_linear_and_finite, spoiled(eq, lambda g: g / 0.0), case),
        (rules.backward_is_linear_and_finite, spoiled(eq, np.zeros_like), case),
        (rules.float32_stays_float32, altered(eq, forward=doubled), case),
        (rules.float32_stays_float32, spoiled(eq, imprecise), case),
    ):
        with np.errstate(all="ignore"), pytest.raises(AssertionError):
            test(bad, on)


def lies(spec):
    """Specs that a comment could state instead of the right one."""
    if spec.network:
        for i, text in enumerate(spec.network):
            others = spec.network[:i], (f"{text} + 1",), spec.network[i + 1 :]
            yield spec._replace(network=sum(others, ()))
    for i, shape in enumerate(spec.shapes):
        wrong = [(*shape[:j], "97", *shape[j + 1 :]) for j in range(len(shape))]
        for other in (*wrong, (*shape, "1"), shape[:-1] if shape else ("97",)):
            yield spec._replace(shapes=(*spec.shapes[:i], other, *spec.shapes[i + 1 :]))


def is_noticed(eq, arguments, outputs):
    """Whether the comparison with these Specs fails for a case."""
    for case in cases_of(eq.key):
        try:
            rules.check_shapes(eq, case, arguments, outputs)
        except AssertionError:
            return True
    return False


@EACH
def test_a_comment_that_lies_is_noticed(eq):
    arguments, outputs = rules.specs_of(eq)
    assert not is_noticed(eq, arguments, outputs)
    for specs in (arguments, outputs):
        for name, spec in list(specs.items()):
            for lie in lies(spec):
                specs[name] = lie
                assert is_noticed(eq, arguments, outputs), f"{eq.key}, {name}: {lie}"
            specs[name] = spec
