"""Every equation of the baselines: gradients, closed forms, shapes, purity, precision, twins."""

import pytest
from p4dgs_ref.lab.baselines import BASELINE_EQUATIONS

from p4dgs_ref.splatting.table import Equation
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
    (rules.comments_tell_the_shapes, "deformation_d3dgs", "square_layers"),
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
        assert isinstance(eq, Equation) and eq.formula and eq.module.__name__.rpartition(".")[2] == eq.key
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
