"""Every declared equation: gradients, shapes, closed forms, purity, precision; and tests of these tests."""

import re
from collections import Counter

import numpy as np
import pytest

import p4dgs_ref.splatting  # noqa: F401  declares covariance, projection and compositing
from p4dgs_ref.equations import EQUATIONS, FLAGS

pytestmark = pytest.mark.filterwarnings(
    "error::RuntimeWarning"
)  # no overflow, no 0/0, on hard cases neither
ALL = [
    pytest.param(eq, case, id=f"{key}-{case.name}")
    for key, eq in EQUATIONS.items()
    for case in eq.cases()
]
EPS = np.finfo(float).eps
STEPS = (1e-2, 1e-3, 1e-4, 1e-5)
EVERY = pytest.mark.parametrize("eq, case", ALL)


# --- arrays, numbers and lists of arrays alike; a tuple is a setting --------------------------------------------
def leaves(a):
    """The arrays of an array or of a list of arrays."""
    return [np.asarray(b) for b in a] if isinstance(a, list) else [np.asarray(a)]


def like(a, new):
    """`new` (a list of arrays) in the form of `a`: a list for a list, an array for an array."""
    return new if isinstance(a, list) else new[0]


def is_float(a):
    return a is not None and all(b.dtype.kind == "f" for b in leaves(a)) and len(leaves(a)) > 0


def dot_terms(a, b):
    return np.concatenate([np.zeros(0), *((x * y).ravel() for x, y in zip(leaves(a), leaves(b)))])


def cast(a, dtype):
    """Float arrays in another precision; Python's numbers, integers and masks stay."""
    if isinstance(a, list):
        return [cast(b, dtype) for b in a]
    return a.astype(dtype) if isinstance(a, (np.ndarray, np.generic)) and a.dtype.kind == "f" else a


def draw_cotangents(eq, out, draw):
    """One for every float output by draw(shape); none where no input receives a gradient."""
    return {
        name + "_bar": like(a, [np.asarray(draw(b.shape), b.dtype) for b in leaves(a)])
        for name, a in out._asdict().items()
        if is_float(a) and eq.differentiable
    }


def close(got, want, tolerance, what):
    """Within `tolerance` of the largest wanted magnitude, EPS if that is 0; infinities and integers agree exactly."""
    for g, w in zip(leaves(got), leaves(want), strict=True):
        assert g.shape == w.shape, f"{what}: shape {g.shape}, expected {w.shape}"
        finite = np.isfinite(w) if g.dtype.kind == "f" else np.zeros(w.shape, bool)
        assert np.array_equal(g[~finite], w[~finite]), f"{what}: {g} where {w} was expected"
        if not finite.any():
            continue
        worst = np.abs(g[finite] - w[finite]).max()
        bound = tolerance * np.abs(w[finite]).max() or EPS
        assert worst <= bound, f"{what}: off by {worst:.3g}, allowed {bound:.3g}"


# --- the gradient test -------------------------------------------------------------------------------------------
def slope(f, cotangents, h):
    """The terms of <cotangents, J d> by a fourth-order central difference of f(step)."""
    (a, b, p, m) = (f(s * h)._asdict() for s in (2, -2, 1, -1))
    return np.concatenate(
        [
            dot_terms(
                v,
                [
                    (8 * (w - x) - (y - z)) / (12 * h)
                    for w, x, y, z in zip(*(leaves(o[n[:-4]]) for o in (p, m, a, b)))
                ],
            )
            for n, v in cotangents.items()
        ]
    )


def check_adjoint(eq, case):
    """<y_bar, J d> = <J^T y_bar, d> for random y_bar and d, one input at a time so that blame is local."""
    rng = np.random.default_rng(0)
    out, res = eq.forward(**case.inputs)
    cotangents = draw_cotangents(eq, out, rng.standard_normal)
    gradients = eq.backward(res, **cotangents)
    # a difference cannot see what is lost in the last bits of its outputs
    rounding = (
        4
        * EPS
        * sum(np.abs(dot_terms(a, getattr(out, n[:-4]))).sum() for n, a in cotangents.items())
    )
    smooth = eq.surrogate(**case.inputs) if eq.surrogate else eq
    for name in eq.differentiable:
        x = case.inputs[name]
        d = [rng.normal(size=b.shape) * np.where(b == 0, 1, np.abs(b)) for b in leaves(x)]
        ours = dot_terms(gradients[name], d)

        def f(step):
            return smooth(
                **{**case.inputs, name: like(x, [b + step * e for b, e in zip(leaves(x), d)])}
            )

        errors = []  # in units of what is allowed
        for h in STEPS:
            theirs = slope(f, cotangents, h)
            allowed = 1e-7 * (np.abs(ours).sum() + np.abs(theirs).sum()) + rounding / h
            errors.append(abs(ours.sum() - theirs.sum()) / allowed if allowed != 0 else 0.0)
        assert any(e <= 1 for e in errors), (
            f"{eq.key}, case {case.name}, input {name}: off by "
            + ", ".join(f"{e:.1e} (step {h})" for e, h in zip(errors, STEPS))
        )


@EVERY
def test_backward_is_the_adjoint_of_the_derivative(eq, case):
    if case.smooth:
        check_adjoint(eq, case)
    else:
        assert case.expected, (
            f"{eq.key}, case {case.name}: on a kink only a closed form says what holds"
        )


# --- closed forms ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("eq, case", [p for p in ALL if p.values[1].expected])
def test_closed_forms(eq, case):
    out, res = eq.forward(**case.inputs)
    zero = draw_cotangents(eq, out, np.zeros)  # those that the case leaves out
    gradients = eq.backward(res, **{**zero, **case.cotangents})
    got = {**out._asdict(), **{name + "_bar": a for name, a in gradients.items()}}
    for name, want in case.expected.items():
        close(got[name], want, case.tolerance, f"{eq.key}, case {case.name}, {name}")
    assert all(name[:-4] in out._fields for name in case.cotangents)


# --- declarations ------------------------------------------------------------------------------------------------
def bind(axes, array, lengths, may_be_off, what):
    """Check one array against its axes, "3 A 3k": numbers are lengths, letters keep theirs, 3k is three times k."""
    shape, axes = np.shape(array), axes.split()
    assert len(shape) == len(axes), f"{what}: shape {shape}, declared {axes}"
    for n, axis in zip(shape, axes):
        factor, letter = re.fullmatch(r"(\d*)([A-Za-z]*)", axis).groups()
        factor = int(factor or 1)
        if may_be_off and n == 0:  # an effect that is off has inputs and heads of zero width
            continue
        if letter:
            assert n % factor == 0, f"{what}: shape {shape}, declared {axes}"
        want = factor * (lengths.setdefault(letter, n // factor) if letter else 1)
        assert n == want, f"{what}: shape {shape}, declared {axes} with {lengths}"


@EVERY
def test_declared_shapes_hold(eq, case):
    out, res = eq.forward(**case.inputs)
    lengths = {}
    for side, arrays in ((0, case.inputs), (-1, out._asdict())):
        for name, a in arrays.items():
            what = f"{eq.key}, case {case.name}, {name}"
            if name not in eq.shapes and not isinstance(a, (np.ndarray, list)):
                continue  # a setting
            assert name in eq.shapes, f"{what}: no shape is declared"
            axes = eq.shapes[name].split("->")[
                side
            ]  # "A k -> N": an output of the same name as an input
            assert isinstance(a, list) == axes.startswith("*"), f"{what}: declared {axes!r}"
            if isinstance(a, list):
                for b in a:  # letters of a list may differ from array to array
                    bind(axes[1:], b, {}, "off" in case.flags, what)
            elif a is not None and not isinstance(a, tuple):
                bind(axes, a, lengths, "off" in case.flags, what)
    if "ordinary" in case.flags:
        numbers = {int(n) for axes in eq.shapes.values() for n in re.findall(r"\b[2-9]\b", axes)}
        twice = [n for n, count in Counter([*lengths.values(), *numbers]).items() if count > 1]
        assert not twice, f"{eq.key}, case {case.name}: axes of equal length {lengths}"
    gradients = eq.backward(
        res, **draw_cotangents(eq, out, np.random.default_rng(1).standard_normal)
    )
    assert set(gradients) == set(eq.differentiable)
    for name, gradient in gradients.items():
        assert [np.shape(g) for g in leaves(gradient)] == [
            np.shape(b) for b in leaves(case.inputs[name])
        ], name


@pytest.mark.parametrize("eq", EQUATIONS.values(), ids=EQUATIONS)
def test_declaration(eq):
    cases = list(eq.cases())
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    flags = {flag for case in cases for flag in case.flags}
    assert "ordinary" in flags and len(flags) > 1 and flags <= set(FLAGS), flags
    assert all(case.flags for case in cases)
    assert set(eq.shapes) <= set(cases[0].inputs) | set(eq(**cases[0].inputs)._fields)
    assert eq.formula and set(eq.differentiable) <= set(cases[0].inputs) & set(eq.shapes)


def test_paper_order():
    numbers = [eq.number for eq in EQUATIONS.values() if eq.number]
    assert numbers == sorted(numbers, key=lambda n: float(n.replace("'", ".5")))


# --- purity, linearity, precision --------------------------------------------------------------------------------
def frozen(tree):
    return {name: [b.tobytes() for b in leaves(a)] for name, a in tree.items() if a is not None}


@EVERY
def test_pure_and_repeatable(eq, case):
    before = frozen(case.inputs)
    out, res = eq.forward(**case.inputs)
    cotangents = draw_cotangents(eq, out, np.random.default_rng(2).standard_normal)
    given, primal = frozen(cotangents), frozen(out._asdict())
    first, second = (frozen(eq.backward(res, **cotangents)) for _ in range(2))
    assert first == second
    again, res = eq.forward(**case.inputs)
    assert frozen(again._asdict()) == primal == frozen(out._asdict())
    assert frozen(eq.backward(res, **cotangents)) == first
    assert frozen(case.inputs) == before and frozen(cotangents) == given


@EVERY
def test_backward_is_linear_and_finite(eq, case):
    rng = np.random.default_rng(3)
    out, res = eq.forward(**case.inputs)
    u, v = (
        draw_cotangents(eq, out, rng.standard_normal),
        draw_cotangents(eq, out, rng.standard_normal),
    )
    a, b = 0.7, -1.9
    both = {n: like(u[n], [a * x + b * y for x, y in zip(leaves(u[n]), leaves(v[n]))]) for n in u}
    of_u, of_v, of_both = (eq.backward(res, **w) for w in (u, v, both))
    alone = (
        [eq.backward(res, **{n: w}) for n, w in u.items()] if len(u) > 1 else [of_u]
    )  # absent counts as zero
    for name in eq.differentiable:
        for x, y, z, *parts in zip(
            *map(leaves, (of_u[name], of_v[name], of_both[name], *(g[name] for g in alone)))
        ):
            what = f"{eq.key}, case {case.name}, {name}"
            assert all(np.isfinite(g).all() for g in (x, y, z)), what
            assert np.all(
                np.abs(a * x + b * y - z) <= 1e-10 * np.abs([x, y]).max(initial=0) + EPS
            ), what
            assert np.all(
                np.abs(sum(parts) - x) <= 1e-10 * np.abs([x, *parts]).max(initial=0) + EPS
            ), what
            assert "ordinary" not in case.flags or np.any(x), what + " is zero"


@EVERY
def test_float32_stays_float32(eq, case):
    with np.errstate(over="ignore"):
        single = {
            n: np.float32(a)
            if isinstance(a, float) and n in eq.differentiable
            else cast(a, np.float32)
            for n, a in case.inputs.items()
        }
    double = {
        n: cast(a, np.float64) for n, a in single.items()
    }  # the same numbers: only the arithmetic differs
    pairs = [
        (b, c)
        for n in single
        if is_float(single[n])
        for b, c in zip(leaves(single[n]), leaves(case.inputs[n]))
    ]
    if not pairs or not all(
        np.isfinite(b).all() and np.array_equal(b == 0, c == 0) for b, c in pairs
    ):
        pytest.skip("no input, or magnitudes that float32 does not have")
    out, res = eq.forward(**single)
    cotangents = draw_cotangents(eq, out, np.random.default_rng(4).standard_normal)
    gradients = eq.backward(res, **cotangents)
    want, res = eq.forward(**double)
    want_gradients = eq.backward(res, **{n: cast(a, np.float64) for n, a in cotangents.items()})
    for name, got, exact in [(n, getattr(out, n), getattr(want, n)) for n in out._fields] + [
        (n + "_bar", gradients[n], want_gradients[n]) for n in eq.differentiable
    ]:
        what = f"{eq.key}, case {case.name}, {name}"
        for g, w in zip(leaves(got), leaves(exact)):
            assert g.dtype == (np.float32 if w.dtype == np.float64 else w.dtype), (
                f"{what} is {g.dtype}"
            )
            assert np.isfinite(g).all() or not np.isfinite(w).all(), (
                f"{what} is not finite in float32"
            )
        close(
            [g.astype(float) for g in leaves(got)],
            [w.astype(float) for w in leaves(exact)],
            1e-5,
            what,
        )


@pytest.mark.parametrize("eq", [eq for eq in EQUATIONS.values() if eq.rungs], ids=lambda eq: eq.key)
def test_rungs_agree_on_ordinary_cases(eq):
    for case in eq.cases():
        if "ordinary" in case.flags:
            for name, forward in eq.rungs.items():
                for got, want in zip(forward(**case.inputs)[0], eq(**case.inputs)):
                    close(got, want, 1e-9, f"{eq.key}, rung {name}, case {case.name}")


# --- the tests of the tests --------------------------------------------------------------------------------------
def spoiled(eq, spoil):
    """A copy of an equation whose first gradient is wrong."""

    def backward(res, **cotangents):
        gradients, first = eq.backward(res, **cotangents), eq.differentiable[0]
        return {**gradients, first: spoil(gradients[first])}

    return eq._replace(backward=backward)


def case_of(key, name="ordinary"):
    return next(case for case in EQUATIONS[key].cases() if case.name == name)


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
        with pytest.raises(
            AssertionError, match=f"{key}, case ordinary, input {eq.differentiable[0]}"
        ):
            check_adjoint(spoiled(eq, spoil), case)


def test_the_other_tests_reject_mistakes():
    eq, case, hand = EQUATIONS["offsets"], case_of("offsets"), case_of("offsets", "by_hand")

    def impure(x_a, **others):
        x_a += 1
        return eq.forward(x_a=x_a, **others)

    def doubled(**inputs):
        out, res = eq.forward(**inputs)
        return type(out)(out.x.astype(np.float64)), res

    def imprecise(gradient):
        return (
            gradient.astype(np.float16).astype(np.float32)
            if gradient.dtype == np.float32
            else gradient
        )

    wrong = {**hand.expected, "l_a_bar": -hand.expected["l_a_bar"]}
    swapped = {**eq.shapes, "x": "k A 3"}
    for test, bad, on in (
        (test_closed_forms, eq, hand._replace(expected=wrong)),
        (test_declared_shapes_hold, eq._replace(shapes=swapped), case),
        (test_declared_shapes_hold, spoiled(eq, np.transpose), case),
        (test_pure_and_repeatable, eq._replace(forward=impure), case),
        (test_backward_is_linear_and_finite, spoiled(eq, np.abs), case),
        (test_backward_is_linear_and_finite, spoiled(eq, lambda g: g / 0.0), case),
        (test_float32_stays_float32, eq._replace(forward=doubled), case),
        (test_float32_stays_float32, spoiled(eq, imprecise), case),
    ):
        with np.errstate(all="ignore"), pytest.raises(AssertionError):
            test(bad, on)
