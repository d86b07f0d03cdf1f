"""The known mistakes of ports, collected from their history.

Each is defined once, as a change of behaviour: what a port with that mistake returns in place of an
equation or a stage. From this definition `python -m tests.workshop.mistakes` computes the wrong
answers to the published cases, which `p4dgs_ref.oracle.doctor` compares with a port's.
"""

from tests.workshop.mistakes import (
    common,
    compositing,
    encoding,
    geometry,
    grid,
    kernel,
    losses,
    motion,
    prediction,
    rate,
    stages,
    training,
)
from tests.workshop.mistakes.kit import Mistake, NotApplicable

MISTAKES = [
    *prediction.MISTAKES,
    *motion.MISTAKES,
    *geometry.MISTAKES,
    *compositing.MISTAKES,
    *losses.MISTAKES,
    *grid.MISTAKES,
    *rate.MISTAKES,
    *stages.MISTAKES,
    *kernel.MISTAKES,
    *encoding.MISTAKES,
    *training.MISTAKES,
    *common.MISTAKES,
]

__all__ = ["MISTAKES", "Mistake", "NotApplicable"]
