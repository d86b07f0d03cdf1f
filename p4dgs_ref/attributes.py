"""The four attributes of an anchor in the order in which they are coded, one row for each.

Code that treats all four alike reads these rows: the coder and the sections of the file. The
pipelines and training call f_a, s_a, l_a and O_a by their names.
"""

from typing import NamedTuple


class Attribute(NamedTuple):
    """One attribute; all its numbers in an anchor share one step q (Q6)."""

    group: str  # the paper's letter; `model.Anchors` has the field "f_a" for "f"
    shape: tuple  # of an anchor's numbers; "d" and "k" are those of the Design
    section: str  # of the file

    @property
    def name(self):
        """The field of `model.Anchors`."""
        return f"{self.group}_a"

    @property
    def per_child(self):
        """Whether every child has its own, which is not coded if the child is masked (Q15)."""
        return "k" in self.shape

    def sizes(self, design):
        """Return the shape in numbers, for the d and k of a Design."""
        return tuple(getattr(design, n) if isinstance(n, str) else n for n in self.shape)


ATTRIBUTES = (
    Attribute("f", ("d",), "features"),
    Attribute("s", (3,), "scales"),
    Attribute("l", (3,), "offset_scales"),
    Attribute("O", ("k", 3), "offsets"),
)
GROUPS = tuple(row.group for row in ATTRIBUTES)
