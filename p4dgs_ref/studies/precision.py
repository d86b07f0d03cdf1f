"""Arrays in another floating-point precision."""

import numpy as np


def cast(values, dtype):
    """{name: array or list of arrays}: float arrays in `dtype`, everything else as it is."""
    return {name: _cast(a, dtype) for name, a in values.items()}


def _cast(a, dtype):
    if isinstance(a, list):
        return [_cast(b, dtype) for b in a]
    is_float = isinstance(a, (np.ndarray, np.generic)) and a.dtype.kind == "f"
    return np.asarray(a, dtype) if is_float else a
