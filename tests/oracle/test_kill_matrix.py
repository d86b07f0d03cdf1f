"""The tests of the tests: the committed kill matrix is true and what the project promises; its judge can say no."""

import random
from contextlib import nullcontext

import pytest

from p4dgs_ref.oracle.mistakes import MISTAKES
from tests.golden.equivalent import EQUIVALENT
from tests.golden.kill_matrix import (
    COLUMNS,
    MATRIX,
    Judge,
    committed,
    laboratory,
    mistake_row,
    mutation_row,
    rows,
    text,
)
from tests.golden.mutate import applied, mutations

SAMPLE = 100


@pytest.fixture(scope="module")
def judge():
    return Judge()


def of_kind(kind):
    return [row for row in committed() if row["kind"] == kind]


def share(found, column):
    return sum(row[column] == "yes" for row in found) / len(found)


# --- what the file says ------------------------------------------------------------------------------------------
def test_every_known_mistake_is_killed_and_named():
    found = of_kind("mistake")
    assert len(found) >= 50
    assert [row["id"] for row in found if (row["killed"], row["named"]) != ("yes", "yes")] == []
    assert share(found, "explained") >= 0.95


def test_mutations_are_killed_or_equivalent():
    found = of_kind("mutation")
    assert len(found) >= 300 and share(found, "killed") >= 0.98
    survivors = {row["id"]: row["note"] for row in found if row["killed"] == "no"}
    assert survivors == EQUIVALENT and all(EQUIVALENT.values())


def test_the_file_lists_the_code_as_it_is():
    now = [(m.id, m.equation, m.description) for m in [*MISTAKES, *mutations()]]
    assert [(row["id"], row["equation"], row["description"]) for row in committed()] == now
    assert len({name for name, _, _ in now}) == len(now) and tuple(committed()[0]) == COLUMNS


def test_the_readme_says_what_the_file_says():
    readme = (MATRIX.parents[2] / "README.md").read_text(encoding="utf-8")
    mutated, killed = (
        of_kind("mutation"),
        [row for row in of_kind("mutation") if row["killed"] == "yes"],
    )
    assert (
        f"knows {len(of_kind('mistake'))} mistakes" in readme
        and f"each of {len(mutated):,} one-token mutations" in readme
    )
    assert f"of the mutations {100 * len(killed) / len(mutated):.1f} % are noticed" in readme


# --- whether it is true ------------------------------------------------------------------------------------------
def test_known_mistakes_anew(judge):
    """Every fourth; `test_everything_anew` takes all."""
    chosen = list(zip(MISTAKES, of_kind("mistake"), strict=True))[::4]
    assert [mistake_row(judge, mistake) for mistake, _ in chosen] == [row for _, row in chosen]


def test_some_mutations_anew(judge):
    chosen = random.Random(4).sample(
        list(zip(mutations(), of_kind("mutation"), strict=True)), SAMPLE
    )
    assert [mutation_row(judge, mutation) for mutation, _ in chosen] == [row for _, row in chosen]


@pytest.mark.slow
def test_everything_anew(judge):
    assert text(rows(judge)) == MATRIX.read_text(encoding="utf-8")


# --- the judge ---------------------------------------------------------------------------------------------------
def test_our_own_code_passes(judge):
    with laboratory():
        assert [case.id for case in judge.cases if judge.wrong(case)] == []
    assert {case.level for case in judge.cases} >= {"L0", "L1", "L2", "L4"}


def test_a_change_that_changes_nothing_is_not_killed(judge):
    places = {
        ("p4dgs_ref.equations.offsets", "forward"),
        ("p4dgs_ref.equations.offsets", "backward"),
    }
    assert judge.verdict(nullcontext(), "offsets", places) == (False, False, None, [])


def test_a_mutation_is_put_back():
    by_name = {m.id: m for m in mutations()}
    for name in (
        "offsets:forward:add-sub:1",
        "prior:RAW_MIN:float:1",
        "likelihood:forward:add-sub:1",
    ):
        before = state(by_name[name])
        with applied(by_name[name]):
            assert state(by_name[name]) != before
        assert state(by_name[name]) == before


def state(mutation):
    """What a mutation touches: a function's code, or the constants of its module."""
    module = __import__(mutation.module, fromlist=["forward"])
    if mutation.is_function:
        return getattr(module, mutation.owner).__code__
    return {name: value for name, value in vars(module).items() if isinstance(value, (int, float))}


def test_code_that_never_ends_is_killed(judge, monkeypatch):
    monkeypatch.setattr("kill_matrix.PATIENCE", 0.05)
    monkeypatch.setattr(judge, "first_failure", lambda *_: [None for _ in iter(int, 1)])
    assert judge.verdict(nullcontext(), "offsets", set())[0]
