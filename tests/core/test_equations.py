"""Every equation of the table: gradients, shapes, closed forms, purity, precision.

At the end of the file are the tests of these tests.
"""

import inspect
from collections import Counter
from functools import wraps
from importlib import import_module

import numpy as np
import pytest

from p4dgs_ref.equations import likelihood
from p4dgs_ref.oracle import checker, published
from p4dgs_ref.table import BEYOND, EQUATIONS
from tests.core import adjoint, shape_comments
from tests.core.adjoint import EPS, cast, close, draw_cotangents, is_float, leaves
from tests.golden.cases import FLAGS, case_of, cases_of
from tests.golden.checks import altered
from tests.oracle.answers import Port

# No overflow and no 0/0, not even on hard cases.
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")
ALL = [
    pytest.param(eq, case, id=f"{key}-{case.name}")
    for key, eq in {**EQUATIONS, **BEYOND}.items()
    for case in cases_of(key)
]
EVERY = pytest.mark.parametrize("eq, case", ALL)
EACH = pytest.mark.parametrize("eq", [*EQUATIONS.values(), *BEYOND.values()], ids=lambda eq: eq.key)


def run(eq, inputs):
    """The outputs {name: array} and what `backward` needs."""
    output, saved = eq.forward(**inputs)
    return eq.named(output), saved


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


# --- closed forms -------------------------------------------------------------------------------


@pytest.mark.parametrize("eq, case", [p for p in ALL if p.values[1].expected])
def test_closed_forms(eq, case):
    outputs, pullback = eq.vjp(**case.inputs)
    gradients = pullback(**case.cotangents)  # the cotangents that the case leaves out are zero
    got = {**outputs, **{name + "_bar": a for name, a in gradients.items()}}
    for name, want in case.expected.items():
        close(got[name], want, case.tolerance, f"{eq.key}, case {case.name}, {name}")
    assert {name.removesuffix("_bar") for name in case.cotangents} <= set(outputs)


@EACH
def test_published_vectors(eq):
    """Most of them were computed in 60-digit decimals, or are closed forms."""
    found = checker.check_subject(published.cases(eq.key), Port())
    assert [r for r in found if r.verdict != "pass"] == []


def test_the_printed_likelihood_agrees_on_the_ordinary_case():
    inputs = case_of("likelihood").inputs
    bits = EQUATIONS["likelihood"](**inputs)["bits"]
    close(likelihood.literal(**inputs), bits, 1e-9, "Eq. (11) as printed")


# --- comments, table and cases ------------------------------------------------------------------


def specs_of(eq):
    """The Specs of an equation's arguments and outputs."""
    return shape_comments.arguments(eq.forward), shape_comments.outputs(eq.forward, eq.outputs)


def check_shapes(eq, case, arguments, outputs):
    """Compare a case with Specs of arguments and outputs; returns what `compare` returns."""
    values, _ = run(eq, case.inputs)
    named = {**case.inputs, **{f"output {name}": a for name, a in values.items()}}
    specs = {**arguments, **{f"output {name}": spec for name, spec in outputs.items()}}
    return shape_comments.compare(specs, named, "off" in case.flags)


@EVERY
def test_comments_tell_the_shapes(eq, case):
    lengths, numbers, _ = check_shapes(eq, case, *specs_of(eq))
    if "ordinary" in case.flags:
        counts = Counter([*lengths.values(), *(n for n in numbers if n > 1)])
        twice = [n for n, count in counts.items() if count > 1]
        assert not twice, f"{eq.key}, case {case.name}: axes of equal length {lengths}"


@EACH
def test_every_alternative_of_a_comment_occurs(eq):
    arguments, outputs = specs_of(eq)
    met = [check_shapes(eq, case, arguments, outputs)[2] for case in cases_of(eq.key)]
    for name, spec in arguments.items():
        if len(spec.shapes) > 1:
            assert set(spec.shapes) == {shapes[name] for shapes in met}, f"{eq.key}, {name}"


@EVERY
def test_gradients_have_the_shapes_of_the_inputs(eq, case):
    outputs, saved = run(eq, case.inputs)
    rng = np.random.default_rng(1)
    gradients = eq.backward(saved, **draw_cotangents(outputs, rng.standard_normal))
    assert set(gradients) == set(eq.gradients)
    for name, gradient in gradients.items():
        shapes = [np.shape(b) for b in leaves(case.inputs[name])]
        assert [np.shape(g) for g in leaves(gradient)] == shapes, name


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
    numbers = [eq.number for eq in EQUATIONS.values() if eq.number]
    assert numbers == sorted(numbers, key=lambda n: float(n.replace("'", ".5")))
    assert len(EQUATIONS) == 26
    assert all(key == eq.key for key, eq in EQUATIONS.items())


# --- purity, linearity, precision ---------------------------------------------------------------


def frozen(tree):
    """The bytes of every array, by name."""
    return {name: [b.tobytes() for b in leaves(a)] for name, a in tree.items()}


@EVERY
def test_pure_and_repeatable(eq, case):
    before = frozen(case.inputs)
    outputs, saved = run(eq, case.inputs)
    cotangents = draw_cotangents(outputs, np.random.default_rng(2).standard_normal)
    given, primal = frozen(cotangents), frozen(outputs)
    first, second = (frozen(eq.backward(saved, **cotangents)) for _ in range(2))
    assert first == second
    again, saved = run(eq, case.inputs)
    assert frozen(again) == primal == frozen(outputs)
    assert frozen(eq.backward(saved, **cotangents)) == first
    assert frozen(case.inputs) == before and frozen(cotangents) == given


@EVERY
def test_backward_is_linear_and_finite(eq, case):
    rng = np.random.default_rng(3)
    outputs, pullback = eq.vjp(**case.inputs)
    u = draw_cotangents(outputs, rng.standard_normal)
    v = draw_cotangents(outputs, rng.standard_normal)
    a, b = 0.7, -1.9
    of_u, of_v = pullback(**u), pullback(**v)
    of_both = pullback(**{n: np.asarray(a * u[n] + b * v[n]) for n in u})
    alone = [pullback(**{n: w}) for n, w in u.items()]  # the other cotangents are zero
    for name in eq.gradients:
        what = f"{eq.key}, case {case.name}, {name}"
        gradients = [of_u[name], of_v[name], of_both[name], *(g[name] for g in alone)]
        for x, y, z, *parts in zip(*map(leaves, gradients), strict=True):
            assert all(np.isfinite(g).all() for g in (x, y, z)), what
            largest = np.abs([x, y]).max(initial=0)
            assert np.all(np.abs(a * x + b * y - z) <= 1e-10 * largest + EPS), what
            largest = np.abs([x, *parts]).max(initial=0)
            assert np.all(np.abs(sum(parts) - x) <= 1e-10 * largest + EPS), what
            assert "ordinary" not in case.flags or np.any(x), what + " is zero"


def in_float32(eq, case):
    """The inputs of a case in float32; skips the test where float32 cannot hold them."""
    with np.errstate(over="ignore"):
        single = {name: cast(a, np.float32) for name, a in case.inputs.items()}
    for name in eq.gradients:
        if isinstance(single[name], float):
            single[name] = np.float32(single[name])
    pairs = [
        (b, c)
        for name, a in single.items()
        if is_float(a)
        for b, c in zip(leaves(a), leaves(case.inputs[name]))
    ]
    held = all(np.isfinite(b).all() and np.array_equal(b == 0, c == 0) for b, c in pairs)
    if not pairs or not held:
        pytest.skip("no input, or magnitudes that float32 does not have")
    return single


@EVERY
def test_float32_stays_float32(eq, case):
    single = in_float32(eq, case)
    outputs, saved = run(eq, single)
    cotangents = draw_cotangents(outputs, np.random.default_rng(4).standard_normal)
    gradients = eq.backward(saved, **cotangents)
    # The same numbers in float64: only the arithmetic differs.
    want, saved = run(eq, {name: cast(a, np.float64) for name, a in single.items()})
    bars = {name: cast(a, np.float64) for name, a in cotangents.items()}
    want_gradients = eq.backward(saved, **bars)
    pairs = [(name, outputs[name], want[name]) for name in outputs]
    pairs += [(f"{name}_bar", gradients[name], want_gradients[name]) for name in eq.gradients]
    for name, got, exact in pairs:
        what = f"{eq.key}, case {case.name}, {name}"
        for g, w in zip(leaves(got), leaves(exact), strict=True):
            dtype = np.float32 if w.dtype == np.float64 else w.dtype
            assert g.dtype == dtype, f"{what} is {g.dtype}"
            is_wrong = np.isfinite(w).all() and not np.isfinite(g).all()
            assert not is_wrong, f"{what} is not finite in float32"
        doubles = [[b.astype(float) for b in leaves(a)] for a in (got, exact)]
        close(*doubles, 1e-5, what)


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
        (test_closed_forms, eq, hand._replace(expected=wrong)),
        (test_gradients_have_the_shapes_of_the_inputs, spoiled(eq, np.transpose), case),
        (test_pure_and_repeatable, altered(eq, forward=impure), case),
        (test_pure_and_repeatable, altered(eq, forward=counting()), case),
        (test_backward_is_linear_and_finite, spoiled(eq, np.abs), case),
        (test_backward_is_linear_and_finite, spoiled(eq, lambda g: g / 0.0), case),
        (test_backward_is_linear_and_finite, spoiled(eq, np.zeros_like), case),
        (test_float32_stays_float32, altered(eq, forward=doubled), case),
        (test_float32_stays_float32, spoiled(eq, imprecise), case),
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
            check_shapes(eq, case, arguments, outputs)
        except AssertionError:
            return True
    return False


@EACH
def test_a_comment_that_lies_is_noticed(eq):
    arguments, outputs = specs_of(eq)
    assert not is_noticed(eq, arguments, outputs)
    for specs in (arguments, outputs):
        for name, spec in list(specs.items()):
            for lie in lies(spec):
                specs[name] = lie
                assert is_noticed(eq, arguments, outputs), f"{eq.key}, {name}: {lie}"
            specs[name] = spec
