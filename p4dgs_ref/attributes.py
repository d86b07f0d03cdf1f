"""The attributes of an anchor, declared once: a row each, in the order in which they are coded.

All lists of attributes follow from this table: fields of `model.Anchors`, names and learning rates
of parameters, rows that density control moves, base steps, columns of the coder and sections of the
file. A new attribute needs a row here, its base step and learning rates in `training.presets`, an
id for its section in `codec.container`, its bits in Eq. (13), and a use in `model.predict`. Its
files are another format, which other readers refuse.
"""

from math import prod
from typing import NamedTuple


class Attribute(NamedTuple):
    """One attribute; all its numbers of an anchor share one step q (Q6)."""

    group: str  # the paper's letter; `Anchors` has the field "f_a" for "f"
    shape: tuple  # of an anchor's numbers; "d" and "k" are those of the Design
    is_log: bool  # whether its logarithm is trained (Q5)
    start: str  # its first value: "feature" (random), "spacing" (of the points) or "zero"
    section: str  # of the file
    base_step: str  # Q_0, a field of the preset
    learning_rate: str  # likewise
    label: str  # in plots

    @property
    def name(self):
        """The field of `model.Anchors`."""
        return f"{self.group}_a"

    @property
    def parameter(self):
        """The trained array."""
        return f"log_{self.group}" if self.is_log else self.name

    @property
    def per_child(self):
        """Whether every child has its own, which is not coded where the child is masked (Q15)."""
        return "k" in self.shape

    def sizes(self, design):
        """The shape in numbers."""
        return tuple(getattr(design, n) if isinstance(n, str) else n for n in self.shape)

    def width(self, design):
        """How many numbers an anchor has."""
        return prod(self.sizes(design))


ATTRIBUTES = (
    Attribute("f", ("d",), False, "feature", "features", "Q_f", "lr_f", "features f"),
    Attribute("s", (3,), True, "spacing", "scales", "Q_s", "lr_s", "scales s"),
    Attribute("l", (3,), True, "spacing", "offset_scales", "Q_l", "lr_l", "offset scales l"),
    Attribute("O", ("k", 3), False, "zero", "offsets", "Q_O", "lr_O", "offsets O"),
)
GROUPS = tuple(row.group for row in ATTRIBUTES)
# The arrays of training with one row per anchor.
ROWS = ("x_a", *(row.parameter for row in ATTRIBUTES))
