"""How work is counted, and the machine that times depend on."""

import os
import platform
import sys

import numpy as np
import scipy

from ..bench import replaced

SPECIAL = ("exp", "expm1", "log", "log1p", "ndtr", "log_ndtr", "erfcx")


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
