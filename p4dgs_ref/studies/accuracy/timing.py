"""How times, work and growth are measured."""

import os
import platform
import sys

import numpy as np
import scipy

from ..bench import alternate as take_turns
from ..bench import replaced
from ..evaluate import timed

LEAST_MS = 2.0  # a shorter function is called several times per turn, for the sake of the clock
ROUND_MS = 300.0  # shorter rounds are repeated more often: other programs disturb them more
SPECIAL = ("exp", "expm1", "log", "log1p", "ndtr", "log_ndtr", "erfcx")


def alternate(functions, repeats):
    """Median milliseconds of one call of each function, {name: ms}.

    The functions are called in turn, after one call to warm up. `repeats` is the smallest number
    of turns; short rounds take up to five times as many.
    """
    calls, spent = {}, 0.0
    for name, function in functions.items():
        function()
        ms = 1e3 * timed(function)[1]
        calls[name] = max(1, int(LEAST_MS / max(ms, 1e-3)))
        spent += max(ms, LEAST_MS)
    turns = repeats * min(5, max(1, round(ROUND_MS / spent)))
    return take_turns(functions, turns, calls)


class Counting:
    """Stands for the module `np` and counts the elements that its special functions compute."""

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
    """How many values of special functions `function` computes in `module`.

    Unlike the time, this work is the same on every machine.
    """
    counting = Counting()
    counted = {
        name: counting.counted(getattr(module, name)) for name in SPECIAL if hasattr(module, name)
    }
    with replaced(module, np=counting, **counted):
        function()
    return counting.elements


def exponents(sizes, values):
    """[a, b_0, b_1, ...] of value = e^a size_0^b_0 size_1^b_1 ..., fitted to logarithms.

    `sizes` is (n, D), `values` is (n,), all positive.
    """
    logs = np.log(np.asarray(sizes, float))
    columns = np.column_stack([np.ones(len(logs)), logs])
    return np.linalg.lstsq(columns, np.log(values), rcond=None)[0]


def processor():
    """The processor's name according to the operating system."""
    try:
        with open(os.path.join(os.sep, "proc", "cpuinfo"), encoding="utf-8") as file:
            names = (line.split(":", 1)[1] for line in file if line.startswith("model name"))
            return next(names).strip()
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine():
    """The parts of the machine that times depend on, {name: text}."""
    config = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    threads = os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS")
    return {
        "CPU": processor(),
        "cores": str(os.cpu_count()),
        "Python": sys.version.split()[0],
        "NumPy": np.__version__,
        "SciPy": scipy.__version__,
        "BLAS": f"{config.get('name', 'unknown')} {config.get('version', '')}".strip(),
        "BLAS threads": threads or "not set",
    }
