"""The known mistakes: a port with one of them is found, and told which one it has."""

import json

import pytest

from p4dgs_ref.oracle import checker, doctor, published
from tests.oracle.answers import Port
from tests.sampling import few
from tests.workshop.mistakes import MISTAKES
from tests.workshop.mistakes.__main__ import answers

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # mistakes divide by zero


def test_list():
    ids = [mistake.id for mistake in MISTAKES]
    assert len(set(ids)) == len(ids)
    descriptions = [(mistake.subject, mistake.description) for mistake in MISTAKES]
    assert len(set(descriptions)) == len(descriptions)


@pytest.mark.usefixtures("right_reference")
@pytest.mark.parametrize("mistake", few(MISTAKES, 16, 80), ids=lambda mistake: mistake.id)
def test_a_known_mistake_is_noticed_and_explained(mistake):
    """What its definition answers agrees with the doctor's data of this mistake alone.

    Another one may have the same gradients; then the report says so.
    """
    port = Port(lambda case, dtype: answers(mistake, case))
    results = checker.check_subject(published.cases(mistake.subject), port)
    wrong = [result for result in results if result.verdict == "fail"]
    assert wrong and {result.equation for result in wrong} == {mistake.equation}
    explanation = f"{mistake.description} [{mistake.id}]"
    for result in wrong:
        others = result.explanation.removeprefix(explanation)
        assert others != result.explanation and not result.hint
        assert not others or others.startswith(" or ") and others.endswith("the gradients alone)")


def test_the_data_of_the_doctor_are_of_these_mistakes():
    rows = json.loads((doctor.FOLDER / "mistakes.json").read_text(encoding="utf-8"))
    listed = [(row["id"], row["subject"], row["equation"], row["description"]) for row in rows]
    assert listed == [(m.id, m.subject, m.equation, m.description) for m in MISTAKES]
    assert [tuple(row.get("noisy", ())) for row in rows] == [m.noisy for m in MISTAKES]
    files = {f"{mistake.subject}.safetensors.gz" for mistake in MISTAKES}
    assert {file.name for file in doctor.FOLDER.iterdir()} == {*files, "mistakes.json"}
    assert sum(file.stat().st_size for file in doctor.FOLDER.iterdir()) < 1_450_000
