"""Every equation in decimal arithmetic: the judge of the NumPy code, and the source of true values.

Nothing here calls the equations or their backwards. Values come from the printed formulas on
`decimal` numbers, gradients from difference quotients of these values. 60 digits of a value and 50
digits of a gradient may be trusted. `python -m tests.workshop.sixty_digits.record` measures the
NumPy equations against them.
"""

from .floats import text, to_float
from .gradients import gradient, value

__all__ = ["gradient", "text", "to_float", "value"]
