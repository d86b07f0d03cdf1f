"""Of some parametrised tests the short lane runs a sample, and the slow lane the others.

The sample is another one every day. `P4DGS_TEST_SEED=20260131 pytest` repeats that of a day.
"""

import os
import random
from datetime import date

import pytest

SEED = os.environ.get("P4DGS_TEST_SEED") or f"{date.today():%Y%m%d}"


def of_the_day(values):
    """A list with one of the values, drawn by the seed: the others have other days."""
    return [random.Random(SEED).choice([*values])]


def few(values, count):
    """The values for `parametrize`: `count` of them drawn by the seed; the others are slow tests.

    A tuple gives several arguments. Order and ids are the same for every seed.
    """
    values = [value if type(value) is tuple else (value,) for value in values]
    rng = random.Random(f"{SEED}: {count} of {len(values)}")
    short = rng.sample(range(len(values)), min(count, len(values)))
    return [
        pytest.param(*value, marks=() if i in short else pytest.mark.slow)
        for i, value in enumerate(values)
    ]
