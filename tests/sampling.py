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
# Of each group of trainings that take about a minute, a day has one: those that make again what is
# stored, and those that reach what is promised. The demo's file is made again every day.
TURNS = (
    ("a row of a record", "a row of accuracy", "another lambda", "00", "the designs of 00"),
    ("quality", "quality", "thin rods", "a smooth orbit", "a static scene", "motion"),
)


def of_the_day(values):
    """A list with one of the values, drawn by the seed: the others have other days."""
    values = [*values]
    return values if WHOLE else [random.Random(SEED).choice(values)]


def turn(name):
    """A mark of a test that takes turns with the others of its group in TURNS."""
    group = next(group for group in TURNS if name in group)
    # By another seed than that of `of_the_day`, which may draw what this test trains.
    drawn = random.Random(f"turn of {SEED}").choice(group)
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
