"""The Design and the Model of the coded design, which have more than the paper's."""

from dataclasses import dataclass

import numpy as np

from .. import model


@dataclass(frozen=True)
class Design(model.Design):
    """The paper's Design, networks that pay for their bits (B1), positions of few bits (B2)."""

    position_bits: int = 16  # per axis


@dataclass(frozen=True, eq=False)
class Model(model.Model):
    """The paper's Model, and what its file of version 2 holds besides."""

    # Codes of the steps of all weights and biases, layer by layer (B1); None: the default ones
    steps: dict[str, tuple[np.ndarray, np.ndarray]] | None = None
