"""Of long lists of cases, each lane runs a sample, and of long trainings a day has its turn.

The sample is another one every day. `P4DGS_TEST_SEED=20260131 pytest` repeats that of a day, and
`P4DGS_TEST_WHOLE=1 pytest -m slow` runs all that the short lane leaves out.
"""

import os
import random
from datetime import date

import pytest

SEED = os.environ.get("P4DGS_TEST_SEED") or f"{date.today():%Y%m%d}"
WHOLE = os.environ.get("P4DGS_TEST_WHOLE") == "1"
# Of each group of trainings that take a minute, a day has one.
TURNS = (
    ("a row of a record", "a row of accuracy", "a file of other lambda"),
    ("thin rods", "a smooth orbit", "static scene", "motion"),
    ("quality of 00", "designs of 00"),
)


def of_the_day(values):
    """A list with one of the values, drawn by the seed: the others have other days."""
    values = [*values]
    return values if WHOLE else [random.Random(SEED).choice(values)]


def turn(name):
    """A mark of a test that takes turns with the others of its group in TURNS."""
    group = next(group for group in TURNS if name in group)
    drawn = random.Random(SEED).choice(group)
    return pytest.mark.skipif(
        drawn != name and not WHOLE, reason=f"today it is the turn of {drawn}"
    )


def few(values, count, more=None):
    """The values for `parametrize`: `count` of them drawn by the seed; the others are slow tests.

    With `more`, only so many of the others. A tuple gives several arguments. The order is the same
    for every seed.
    """
    values = [value if type(value) is tuple else (value,) for value in values]
    rng = random.Random(f"{SEED}: {count} of {len(values)}")
    order = rng.sample(range(len(values)), len(values))
    short, left_out = order[:count], [] if WHOLE or more is None else order[count + more :]
    return [
        pytest.param(*value, marks=() if i in short else pytest.mark.slow)
        for i, value in enumerate(values)
        if i not in left_out
    ]
