"""What holds of every equation on each of its cases: closed forms, shapes, purity, precision."""

from collections import Counter

import numpy as np

from p4dgs_ref.equations.table import Equation
from tests.equations.adjoint import EPS, cast, close, draw_cotangents, is_float, leaves
from tests.workshop import shape_comments


def run(eq, inputs):
    """The outputs {name: array} and what `backward` needs."""
    output, saved = eq.forward(**inputs)
    return eq.by_name(output), saved


def closed_forms(eq, case):
    outputs, pullback = eq.vjp(**case.inputs)
    gradients = pullback(**case.cotangents)  # the cotangents that the case leaves out are zero
    got = {**outputs, **{name + "_bar": a for name, a in gradients.items()}}
    for name, want in case.expected.items():
        close(got[name], want, case.tolerance, f"{eq.key}, case {case.name}, {name}")
    assert {name.removesuffix("_bar") for name in case.cotangents} <= set(outputs)


def specs_of(eq):
    """The Specs of an equation's arguments and outputs."""
    return shape_comments.arguments(eq.forward), shape_comments.outputs(eq.forward, eq.outputs)


def check_shapes(eq, case, arguments, outputs):
    """Compare a case with Specs of arguments and outputs; returns what `compare` returns."""
    values, _ = run(eq, case.inputs)
    named = {**case.inputs, **{f"output {name}": a for name, a in values.items()}}
    specs = {**arguments, **{f"output {name}": spec for name, spec in outputs.items()}}
    return shape_comments.compare(specs, named, "off" in case.flags)


def comments_tell_the_shapes(eq, case):
    lengths, numbers, _ = check_shapes(eq, case, *specs_of(eq))
    if "ordinary" in case.flags:
        counts = Counter([*lengths.values(), *(n for n in numbers if n > 1)])
        twice = [n for n, count in counts.items() if count > 1]
        assert not twice, f"{eq.key}, case {case.name}: axes of equal length {lengths}"


def gradients_have_the_shapes_of_the_inputs(eq, case):
    outputs, saved = run(eq, case.inputs)
    rng = np.random.default_rng(1)
    gradients = eq.backward(saved, **draw_cotangents(outputs, rng.standard_normal))
    assert set(gradients) == set(eq.gradients)
    for name, gradient in gradients.items():
        shapes = [np.shape(b) for b in leaves(case.inputs[name])]
        assert [np.shape(g) for g in leaves(gradient)] == shapes, name


def frozen(tree):
    """The bytes of every array, by name."""
    return {name: [b.tobytes() for b in leaves(a)] for name, a in tree.items()}


def pure_and_repeatable(eq, case):
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


def backward_is_linear_and_finite(eq, case):
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
    """The inputs of a case in float32; None where there are none that float32 can hold."""
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
    return single if pairs and held else None


def float32_stays_float32(eq, case):
    single = in_float32(eq, case)
    if single is None:
        return
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


RULES = (
    closed_forms,
    comments_tell_the_shapes,
    gradients_have_the_shapes_of_the_inputs,
    pure_and_repeatable,
    backward_is_linear_and_finite,
    float32_stays_float32,
)


def altered(eq, **functions):
    """A copy of an equation with another forward or backward."""
    members = {name: staticmethod(function) for name, function in functions.items()}
    return type("Altered", (Equation,), members)(*eq)
