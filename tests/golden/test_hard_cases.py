"""The catalogue of hard cases: its true values have 50 digits, and the package holds them."""

import json

import numpy as np
import pytest

from p4dgs_ref.lab.stability import FILE
from p4dgs_ref.table import EQUATIONS
from tests.equations import rules
from tests.golden import demo
from tests.golden.cases import FLAGS, cases_of
from tests.golden.hard_cases import catalogue, make_constants, publish
from tests.golden.hard_cases.__main__ import procedure_rows

NEEDLE = "H-G3.needle", "float64"
ENTRIES = [entry for entry in catalogue.ENTRIES.values() if entry.case is not None]


def test_the_package_holds_the_catalogue():
    """The file of the package is the one that `publish` writes.

    Other packages or kernels than the file was made with give literal formulas other last bits.
    """
    slack = 0 if demo.kept()["arithmetic"] == demo.with_what() else 1e-3
    stored, made = json.loads(FILE.read_text(encoding="utf-8")), json.loads(publish.text())
    for old, new in zip(stored, made, strict=True):
        literals = [row.pop("literal", {}) for row in (old, new)]
        assert old == new, new["id"]
        for a, b in zip(*(list(literal.values()) for literal in literals), strict=True):
            assert a == b or float(a) == pytest.approx(float(b), rel=slack, abs=0), new["id"]


@pytest.fixture(scope="module")
def procedures():
    return procedure_rows()


def test_the_catalogue_is_complete():
    assert len(catalogue.ENTRIES) == 104
    named = {f"{entry.equation}/{entry.id}" for entry in ENTRIES}
    assert set(make_constants.stored()) == named


@pytest.mark.slow
def test_no_procedure_is_beyond_its_bound(procedures):
    """The hard cases of codec, rendering and training, really run in both precisions."""
    assert len(procedures) == 2 * 19
    assert all(row["error"] >= 0 and row["bound"] <= 1e-3 for row in procedures)
    failed = [row for row in procedures if row["verdict"] != "ok"]
    assert not [f"{row['id']} {row['dtype']}: {row['error']}" for row in failed]


@pytest.mark.slow
def test_the_usual_shortcuts_fail_where_procedures_say(procedures):
    literal = {(row["id"], row["dtype"]): row["literal"] for row in procedures}
    assert abs(literal["H-R7.sum", "float32"] / 2.0037919e8 - 1) > 0.01
    (needle,) = (row for row in procedures if (row["id"], row["dtype"]) == NEEDLE)
    assert abs(needle["literal"] - needle["true"]) > 1e-3


@pytest.mark.slow
def test_constants_are_made_again_the_same():
    assert make_constants.make() == make_constants.stored()


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.id)
def test_hard_cases_are_cases(entry):
    """A hard case passes what the tests ask of an equation's own cases."""
    eq, case = EQUATIONS[entry.equation], entry.case
    assert case.flags and set(case.flags) <= set(FLAGS)
    assert case.name not in {own.name for own in cases_of(eq.key)}
    assert case in catalogue.cases(eq.key)
    rules.check_shapes(eq, case, *rules.specs_of(eq))
    rules.gradients_have_the_shapes_of_the_inputs(eq, case)
    rules.pure_and_repeatable(eq, case)
    rules.backward_is_linear_and_finite(eq, case)
    for a in case.inputs.values():
        for b in a if isinstance(a, list) else [a]:
            if isinstance(b, np.ndarray) and b.dtype.kind == "f":
                assert np.array_equal(b, b.astype(np.float32).astype(float))
