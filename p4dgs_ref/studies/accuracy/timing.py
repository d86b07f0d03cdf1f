"""How time, work and growth are measured: alternating repeats, counted special functions, fitted exponents."""

import os
import platform
import sys
import time
from contextlib import contextmanager

import numpy as np
import scipy

from ..bench import alternate as take_turns

LEAST_MS = (
    2.0  # a function shorter than this is called several times a turn, so that the clock can see it
)
ROUND_MS = 300.0  # a round of turns shorter than this is repeated more often: other programs disturb it more
SPECIAL = ("exp", "expm1", "log", "log1p", "ndtr", "log_ndtr", "erfcx")


def alternate(functions, repeats):
    """Median milliseconds of one call of each function, called in turn after one call to warm up: {name: ms}.

    Takes      {name: function without arguments}, how many turns at least: short ones are repeated up to five times as often
    """
    calls, spent = {}, 0.0
    for name, function in functions.items():
        function()
        start = time.perf_counter()
        function()
        ms = 1e3 * (time.perf_counter() - start)
        calls[name] = max(1, int(LEAST_MS / max(ms, 1e-3)))
        spent += max(ms, LEAST_MS)

    def several(function, count):
        def run():
            for _ in range(count):
                function()

        return run

    turns = repeats * min(5, max(1, round(ROUND_MS / spent)))
    total = take_turns(
        {name: several(function, calls[name]) for name, function in functions.items()}, turns
    )
    return {name: ms / calls[name] for name, ms in total.items()}


@contextmanager
def replaced(owner, **members):
    """The members of a module or class are others within it, and what they were afterwards."""
    kept = {name: getattr(owner, name) for name in members}
    try:
        for name, member in members.items():
            setattr(owner, name, member)
        yield
    finally:
        for name, member in kept.items():
            setattr(owner, name, member)


class Counting:
    """Stands for the module `np` and counts the elements that go through its special functions."""

    def __init__(self):
        self.elements = 0

    def __getattr__(self, name):
        return self.counted(getattr(np, name)) if name in SPECIAL else getattr(np, name)

    def counted(self, function):
        def run(*args, **kwargs):
            self.elements += np.size(args[0])
            return function(*args, **kwargs)

        return run


def special_calls(module, function):
    """How many special function values a call of `function` computes in `module`: the work that no machine changes."""
    counting = Counting()
    names = {
        name: counting.counted(getattr(module, name)) for name in SPECIAL if hasattr(module, name)
    }
    with replaced(module, np=counting, **names):
        function()
    return counting.elements


def exponents(sizes, values):
    """The b of value = e^a size_0^b_0 size_1^b_1 ... by least squares on logarithms, as [a, b_0, b_1, ...].

    Shapes     sizes (n, D) positive, values (n,) positive -> (D + 1,)
    """
    logs = np.log(np.asarray(sizes, float))
    return np.linalg.lstsq(np.column_stack([np.ones(len(logs)), logs]), np.log(values), rcond=None)[
        0
    ]


def processor():
    """The processor's name, as the system gives it."""
    try:
        with open(os.path.join(os.sep, "proc", "cpuinfo"), encoding="utf-8") as file:
            return next(
                line.split(":", 1)[1].strip() for line in file if line.startswith("model name")
            )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine():
    """What the times depend on: {name: text}."""
    config = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    threads = (
        os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or "not set"
    )
    return {
        "CPU": processor(),
        "cores": str(os.cpu_count()),
        "Python": sys.version.split()[0],
        "NumPy": np.__version__,
        "SciPy": scipy.__version__,
        "BLAS": f"{config.get('name', 'unknown')} {config.get('version', '')}".strip(),
        "BLAS threads": threads,
    }
