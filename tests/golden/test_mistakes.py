"""The known mistakes: told apart from each other, and the doctor's data are what they compute."""

import gzip
import json
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from p4dgs_ref.lab.baselines import ALL_EQUATIONS
from p4dgs_ref.oracle import doctor, published, safetensors
from p4dgs_ref.oracle.compare import expected
from tests.golden.mistakes import MISTAKES
from tests.golden.mistakes.__main__ import answers, files
from tests.golden.mistakes.place import in_place
from tests.golden.subjects import subjects
from tests.sampling import few

CLOSE = 1e-9  # of the largest number in an array
NOISE = 1e-16  # what is left of a sum that is exactly zero
# A few of them in the short lane, others every day; the slow lane has the rest.
EVERY = pytest.mark.parametrize("mistake", few(MISTAKES, 24), ids=lambda mistake: mistake.id)
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # mistakes divide by zero


def differ(a, b):
    """Whether two arrays differ by more than rounding. A NaN equals a NaN."""
    if a.shape != b.shape:
        return True
    a, b = a.astype(float), b.astype(float)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.where(same, 0, np.nan_to_num(np.abs(a - b), nan=np.inf))
    return bool((off > max(CLOSE * np.abs(b[np.isfinite(b)]).max(initial=0), NOISE)).any())


def difference(got, want):
    """The names of the tensors in which two answers differ."""
    names = {*got, *want}
    return sorted(n for n in names if n not in got or n not in want or differ(got[n], want[n]))


@cache
def told(mistake):
    """The mistake's answers to all published cases of its subject."""
    return [answers(mistake, case) for case in published.cases(mistake.subject)]


def test_list():
    ids = [mistake.id for mistake in MISTAKES]
    assert len(set(ids)) == len(ids)
    assert all(id == id.lower() and " " not in id and "_" not in id for id in ids)
    descriptions = [(mistake.equation, mistake.description) for mistake in MISTAKES]
    assert len(set(descriptions)) == len(descriptions)
    assert {mistake.subject for mistake in MISTAKES} >= set(ALL_EQUATIONS)
    for _, text in descriptions:
        assert "\n" not in text and len(text) <= 120
        assert text.endswith("...") or not text.endswith(".")


@EVERY
def test_in_the_place_of_the_right_function_it_shows(mistake):
    """Called through the package, the mistake answers what its definition says."""
    subject, right = subjects()[mistake.subject], []
    cases = published.cases(mistake.subject)
    for case in cases:
        right.append(subject.answer(case.inputs(), case.cotangents()))
    with in_place(mistake):
        wrong = [
            subjects()[mistake.subject].answer(case.inputs(), case.cotangents()) for case in cases
        ]
    noticed = 0
    for case, got, want, said in zip(cases, wrong, right, told(mistake)):
        if difference(said, expected(case.tensors)):
            assert not difference({n: said[n] for n in got}, got), case.name
            noticed += bool(difference(got, want))
        assert not difference(subject.answer(case.inputs(), case.cotangents()), want), case.name
    assert noticed, "no case notices it"


@pytest.mark.parametrize("key", few(sorted({mistake.subject for mistake in MISTAKES}), 5))
def test_mistakes_differ_from_each_other(key):
    right = [expected(case.tensors) for case in published.cases(key)]
    alike = []
    for one, other in combinations([m for m in MISTAKES if m.subject == key], 2):
        shown = [
            (a, b)
            for a, b, c in zip(told(one), told(other), right)
            if difference(a, c) or difference(b, c)
        ]
        if shown and not any(difference(a, b) for a, b in shown):
            alike.append((one.id, other.id))
    assert not alike


@pytest.mark.slow
def test_the_data_of_the_doctor_are_what_the_mistakes_compute():
    made = files()
    held = {file.name: file.read_bytes() for file in doctor.FOLDER.iterdir()}
    assert set(made) == set(held)
    assert json.loads(made.pop("mistakes.json")) == json.loads(held["mistakes.json"])
    for name, data in made.items():
        new, old = (safetensors.load(gzip.decompress(d)) for d in (data, held[name]))
        assert set(new) == set(old), name
        assert not difference(new, old), name


def test_the_data_are_small():
    assert sum(file.stat().st_size for file in doctor.FOLDER.iterdir()) < 1_300_000
