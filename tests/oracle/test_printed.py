"""A right port with fewer digits passes or is acceptable."""

import json

import numpy as np
import pytest

from p4dgs_ref import oracle
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.oracle import checker, published
from p4dgs_ref.oracle import compare as scales
from p4dgs_ref.oracle.compare import expected_tensors
from tests.oracle.answers import case_of, in_precision, write
from tests.workshop import vectors

PRECISIONS = (np.float64, np.float32)


# --- right formulas -----------------------------------------------------------------------------
def as_printed(case):
    """tanh and its slope 1 - tanh(y)^2, which has no digits left where the tanh saturates."""
    alpha = np.tanh(case.inputs()["y"])
    return {"out.alpha": alpha, "in_bar.y": case.cotangents()["alpha_bar"] * (1 - alpha**2)}


def test_a_formula_as_printed_is_acceptable_and_fails_strictly(tmp_path, capsys):
    cases = published.cases("tanh")
    got = {f"{case.name}/{n}": a for case in cases for n, a in as_printed(case).items()}
    write(tmp_path, tanh=got)
    check = ["oracle", "check", str(tmp_path), "--only", "tanh", "--json"]
    assert cli.run(check, 0.0) == 0
    assert json.loads(capsys.readouterr().out)["levels"]["L0"]["acceptable"] == 1
    assert cli.run([*check, "--strict"], 0.0) == 1
    assert json.loads(capsys.readouterr().out)["first_divergence"] == "opacity"


def printed_view(x_a, x_c):
    """The root of a sum of squares, which overflows and underflows at distances of 1e+-200."""
    ray = x_a - x_c
    delta = np.sqrt((ray**2).sum(axis=1, keepdims=True))
    with np.errstate(all="ignore"):
        return delta, np.where(delta + abs(ray).max(initial=0) > 0, ray / delta, 0)


def test_where_a_formula_overflows_the_report_names_the_case_and_the_recipe():
    with np.errstate(over="ignore", under="ignore"):
        said = str(oracle.check(printed_view, "view"))
        nan = oracle.check(lambda **i: (printed_view(**i)[0], np.nan * i["x_a"]), "view/far")
        strict = oracle.check(printed_view, "view", strict=True)
    assert "too: view/far, view/near\n  what keeps the digits: delta_vc by hypot" in said
    assert [finding.tensor for finding in nan.first.findings] == ["out.d_vc"]
    assert {"view/far", "view/near"} <= {r.id for r in strict.results if r.wrong}


# --- wrong formulas -----------------------------------------------------------------------------
ACCEPTABLE = [
    (id, dtype)
    for id in vectors.ACCEPTABLE
    for dtype in ("float64", "float32")
    if case_of(id).tolerance(dtype)
]


@pytest.mark.parametrize("id, dtype", ACCEPTABLE)
def test_a_case_with_several_right_answers_takes_those_alone(id, dtype):
    case = case_of(id)
    right = in_precision(expected_tensors(case.tensors), dtype)

    def verdict(name, wrong):
        result = checker.judge_answer(case, {**right, **in_precision({name: wrong}, dtype)})
        assert result.wrong == (result.verdict == "fail")
        return result.verdict

    for name, a in right.items():
        for number in (np.nan, 1e30, -1e30, np.inf):
            one = np.array(a)
            one.flat[0] = number
            assert {verdict(name, wrong) for wrong in (one, 0 * a + number, a[:0])} == {"fail"}
    for name, other in case.record["others"].items():
        nearest, within = other["times"] * right[name], other["within"]
        assert verdict(name, nearest + 0.99 * within) == "acceptable"
        assert verdict(name, nearest + 1.01 * within + 1e-3) == "fail"


RANGES = [
    (id, precision, name.removeprefix("range."))
    for (id, precision), tensors in scales.printed_arrays().items()
    for name in tensors
    if name.startswith("range.")
]


@pytest.mark.parametrize("id, precision, name", RANGES)
def test_beyond_the_range_only_lost_numbers_are_accepted(id, precision, name):
    """A finite number is judged there too: only 0, infinities and NaN are what overflow leaves."""
    case = case_of(id)
    right = in_precision(expected_tensors(case.tensors), precision)
    lost, a = scales.printed_arrays()[id, precision][f"range.{name}"], right[name]
    finite = [np.where(a == 0, 1, factor * a).astype(precision) for factor in (-1, 0.5)]
    # A float64 tensor among float32 ones has the range of float64.
    mixed = np.full(a.shape, np.nan) if precision == "float32" else finite[0]
    for wrong in (*finite, mixed, a.astype(str), a.astype(complex)):
        result = checker.judge_answer(case, {**right, name: wrong})
        assert result.verdict == "fail" or name in case.not_judged(precision)
    for value in (0, np.inf, np.nan):
        gone = np.where(lost, value, a).astype(precision)
        result = checker.judge_answer(case, {**right, name: gone})
        near_zero = value == 0 and result.verdict == "pass"  # 0 may be within the bound
        is_nan = np.isnan(value) and name.startswith("out.")
        assert near_zero or is_nan == (result.verdict == "fail") != (name in result.not_judged)


@pytest.mark.parametrize("name", ["H-G3.1e4px", "H-G4.scale1e30"])
def test_what_float32_culls_is_zero_in_all_tensors_or_wrong(name):
    case = case_of(f"projection/{name}")
    right = in_precision(expected_tensors(case.tensors), "float32")
    culled = {n: np.zeros_like(a) for n, a in right.items()}
    assert checker.judge_answer(case, culled).verdict == "acceptable"
    for got, changes in (right, {"out.visible": ~right["out.visible"]}), (culled, right):
        for tensor in changes.keys() - case.not_judged("float32"):
            for wrong in (changes[tensor], changes[tensor] * np.float32(np.nan)):
                result = checker.judge_answer(case, got | {tensor: wrong})
                is_same = np.array_equal(wrong, got[tensor])
                assert is_same or result.verdict == "fail", tensor


# --- the data -----------------------------------------------------------------------------------


# --- tensors that are wrong, or not asked --------------------------------------------------------
