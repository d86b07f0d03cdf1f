"""Processor times taken in turns, their spread, and what may be said about them.

The processor's clock of a process stands still while other programs run. They still share caches
and frequency with it, so a time is given with its quartiles, and where the wall clock runs clearly
ahead of the processor's, the measurement was disturbed.
"""

import time
from typing import NamedTuple

import numpy as np

ROUND_SECONDS = 0.3  # shorter rounds are repeated more often: other programs disturb them more
MAX_STRETCH = 1.1  # the wall clock's seconds over the processor's, where nothing disturbs


def clocks():
    """Seconds of the processor and of the wall clock [2]."""
    return np.array([time.process_time(), time.perf_counter()])


def clocked(function, *args, **kwargs):
    """The result of a function, and the seconds [2] that it took on both clocks."""
    start = clocks()
    result = function(*args, **kwargs)
    return result, clocks() - start


class Times(NamedTuple):
    """Milliseconds of processor time over several turns, and the wall clock's ratio to them."""

    median: float
    low: float  # the first quartile
    high: float  # the third quartile
    stretch: float  # wall clock over processor

    def columns(self, unit="ms", factor=1.0):
        """The columns of a table: {unit, unit_low, unit_high, stretch}."""
        median, low, high = (factor * ms for ms in self[:3])
        return {unit: median, f"{unit}_low": low, f"{unit}_high": high, "stretch": self.stretch}


def times_of(turns):
    """The Times of turns [n, 2], in seconds of both clocks."""
    processor, wall = 1e3 * np.array(turns).T
    low, median, high = np.percentile(processor, (25, 50, 75))
    return Times(float(median), float(low), float(high), float(wall.sum() / processor.sum()))


def alternate(functions, repeats, clocked=clocked):
    """The Times of one call of each function, {name: Times}.

    The functions are called in turn, so that a disturbance meets all of them, after one call to
    warm up. `repeats` is the smallest number of turns; short rounds take up to five times as many.
    A function may run in another process, which `clocked` then asks for its result and its seconds.
    """
    spent = sum(clocked(function)[1][0] for function in functions.values())
    turns = {name: [] for name in functions}
    for _ in range(round(repeats * np.clip(ROUND_SECONDS / spent, 1, 5))):
        for name, function in functions.items():
            turns[name].append(clocked(function)[1])
    return {name: times_of(seconds) for name, seconds in turns.items()}


# --- what may be said ----------------------------------------------------------------------------
def can_tell(row, other, unit="ms"):
    """Whether two times differ: by more than the wider of their ranges from quartile to quartile.

    These ranges must not overlap either.
    """
    lows, highs = ([r[f"{unit}_{end}"] for r in (row, other)] for end in ("low", "high"))
    spread = max(high - low for low, high in zip(lows, highs))
    return abs(row[unit] - other[unit]) > spread and max(lows) > min(highs)


def stretch_of(rows):
    """The ratio of the wall clock to the processor's in the middle of some measurements."""
    return float(np.median([row["stretch"] for row in rows]))


def disturbance(stretch):
    """A sentence where other programs disturbed the measurement, else nothing."""
    if stretch <= MAX_STRETCH:
        return ""
    return (
        f"Disturbed: the wall clock ran {stretch:.2g} times as fast as the processor's, so "
        "other programs took turns with the measurement. Processor times leave out their turns, "
        "but not what they do to caches and frequency."
    )
