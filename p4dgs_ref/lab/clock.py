"""Processor times measured in turns, their spread, and what may be concluded from them.

The processor's clock of a process stands still while other programs run. They still share caches
and frequency with it, so a time is given with its quartiles, and if the wall clock runs clearly
ahead of the processor's, the measurement was disturbed.
"""

import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..training.trainer import Trainer

ROUND_SECONDS = 0.3  # shorter rounds are repeated more often: other programs disturb them more
MAX_STRETCH = 1.1  # seconds of the wall clock over those of the processor, if undisturbed


def clocks():
    """Return the seconds of the processor and of the wall clock [2]."""
    return np.array([time.process_time(), time.perf_counter()])


def call_with_clocks(function):
    """Return the result of a function, and the seconds [2] that it took on both clocks."""
    start = clocks()
    result = function()
    return result, clocks() - start


class Times(NamedTuple):
    """Milliseconds of processor time over several turns, and the wall clock's ratio to them."""

    ms: float  # the median
    ms_low: float  # the first quartile
    ms_high: float  # the third quartile
    stretch: float  # wall clock over processor


def times_of(turns):
    """Return the Times of turns [n, 2], in seconds of both clocks."""
    processor, wall = 1e3 * np.array(turns).T
    low, median, high = np.percentile(processor, (25, 50, 75))
    return Times(float(median), float(low), float(high), float(wall.sum() / processor.sum()))


def alternate(functions, repeats):
    """Return the Times of one call of each function, {name: Times}.

    After a call of each to warm up, the functions take turns, so that a disturbance affects all of
    them. `repeats` is the smallest number of turns; short rounds take up to five times as many.
    """
    spent = sum(call_with_clocks(function)[1][0] for function in functions.values())
    turns = {name: [] for name in functions}
    for _ in range(round(repeats * np.clip(ROUND_SECONDS / spent, 1, 5))):
        for name, function in functions.items():
            turns[name].append(call_with_clocks(function)[1])
    return {name: times_of(seconds) for name, seconds in turns.items()}


def differ(one, other):
    """Return whether two Times differ by more than the wider of their interquartile ranges.

    These ranges must not overlap either.
    """
    spread = max(times.ms_high - times.ms_low for times in (one, other))
    overlap = max(one.ms_low, other.ms_low) <= min(one.ms_high, other.ms_high)
    return abs(one.ms - other.ms) > spread and not overlap


def disturbance(stretch):
    """Return a sentence if other programs disturbed the measurement, else nothing."""
    if stretch <= MAX_STRETCH:
        return ""
    return (
        f"Disturbed: the wall clock ran {stretch:.2g} times as fast as the processor's, so "
        "other programs ran in between. Processor times leave these out, but not what they do "
        "to caches and clock frequency."
    )


def step_at(scene, preset, stage):
    """Return a function that repeats the second step of a stage.

    The first step, which is done here, may do work that a stage does only once.
    """
    # The anchors stay as they are.
    trainer = Trainer(scene, replace(preset, grow_every=10**9))
    trainer.iteration, end = (0, *preset.stage_ends)[stage - 1 : stage + 1]
    second = min(trainer.iteration + 1, end - 1)
    trainer.step()

    def step():
        trainer.iteration = second
        trainer.step()

    return step
