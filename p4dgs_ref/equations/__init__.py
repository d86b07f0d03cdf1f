"""The paper, one module for every equation."""

from ..table import EQUATIONS
from .equation import FLAGS, Case, Equation, declare

__all__ = ["EQUATIONS", "FLAGS", "Case", "Equation", "declare"]
