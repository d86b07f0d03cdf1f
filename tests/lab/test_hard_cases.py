"""The catalogue of hard cases: they are published vectors, and the package holds the rest."""

import json

import numpy as np
import pytest

from p4dgs_ref.lab.stability import FILE, hard_cases
from p4dgs_ref.oracle.published import cases, flatten
from p4dgs_ref.splatting.table import EQUATIONS
from tests.equations import rules
from tests.workshop import demo, sixty_digits
from tests.workshop.cases import FLAGS, cases_of
from tests.workshop.hard_cases import catalogue, publish

ENTRIES = catalogue.ENTRIES.values()


def test_the_package_holds_the_catalogue():
    """The file of the package is the one that `publish` writes.

    Other packages or kernels than the file was made with give literal formulas other last bits.
    """
    slack = 0 if demo.kept()["arithmetic"] == demo.with_what() else 1e-3
    stored, made = json.loads(FILE.read_text(encoding="utf-8")), json.loads(publish.text())
    for old, new in zip(stored, made, strict=True):
        literals = old.pop("literal"), new.pop("literal")
        assert old == new, new["id"]
        for a, b in zip(*literals, strict=True):
            assert a == b or float(a) == pytest.approx(float(b), rel=slack, abs=0), new["id"]


EXACT = [(case["id"], *row) for case in hard_cases().values() for row in case.get("exact", [])]


@pytest.mark.slow
@pytest.mark.parametrize("id, name, index, number", EXACT)
def test_gradients_in_the_table_are_true(id, name, index, number):
    """They stand for numbers that vectors have from this project's own code. null: not compared."""
    case, key = catalogue.ENTRIES[id].case, catalogue.ENTRIES[id].equation
    if number is not None:
        wanted = name.split(".")[1]
        gradients = sixty_digits.gradient(key, case.inputs, case.cotangents, wanted)
        assert number == float(flatten(gradients, "in_bar.")[name][tuple(index)])


def test_every_hard_case_is_published():
    published = {case.id for key in EQUATIONS for case in cases(key)}
    assert {f"{entry.equation}/{entry.id}" for entry in ENTRIES} <= published


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.id)
def test_hard_cases_are_cases(entry):
    """A hard case passes what the tests ask of an equation's own cases."""
    eq, case = EQUATIONS[entry.equation], entry.case
    assert case.flags and set(case.flags) <= set(FLAGS)
    assert case.name not in {other.name for other in cases_of(eq.key)}
    assert case in catalogue.cases(eq.key)
    rules.check_shapes(eq, case, *rules.specs_of(eq))
    rules.gradients_have_the_shapes_of_the_inputs(eq, case)
    rules.pure_and_repeatable(eq, case)
    rules.backward_is_linear_and_finite(eq, case)
    for a in case.inputs.values():
        for b in a if isinstance(a, list) else [a]:
            if isinstance(b, np.ndarray) and b.dtype.kind == "f":
                assert np.array_equal(b, b.astype(np.float32).astype(float))
