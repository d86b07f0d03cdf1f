"""Arrays in another floating-point precision."""

import numpy as np


def change_floats(values, change):
    """Apply `change` to every float array of {name: array, list of arrays or setting}."""

    def visit(value):
        if isinstance(value, list):
            return [visit(b) for b in value]
        is_array = isinstance(value, (np.ndarray, np.generic))
        return change(value) if is_array and value.dtype.kind == "f" else value

    return {name: visit(value) for name, value in values.items()}


def cast(values, dtype):
    """The same values with every float array in another precision."""
    return change_floats(values, lambda a: np.asarray(a, dtype))
