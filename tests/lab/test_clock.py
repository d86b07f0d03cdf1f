"""Times on a busy machine: a clock that the tests turn by hand stands for the real ones."""

import numpy as np
import pytest

from p4dgs_ref.lab import clock


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


def columns(busy, **seconds):
    """What `alternate` measures of functions that take these seconds alone."""
    functions = {name: lambda s=s: busy.work(s) for name, s in seconds.items()}
    return {name: times.columns() for name, times in clock.alternate(functions, 5).items()}


def test_turns_alternate_and_every_function_is_called():
    calls = []
    times = clock.alternate({name: lambda name=name: calls.append(name) for name in "ab"}, 3)
    assert set(times) == {"a", "b"}
    assert all(0 < taken.low <= taken.median <= taken.high < 50 for taken in times.values())
    assert calls == list("ab") * (1 + 5 * 3)  # to warm up, then the most turns


def test_waiting_for_other_programs_is_no_time(machine):
    rows = columns(machine(waiting=50), a=0.01, b=0.02)
    assert np.isclose(rows["a"]["ms"], 10) and np.isclose(rows["b"]["ms"], 20)
    assert rows["a"]["stretch"] > 5
    assert "Disturbed: the wall clock ran" in clock.disturbance(clock.stretch_of(rows.values()))
    quiet = columns(machine(), a=0.01)
    assert quiet["a"]["stretch"] == 1 and clock.disturbance(1.0) == ""
    assert clock.disturbance(clock.MAX_STRETCH) == "" != clock.disturbance(clock.MAX_STRETCH + 0.01)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("slower", [1, 1.2, 2, 5])
def test_the_slower_function_is_never_called_the_faster_one(machine, seed, slower):
    rows = columns(machine(slower, 9, seed), literal=0.010, stable=0.013)
    told = clock.can_tell(rows["stable"], rows["literal"])
    assert rows["stable"]["ms"] > rows["literal"]["ms"] if told else slower > 1


def test_a_spread_larger_than_the_difference_is_no_reading(machine):
    rows = columns(machine(slower=4, seed=3), one=0.010, other=0.011)
    assert not clock.can_tell(rows["one"], rows["other"])
    rows = columns(machine(), one=0.010, other=0.011)
    assert clock.can_tell(rows["one"], rows["other"])


def test_quartiles_that_overlap_tell_nothing():
    one, other = dict(ms=10, ms_low=7, ms_high=10.1), dict(ms=6.5, ms_low=6.4, ms_high=9.4)
    assert not clock.can_tell(one, other) and not clock.can_tell(other, one)
    assert clock.can_tell(one, other | dict(ms_high=6.9))
