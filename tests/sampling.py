"""Of some parametrised tests the short lane runs a few, and the slow lane the others."""

import pytest


def few(values, count):
    """The values for `parametrize`: `count` of them, evenly spread; the others are slow tests.

    A tuple gives several arguments.
    """
    values = [value if isinstance(value, tuple) else (value,) for value in values]
    short = {i * len(values) // count for i in range(count)}
    return [
        pytest.param(*value, marks=() if i in short else pytest.mark.slow)
        for i, value in enumerate(values)
    ]
