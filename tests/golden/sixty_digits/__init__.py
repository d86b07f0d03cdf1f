"""Every equation once more, in decimal arithmetic: what the NumPy reference is judged by, and where hard cases get their digits.

Nothing here calls the equations or their backwards: values come from the printed formulas on `decimal` numbers, gradients
from difference quotients of those values.  60 digits of a value and 50 of a gradient may be trusted.
`python -m p4dgs_ref.sixty_digits.record` measures the reference against it.
"""

from .errors import error
from .floats import text, to_float
from .functions import DIGITS
from .gradients import GRADIENT_DIGITS, gradient, value

__all__ = ["DIGITS", "GRADIENT_DIGITS", "error", "gradient", "text", "to_float", "value"]
