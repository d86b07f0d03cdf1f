"""The catalogue of hard cases: its true values have 50 digits, and the package holds them."""

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.lab.stability.table import FILE
from p4dgs_ref.table import EQUATIONS
from tests.golden import checks
from tests.golden.cases import FLAGS, cases_of
from tests.golden.hard_cases import catalogue, make_constants, publish
from tests.golden.hard_cases.measured import procedure_rows

ENTRIES = [entry for entry in catalogue.ENTRIES.values() if entry.case is not None]
DATA = Path(__file__).with_name("data")
BINS = json.loads((DATA / "gaussian_bin_constants.json").read_text(encoding="utf-8"))["rows"]


def numbers(value):
    """The numbers of nested lists."""
    return [n for v in value for n in numbers(v)] if isinstance(value, list) else [value]


def test_the_package_holds_the_catalogue():
    """The file of the package is the one that `publish` writes.

    The results of literal formulas may differ in their last bits from machine to machine.
    """
    stored, made = json.loads(FILE.read_text(encoding="utf-8")), json.loads(publish.text())
    for old, new in zip(stored, made, strict=True):
        literals = [row.pop("literal", {}) for row in (old, new)]
        assert old == new, new["id"]
        for a, b in zip(*(list(literal.values()) for literal in literals), strict=True):
            assert a == b or float(a) == pytest.approx(float(b), rel=1e-3), new["id"]


@pytest.fixture(scope="module")
def procedures():
    return procedure_rows()


def test_the_catalogue_is_complete():
    assert len(catalogue.ENTRIES) == 103


@pytest.mark.slow
def test_no_procedure_is_beyond_its_bound(procedures):
    """The hard cases of codec, rendering and training, really run in both precisions."""
    assert len(procedures) == 2 * 18
    assert all(row["error"] >= 0 and row["bound"] <= 1e-3 for row in procedures)
    failed = [row for row in procedures if row["verdict"] != "ok"]
    assert not [f"{row['id']} {row['dtype']}: {row['error']}" for row in failed]


@pytest.mark.slow
def test_the_usual_shortcuts_fail_where_procedures_say(procedures):
    literal = {(row["id"], row["dtype"]): row["literal"] for row in procedures}
    assert abs(literal["H-R7.sum", "float32"] / 2.0037919e8 - 1) > 0.01


def test_constants_have_fifty_digits_and_cover_every_case():
    stored = make_constants.stored()
    assert set(stored) == {f"{entry.equation}/{entry.id}" for entry in ENTRIES}
    long = 0
    for key, arrays in stored.items():
        for number in (n for values in arrays.values() for n in numbers(values) if n is not None):
            mantissa = number.lower().split("e")[0].lstrip("-").replace(".", "").lstrip("0")
            long += len(mantissa) >= 50
            # A short number is exact.
            assert len(mantissa) >= 50 or Fraction(number).denominator < 2**200, (key, number)
    assert long > 500


@pytest.mark.slow
def test_constants_are_made_again_the_same():
    assert make_constants.make() == make_constants.stored()


def test_constants_against_other_sources():
    """The bits from mpmath, and a distance by Pythagoras in integers."""
    known = {(z, w): bits for z, w, bits, *_ in BINS}
    found = 0
    for key, arrays in make_constants.stored().items():
        if not key.startswith("likelihood/H-R"):
            continue
        inputs = catalogue.ENTRIES[key.split("/")[1]].case.inputs
        columns = (inputs[name].ravel() for name in ("f_noisy", "q", "sigma"))
        for z, w, sigma, bits in zip(*columns, numbers(arrays["bits"])):
            if (abs(z / sigma), w / sigma) in known:
                found += 1
                wanted = known[abs(z / sigma), w / sigma]
                assert float(bits) == pytest.approx(wanted, rel=1e-15)
    assert found >= 8
    x = catalogue.ENTRIES["H-P1.beside"].case.inputs["x_a"][0]
    distance = math.sqrt(sum(Fraction(v) ** 2 for v in x) * 10**60) / 1e30
    stored = make_constants.stored()["view/H-P1.beside"]["delta_vc"][0][0]
    assert float(stored) == pytest.approx(distance, rel=1e-15)


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.id)
def test_hard_cases_are_cases(entry):
    """A hard case passes what the tests ask of an equation's own cases."""
    eq, case = EQUATIONS[entry.equation], entry.case
    assert case.flags and set(case.flags) <= set(FLAGS)
    assert case.name not in {own.name for own in cases_of(eq.key)}
    assert case in catalogue.cases(eq.key)
    checks.check_shapes(eq, case)
    checks.check_pure(eq, case)
    checks.check_linear_and_finite(eq, case)
    for a in case.inputs.values():
        for b in a if isinstance(a, list) else [a]:
            if isinstance(b, np.ndarray) and b.dtype.kind == "f":
                assert np.array_equal(b, b.astype(np.float32).astype(float))
