"""Times on a busy machine: a clock that the tests turn by hand stands for the real ones."""

import numpy as np
import pytest

from p4dgs_ref.lab import bench, clock
from p4dgs_ref.lab.accuracy import likelihood, size


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
    assert calls[:4] == list("aabb")  # to warm up and to estimate the time
    switches = sum(x != y for x, y in zip(calls[4:], calls[5:]))
    assert switches >= 2 * 3 - 1


def test_waiting_for_other_programs_is_no_time(machine):
    rows = columns(machine(waiting=50), a=0.01, b=0.02)
    assert np.isclose(rows["a"]["ms"], 10) and np.isclose(rows["b"]["ms"], 20)
    assert rows["a"]["stretch"] > 5
    assert "Disturbed: the wall clock ran" in clock.disturbance(clock.stretch_of(rows.values()))
    quiet = columns(machine(), a=0.01)
    assert quiet["a"]["stretch"] == 1 and clock.disturbance(1.0) == ""
    assert clock.disturbance(clock.DISTURBED) == "" != clock.disturbance(clock.DISTURBED + 0.01)


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("slower", [1, 1.2, 2, 5])
def test_the_slower_function_is_never_called_the_faster_one(machine, seed, slower):
    rows = columns(machine(slower, 9, seed), literal=0.010, stable=0.013)
    sentence = clock.compare("`stable`", rows["stable"], "`literal`", rows["literal"])
    assert "cannot tell" in sentence or "times as long." in sentence
    assert "% of the time" not in sentence and "that is 1 times" not in sentence
    if slower == 1:
        assert sentence.endswith("that is 1.3 times as long.")


def test_a_spread_larger_than_the_difference_is_no_reading(machine):
    rows = columns(machine(slower=4, seed=3), one=0.010, other=0.011)
    sentence = clock.compare("one", rows["one"], "the other", rows["other"])
    assert sentence.startswith("We cannot tell: one takes ") and sentence.endswith("difference.")
    assert not clock.can_tell(rows["one"], rows["other"])
    rows = columns(machine(), one=0.010, other=0.011)
    assert clock.compare("one", rows["one"], "two", rows["other"]) == (
        "One takes 10 ms (10 to 10) and two 11 ms (11 to 11); that is 91 % of the time."
    )


@pytest.mark.parametrize("ratio", [*np.linspace(0.5, 2, 301), 10.0, 1e3])
def test_no_ratio_is_one_times(ratio):
    words = clock.how_long(ratio)
    assert not words.startswith(("1 times", "100 %")), words


# --- the paper's scenes --------------------------------------------------------------------------
GOAL = {part: 1e6 for part in size.UNITS}
SIZES = ((100, 64), (50, 64), (200, 64), (100, 32), (100, 128))


def laws():
    """{part: nanoseconds per unit of work} of a machine that works for itself."""
    return {part: 10.0 * (i + 1) for i, part in enumerate(size.UNITS)}


def measured(busy, rounds=3):
    """Rows of all parts at all sizes, taken on a machine whose work follows the laws."""
    rows = []
    for A, side in SIZES:
        work = {part: 100.0 * A + side**2 for part in size.UNITS}
        steps = []
        for _ in range(rounds):
            taken = {}
            for part, ns in laws().items():
                _, taken[part] = clock.clocked(busy.work, 1e-9 * ns * work[part])
            steps.append(taken)
        for part, amount in work.items():
            times = clock.times_of([step[part] for step in steps])
            rows.append(
                {"part": part, "anchors": A, "work": amount, "mb": amount / 1e3, **times.columns()}
            )
    return rows


@pytest.mark.parametrize("seed", range(20))
def test_the_hours_at_the_papers_size_stay_within_what_the_machine_slows_down(machine, seed):
    slower = 3.0
    found = size.hours(measured(machine(slower, 20, seed)), GOAL)
    ends = {"deformation": 35_000, "rate": 30_000}
    for row in found:
        steps = ends.get(row["part"], 40_000)
        alone = laws()[row["part"]] * 1e-9 * GOAL[row["part"]] * steps / 3600
        assert alone <= row["hours"] * 1.0001 and row["hours"] <= slower * alone
        assert row["hours_low"] <= row["hours"] <= row["hours_high"]
        assert np.isclose(row["gb"], GOAL[row["part"]] / 1e6)
    assert sum(row["hours"] for row in found) < slower * 31


def test_hours_that_nobody_knows_are_not_printed(machine):
    rows = measured(machine(slower=100, waiting=3, seed=1), rounds=2)
    found = size.hours(rows, GOAL)
    for row in found:
        row["hours_high"] = 5 * row["hours"]
    about = [{"anchors": 100, "side": 64}]
    assert "we cannot tell how long training takes" in size.read(about, found)
    for row in found:
        row["hours_low"] = row["hours_high"] = row["hours"]
    assert "we cannot tell" not in size.read(about, found)


def test_a_study_on_a_busy_machine_says_so(machine, monkeypatch):
    """The whole way: steps of real trainers, timed by clocks of a disturbed machine."""
    busy = machine(slower=3, waiting=20)

    def ticking():
        busy.work(0.001)
        return busy.now.copy()

    monkeypatch.setattr(clock, "clocks", ticking)
    rows = size.measure([(20, 32), (60, 32)], 3, lambda line: None)
    assert clock.stretch_of(rows) > clock.DISTURBED
    parts = {row["part"] for row in rows}
    assert parts == {*bench.PARTS, "whole step"} == {*size.UNITS, "whole step"}
    found = size.hours(rows, {part: 2.0 * row["work"] for part, row in at_60(rows).items()})
    for row in found:
        largest = at_60(rows)[row["part"]]
        if row["part"] == "loss":  # does not grow with the anchors
            continue
        assert np.isclose(row["hours"], 2 * largest["ms"] * row["steps"] / 3.6e6)


def at_60(rows):
    return {row["part"]: row for row in rows if row["anchors"] == 60 and row["work"] != ""}


def test_likelihood_reading_compares_only_what_can_be_told(machine):
    row = {"special_per_value": 5.0, "bits_error": 1e-15, "reach": 3, "knob": "float64"}
    near = [
        {**row, "method": "stable", "ns": 20, "ns_low": 10, "ns_high": 40},
        {**row, "method": "literal", "ns": 25, "ns_low": 20, "ns_high": 60},
        {**row, "method": "stable", "knob": "float32", "reach": 1000},
    ]
    zeros = [np.zeros((2, 2))] * 2
    names = ("literal", "stable", "HAC, floor 1e-6", "tail-symmetric", "log domain")
    maps = {(name, "float64"): zeros for name in names}
    assert likelihood.read(near, maps).startswith("We cannot tell: `stable` takes 20 ns (10 to 40)")
