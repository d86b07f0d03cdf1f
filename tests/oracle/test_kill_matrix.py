"""The committed kill matrix is true and what the project promises, and its judge can say no."""

import random

import pytest

from p4dgs_ref.oracle import published
from tests.sampling import SEED, WHOLE
from tests.workshop import kill_matrix
from tests.workshop.equivalent import EQUIVALENT
from tests.workshop.kill_matrix import committed, is_killed, laboratory
from tests.workshop.mutate import mutations

DRAW = random.Random(SEED)


# --- what the file says -------------------------------------------------------------------------
def test_mutations_are_killed_or_equivalent():
    counts = committed()
    names = [mutation.id for mutation in mutations()]
    assert len(set(names)) == len(names)
    assert len(names) == counts["total"], "`python -m tests.workshop.kill_matrix` counts them anew"
    assert counts["killed"] >= 0.98 * counts["total"]
    assert counts["killed"] + len(counts["survivors"]) == counts["total"]
    reasons = {survivor["id"]: survivor["reason"] for survivor in counts["survivors"]}
    assert reasons == EQUIVALENT and all(EQUIVALENT.values())


# --- whether it is true -------------------------------------------------------------------------
@pytest.mark.usefixtures("right_reference")
@pytest.mark.parametrize("share", [0.02, pytest.param(1 if WHOLE else 0.3, marks=pytest.mark.slow)])
def test_some_mutations_again(judge, hasty, share):
    survivors = {survivor["id"] for survivor in committed()["survivors"]}
    for mutation in DRAW.sample(mutations(), int(share * len(mutations()))):
        assert is_killed(judge, mutation) == (mutation.id not in survivors), mutation.id


# --- the judge ----------------------------------------------------------------------------------
@pytest.mark.usefixtures("right_reference")
def test_a_change_that_changes_nothing_is_not_killed(judge):
    with laboratory():
        assert judge.first_failure("offsets", {("p4dgs_ref.equations.offsets", None)}) is None
        assert all(not wrong for _, _, wrong in judge.answers("offsets"))
    assert len(judge.answers("offsets")) == len(published.cases("offsets"))


def test_code_that_never_ends_is_killed(judge, monkeypatch):
    def forever(*_):
        while True:
            pass

    monkeypatch.setattr(kill_matrix, "PATIENCE", 0.05)
    monkeypatch.setattr(judge, "first_failure", forever)
    assert is_killed(judge, mutations()[0])
