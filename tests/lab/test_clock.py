"""Times on a busy machine: a clock that the tests turn by hand stands for the real ones."""

import numpy as np
import pytest

from p4dgs_ref.lab import clock
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.watch import equation_codes, watch_calls


class BusyMachine:
    """Both clocks of a machine that other programs use.

    Every piece of work takes the processor up to `slower` times as long as alone. Around it, the
    wall clock runs on for up to `waiting` times as long.
    """

    def __init__(self, slower, waiting, seed=0):
        self.slower, self.waiting, self.rng = slower, waiting, np.random.default_rng(seed)
        self.now = np.zeros(2)

    def work(self, seconds):
        taken = seconds * self.rng.uniform(1, self.slower)
        self.now += taken * np.array([1, self.rng.uniform(1, self.waiting)])

    def clocks(self):
        return self.now.copy()


@pytest.fixture
def machine(monkeypatch):
    """A function that replaces the clocks by those of a BusyMachine, which it returns."""

    def replace(slower=1.0, waiting=1.0, seed=0):
        busy = BusyMachine(slower, waiting, seed)
        monkeypatch.setattr(clock, "clocks", busy.clocks)
        return busy

    return replace


def times(busy, **seconds):
    """What `alternate` measures of functions that take these seconds alone."""
    return clock.alternate({name: lambda s=s: busy.work(s) for name, s in seconds.items()}, 5)


def test_turns_alternate_and_every_function_is_called():
    calls = []
    taken = clock.alternate({name: lambda name=name: calls.append(name) for name in "ab"}, 3)
    assert set(taken) == {"a", "b"}
    assert all(0 < t.ms_low <= t.ms <= t.ms_high < 50 for t in taken.values())
    assert calls == list("ab") * (1 + 5 * 3)  # to warm up, then the most turns


def test_waiting_for_other_programs_is_no_time(machine):
    rows = times(machine(waiting=50), a=0.01, b=0.02)
    assert np.isclose(rows["a"].ms, 10) and np.isclose(rows["b"].ms, 20)
    assert rows["a"].stretch > 5
    assert "Disturbed: the wall clock ran" in clock.disturbance(rows["a"].stretch)
    quiet = times(machine(), a=0.01)
    assert quiet["a"].stretch == 1 and clock.disturbance(1.0) == ""
    assert clock.disturbance(clock.MAX_STRETCH) == "" != clock.disturbance(clock.MAX_STRETCH + 0.01)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("slower", [1, 2])
def test_the_slower_function_is_never_called_the_faster_one(machine, seed, slower):
    rows = times(machine(slower, 9, seed), literal=0.010, stable=0.013)
    told = clock.differ(rows["stable"], rows["literal"])
    assert rows["stable"].ms > rows["literal"].ms if told else slower > 1


def test_a_spread_larger_than_the_difference_is_no_reading(machine):
    rows = times(machine(slower=4, seed=3), one=0.010, other=0.011)
    assert not clock.differ(rows["one"], rows["other"])
    rows = times(machine(), one=0.010, other=0.011)
    assert clock.differ(rows["one"], rows["other"])


def test_quartiles_that_overlap_tell_nothing():
    one, other = clock.Times(10, 7, 10.1, 1), clock.Times(6.5, 6.4, 9.4, 1)
    assert not clock.differ(one, other) and not clock.differ(other, one)
    assert clock.differ(one, other._replace(ms_high=6.9))


def test_a_timed_step_is_the_second_of_its_stage():
    scene, codes = load_scene("static", downscale=8), equation_codes()
    step, seen = clock.step_at(scene, SMOKE, 4), []
    with watch_calls(codes, lambda event, mark, frame, value: seen.append(mark[0])):
        step()
        once = len(seen)
        step()
    assert len(seen) == 2 * once and "likelihood" in seen
