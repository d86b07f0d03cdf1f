"""The doctor: what it says of every known mistake, of mistakes in one direction, and of others."""

import numpy as np
import pytest

from p4dgs_ref.oracle import checker, doctor, published
from p4dgs_ref.oracle.compare import expected

MISTAKES = [mistake for key in published.subjects() for mistake in doctor.known(key)]
# One of eight in the short lane, all in the long one.
EVERY = pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(mistake, id=mistake.id, marks=[pytest.mark.slow] if i % 8 else [])
        for i, mistake in enumerate(MISTAKES)
    ],
)
HIDDEN = 9  # mistakes whose gradients alone are explained better by another mistake


class Patient:
    """A port with a known mistake, perhaps in outputs or gradients alone, perhaps in float32."""

    def __init__(self, mistake, roles=("out.", "in_bar."), dtype=np.float64):
        self.mistake, self.roles, self.dtype = mistake, roles, dtype

    def run(self, case):
        wrong = self.mistake.answers.get(case.name, {})
        got = {}
        for name, a in expected(case.tensors).items():
            a = wrong.get(name, a) if name.startswith(self.roles) else a
            with np.errstate(all="ignore"):
                got[name] = a.astype(self.dtype) if a.dtype.kind == "f" else a
        return got


def diagnosis(patient):
    """The results of a port with a known mistake, and what was said about them."""
    results = checker.check_subject(published.cases(patient.mistake.subject), patient)
    wrong = [r for r in results if r.verdict == "fail"]
    return wrong, {r.explanation for r in wrong}


@EVERY
def test_a_known_mistake_is_noticed_and_explained(mistake):
    wrong, said = diagnosis(Patient(mistake))
    assert wrong and {r.equation for r in wrong} == {mistake.equation}
    (said,) = said
    assert f"{mistake.description} [{mistake.id}]" in said and "explains" not in said


@EVERY
def test_it_is_explained_in_float32(mistake):
    wrong, said = diagnosis(Patient(mistake, dtype=np.float32))
    assert not wrong or f"[{mistake.id}]" in said.pop()


@pytest.mark.slow
@pytest.mark.parametrize("role, least", [("out.", 196), ("in_bar.", 216)])
def test_in_one_direction_alone(role, least):
    """Nearly all mistakes are explained where the other direction is right."""
    explained = noticed = 0
    for mistake in MISTAKES:
        wrong, said = diagnosis(Patient(mistake, (role,)))
        noticed += bool(wrong)
        explained += any(f"[{mistake.id}]" in text for text in said)
    assert explained >= least and explained >= noticed - HIDDEN


def test_two_mistakes_one_in_each_direction():
    """Outputs are explained before gradients."""
    by_id = {mistake.id: mistake for mistake in MISTAKES}
    outputs, gradients = (
        Patient(by_id["likelihood-nats"]),
        Patient(by_id["likelihood-mean-gradient"]),
    )
    answers = []
    for case in published.cases("likelihood"):
        got = {n: a for n, a in outputs.run(case).items() if n.startswith("out.")}
        got |= {n: a for n, a in gradients.run(case).items() if n.startswith("in_bar.")}
        wrong = [n for n, a in expected(case.tensors).items() if not np.array_equal(a, got[n])]
        answers.append((case, got, wrong))
    found, part = doctor.diagnose("likelihood", answers)
    assert [mistake.id for mistake, _, _ in found] == ["likelihood-nats"] and part == "outputs"


def test_an_unknown_mistake_is_not_explained():
    class Stranger:
        def run(self, case):
            return {n: a * 1.7 if a.dtype.kind == "f" else a for n, a in case.tensors.items()}

    results = checker.check_subject(published.cases("offsets"), Stranger())
    assert any(r.wrong for r in results) and not any(r.explanation for r in results)


def test_the_data_are_small_together():
    """Vectors and answers as they are installed."""
    folders = (published.FOLDER, doctor.FOLDER)
    sizes = [file.stat().st_size for folder in folders for file in folder.iterdir()]
    assert sum(sizes) < 5_500_000
