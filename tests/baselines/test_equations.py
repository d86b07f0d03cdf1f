"""Every equation of the baselines: gradients, closed forms, shapes, purity, precision, twins."""

import math

import numpy as np
import pytest
from scipy.special import lpmv

from p4dgs_ref.baselines import sh_color
from p4dgs_ref.baselines.table import BASELINE_EQUATIONS
from p4dgs_ref.table import Equation
from tests.baselines.cases import cases_of
from tests.core import adjoint, shape_comments
from tests.core.adjoint import EPS, cast, close, draw_cotangents, leaves

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")
ALL = [
    pytest.param(eq, case, id=f"{key}-{case.name}")
    for key, eq in BASELINE_EQUATIONS.items()
    for case in cases_of(key)
]
EVERY = pytest.mark.parametrize("eq, case", ALL)


def case_of(key, name="ordinary"):
    return next(case for case in cases_of(key) if case.name == name)


def test_the_table_names_every_equation_of_the_room():
    keys = {eq.key for eq in BASELINE_EQUATIONS.values()}
    assert keys == set(BASELINE_EQUATIONS)
    for eq in BASELINE_EQUATIONS.values():
        assert isinstance(eq, Equation) and eq.formula and eq.module.rpartition(".")[2] == eq.key
        assert eq.number[0] in "DHG" and eq.number[1:].isdigit()
    numbers = [eq.number for eq in BASELINE_EQUATIONS.values()]
    assert len(set(numbers)) == len(numbers)


@EVERY
def test_backward_is_the_adjoint_of_the_derivative(eq, case):
    if case.smooth:
        adjoint.check_adjoint(eq, case, eq)
    else:
        assert case.expected, "on a kink only a closed form says what holds"


@pytest.mark.parametrize("eq, case", [p for p in ALL if p.values[1].expected])
def test_closed_forms(eq, case):
    outputs, pullback = eq.vjp(**case.inputs)
    gradients = pullback(**case.cotangents)
    got = {**outputs, **{name + "_bar": a for name, a in gradients.items()}}
    for name, want in case.expected.items():
        close(got[name], want, case.tolerance, f"{eq.key}, case {case.name}, {name}")


@pytest.mark.parametrize("eq, case", [p for p in ALL if ".baselines." in p.values[0].module])
def test_comments_tell_the_shapes(eq, case):
    arguments = shape_comments.arguments(eq.forward)
    outputs = shape_comments.outputs(eq.forward, eq.outputs)
    named = {**case.inputs, **{f"output {name}": a for name, a in eq(**case.inputs).items()}}
    specs = {**arguments, **{f"output {name}": spec for name, spec in outputs.items()}}
    lengths, numbers, _ = shape_comments.compare(specs, named, False)
    if "ordinary" in case.flags:
        axes = [*lengths.values(), *(n for n in numbers if n > 1)]
        assert len(set(axes)) == len(axes), f"axes of equal length {lengths}"


@EVERY
def test_gradients_are_pure_linear_and_keep_the_precision(eq, case):
    rng = np.random.default_rng(3)
    before = {name: [b.tobytes() for b in leaves(a)] for name, a in case.inputs.items()}
    outputs, pullback = eq.vjp(**case.inputs)
    u, v = (draw_cotangents(outputs, rng.standard_normal) for _ in range(2))
    of_u, of_v, again = pullback(**u), pullback(**v), pullback(**u)
    of_both = pullback(**{name: np.asarray(0.7 * u[name] - 1.9 * v[name]) for name in u})
    after = {name: [b.tobytes() for b in leaves(a)] for name, a in case.inputs.items()}
    assert before == after
    assert set(of_u) == set(eq.gradients)
    for name in eq.gradients:
        inputs = leaves(case.inputs[name])
        parts = (leaves(g[name]) for g in (of_u, of_v, of_both, again))
        for x, y, both, repeated, given in zip(*parts, inputs, strict=True):
            assert x.shape == given.shape and np.array_equal(x, repeated), name
            largest = np.abs([x, y]).max(initial=0)
            assert np.all(np.abs(0.7 * x - 1.9 * y - both) <= 1e-10 * largest + EPS), name
    single = {name: cast(a, np.float32) for name, a in case.inputs.items()}
    outputs, pullback = eq.vjp(**single)
    gradients = pullback(**draw_cotangents(outputs, rng.standard_normal))
    for a in [*outputs.values(), *gradients.values()]:
        assert all(b.dtype == np.float32 for b in leaves(a))


def test_activations_against_the_math_module():
    inputs = case_of("activations").inputs
    (s, r, alpha), _ = BASELINE_EQUATIONS["activations"].forward(**inputs)
    for n, (log_s, raw_r, logit) in enumerate(zip(*inputs.values())):
        assert s[n] == pytest.approx([math.exp(v) for v in log_s], rel=1e-15)
        norm = math.hypot(*raw_r)
        assert r[n] == pytest.approx([v / norm for v in raw_r], rel=1e-14)
        assert alpha[n] == pytest.approx(1 / (1 + math.exp(-logit)), rel=1e-14)


def harmonic(l, m, x, y, z):
    """The real spherical harmonic from SciPy's Legendre functions, with their sign (-1)^m."""
    n = abs(m)
    norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - n) / math.factorial(l + n))
    wave = math.cos(m * math.atan2(y, x)) if m >= 0 else math.sin(n * math.atan2(y, x))
    return norm * lpmv(n, l, z) * wave * (math.sqrt(2) if m else 1)


def test_harmonics_against_legendre_functions():
    orders = [(l, m) for l in range(4) for m in range(-l, l + 1)]
    d = case_of("sh_color").inputs["d"]
    Y, _ = sh_color.basis(d, 16)
    for row, direction in zip(Y, d):
        assert row == pytest.approx([harmonic(l, m, *direction) for l, m in orders], abs=1e-14)


def test_harmonics_are_orthonormal_on_the_sphere():
    """By a quadrature that is exact for polynomials of degree 6."""
    z, weights = np.polynomial.legendre.leggauss(4)
    phi = 2 * np.pi * np.arange(8) / 8
    ring = np.sqrt(1 - z * z)
    d = np.stack(
        [np.outer(ring, np.cos(phi)), np.outer(ring, np.sin(phi)), np.outer(z, np.ones(8))], axis=2
    ).reshape(-1, 3)
    Y, _ = sh_color.basis(d, 16)
    area = np.repeat(weights, 8) * 2 * np.pi / 8
    assert (Y.T * area) @ Y == pytest.approx(np.eye(16), abs=1e-14)
