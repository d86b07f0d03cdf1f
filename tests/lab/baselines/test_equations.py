"""Every equation of the baselines: gradients, closed forms, shapes, purity, precision, twins."""

import math

import numpy as np
import pytest
from scipy.special import lpmv

from p4dgs_ref.lab.baselines import BASELINE_EQUATIONS, conditional, rotation_4d, sh_color
from p4dgs_ref.table import Equation
from tests.equations import adjoint, rules
from tests.golden.cases import cases_of

ALL = [
    pytest.param(eq, case, id=f"{key}-{case.name}")
    for key, eq in BASELINE_EQUATIONS.items()
    for case in cases_of(key)
]
EVERY = pytest.mark.parametrize("eq, case", ALL)
LEFT_OUT = {
    # its networks are written in the docstring
    (rules.comments_tell_the_shapes, "deformation_d3dgs", "ordinary"),
    (rules.comments_tell_the_shapes, "deformation_d3dgs", "no_skip"),
    (rules.comments_tell_the_shapes, "deformation_d3dgs", "no_time_net"),
    # a layer whose units are all 0
    (rules.backward_is_linear_and_finite, "plane_decoder", "deeper"),
    # t - mu_t is 0 in float64 only
    (rules.float32_stays_float32, "marginal", "at_its_mean"),
    (rules.float32_stays_float32, "spherindrical", "at_its_mean"),
}


def case_of(key, name="ordinary"):
    return next(case for case in cases_of(key) if case.name == name)


def test_the_table_names_every_equation_of_the_room():
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


@pytest.mark.parametrize("rule", rules.RULES, ids=lambda rule: rule.__name__)
@EVERY
def test_rules_of_the_paper_hold_here(rule, eq, case):
    if (rule, eq.key, case.name) not in LEFT_OUT:
        rule(eq, case)


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


def hamilton(p, q):
    """The product of two quaternions (w, x, y, z), from its scalar and vector parts."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([p[0] * q[0] - p[1:] @ q[1:], *vector])


def test_4d_rotations_against_products_of_quaternions():
    inputs = case_of("rotation_4d").inputs
    R, _ = rotation_4d.forward(**inputs)
    for matrix, l, r in zip(R, *inputs.values()):
        l, r = (q / np.linalg.norm(q) for q in (l, r))
        for axis in range(4):
            v = np.roll(np.eye(4)[axis], 1)  # (t, x, y, z)
            turned = hamilton(hamilton(l, v), r * [1, -1, -1, -1])
            assert matrix[:, axis] == pytest.approx(np.roll(turned, -1), abs=1e-15)


def test_conditional_and_marginal_against_an_integral():
    """The 4D density on the slice t: its integral, mean and covariance, by sums over a grid."""
    x, mu_t, s, R, t = case_of("conditional").inputs.values()
    (x_t, Sigma_t, var_t), _ = conditional.forward(x, mu_t, s, R, t)
    weight = BASELINE_EQUATIONS["marginal"](alpha=np.ones(5), mu_t=mu_t, var_t=var_t, t=t)["weight"]
    steps = np.linspace(-7, 7, 41)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    for n in range(5):
        precision = np.linalg.inv(R[n] @ np.diag(s[n] ** 2) @ R[n].T)
        # A grid in which the slice is a round Gaussian; any affine map integrates the same.
        root = np.linalg.cholesky(np.linalg.inv(precision[:3, :3]))

        def slice_at(time, middle):
            points = middle + grid @ root.T
            v = np.concatenate([points - x[n], np.full((len(grid), 1), time - mu_t[n])], axis=1)
            return points, np.exp(-0.5 * np.einsum("pi,ij,pj->p", v, precision, v))

        points, density = slice_at(t, x_t[n])
        _, at_mean = slice_at(mu_t[n], x[n])
        assert weight[n] == pytest.approx(density.sum() / at_mean.sum(), rel=1e-9)
        mean = density @ points / density.sum()
        assert mean == pytest.approx(x_t[n], rel=1e-9)
        spread = (points - mean).T * density @ (points - mean) / density.sum()
        assert spread == pytest.approx(Sigma_t[n], rel=1e-8, abs=1e-10)


def test_a_lasting_gaussian_keeps_its_shape_in_float32():
    """Where A and b b^T / var_t agree to all digits but a few, Sigma_t has full precision."""
    _, mu_t, s, R, t = case_of("conditional").inputs.values()
    inputs = [np.zeros((5, 3)), mu_t, s * [1e-3, 1e-3, 1e-3, 1e5], R]
    (_, exact, _), _ = conditional.forward(*inputs, t)
    (_, Sigma_t, _), _ = conditional.forward(*(a.astype(np.float32) for a in inputs), t)
    assert np.all(np.abs(Sigma_t - exact) <= 1e-6 * exact.max(axis=(1, 2), keepdims=True))
    M = (R * inputs[2][:, None]).astype(np.float32)
    Sigma = M @ M.transpose(0, 2, 1)
    naive = Sigma[:, :3, :3] - Sigma[:, :3, 3:] * Sigma[:, 3:, :3] / Sigma[:, 3:, 3:]
    assert np.abs(naive - exact).max() > exact.max()
