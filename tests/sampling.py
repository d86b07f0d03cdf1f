"""Of long lists of cases the short lane runs a sample; of long trainings the slow lane runs one.

What is short and what is slow never changes. `P4DGS_TEST_SEED=20260131 pytest -m slow` draws what
takes turns in the slow lane, and `P4DGS_TEST_WHOLE=1 pytest -m slow` runs all that the short lane
leaves out.
"""

import os
import random

import pytest

SEED = os.environ.get("P4DGS_TEST_SEED", "0")
WHOLE = os.environ.get("P4DGS_TEST_WHOLE") == "1"
# Of each group of trainings that take about a minute, a seed has one: those that make again what is
# stored, and those that reach what is promised. The demo's file is made again for every seed.
TURNS = (
    ("a row of a record", "another lambda", "00", "the designs of 00"),
    ("quality", "quality", "thin rods", "a smooth orbit", "a static scene", "motion"),
)


def of_the_day(values):
    """Return a list with one of the values of a slow test, drawn by the seed."""
    values = [*values]
    return values if WHOLE else [random.Random(SEED).choice(values)]


def turn(name):
    """Return the mark of a slow test that takes turns with the others of its group in TURNS."""
    group = next(group for group in TURNS if name in group)
    # By another seed than that of `of_the_day`, which may draw what this test trains.
    drawn = random.Random(f"turn of {SEED}").choice(group)
    return pytest.mark.skipif(
        drawn != name and not WHOLE, reason=f"P4DGS_TEST_SEED={SEED} draws {drawn}"
    )


def few(values, count, more=None):
    """Return the values for `parametrize`: `count` of them are short tests, the others slow ones.

    With `more`, the seed draws so many of the slow ones. A tuple gives several arguments.
    """
    values = [value if type(value) is tuple else (value,) for value in values]
    order = random.Random(f"{count} of {len(values)}").sample(range(len(values)), len(values))
    short, slow = order[:count], order[count:]
    if more is not None and more < len(slow) and not WHOLE:
        slow = random.Random(SEED).sample(slow, more)
    # Short ones first: what is drawn after them does not change the numbers in their ids.
    return [
        *(pytest.param(*values[i]) for i in sorted(short)),
        *(pytest.param(*values[i], marks=pytest.mark.slow) for i in sorted(slow)),
    ]
