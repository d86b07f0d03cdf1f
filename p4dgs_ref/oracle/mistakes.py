"""The known mistakes of ports, collected from their history: the doctor tries them on numbers that are wrong."""

from . import (
    mistakes_compositing,
    mistakes_geometry,
    mistakes_grid,
    mistakes_losses,
    mistakes_motion,
    mistakes_prediction,
    mistakes_rate,
    mistakes_stages,
)
from .mistakes_kit import Mistake, NotApplicable

MISTAKES = [
    *mistakes_prediction.MISTAKES,
    *mistakes_motion.MISTAKES,
    *mistakes_geometry.MISTAKES,
    *mistakes_compositing.MISTAKES,
    *mistakes_losses.MISTAKES,
    *mistakes_grid.MISTAKES,
    *mistakes_rate.MISTAKES,
    *mistakes_stages.MISTAKES,
]

__all__ = ["MISTAKES", "Mistake", "NotApplicable"]
