"""Wrong trainings: of the 99 variants of a training step, ten are tried here.

`python -m tests.oracle.training_variants` tries all of them before a release.
"""

import pytest

from tests.oracle.training_variants import PASSING, noticed_by, rows

# Those that need a case of version 1.1, one of every kind.
TRIED = {
    "seen behind the camera": "training/apart",
    "gradient per visit": "training/apart",
    "draws above 1/2 always": "training/apart",
    "scales are clamped where nothing grows": "training/from",
    "new anchors do not occupy": "training/apart",
    "the last feature": "training/apart",
    ">= for > a window": "training/apart",
    "the rate of l for s": "training/apart",
    "grows on grow_from": "training/from",
    "grows on grow_until": "training/until",
}
VARIANTS = {says: change for says, *change in rows()}


@pytest.mark.slow
@pytest.mark.parametrize("says, id", TRIED.items())
def test_a_wrong_training_is_told_where_it_is_wrong(says, id):
    """By a number of the case, not by a shape that does not fit the next step."""
    found = noticed_by(*VARIANTS[says])
    assert found.startswith(f"{id} out."), f"{says}: {found or 'noticed by no case'}"


def test_of_the_99_variants_six_pass_each_with_its_reason():
    assert len(rows()) == len(VARIANTS) == 99
    assert len(PASSING) == 6 and PASSING.keys() <= VARIANTS.keys()
