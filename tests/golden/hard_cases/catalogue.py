"""Every hard case by its id, and the hard cases of an equation."""

from . import model, rate, splats
from .entry import Entry, procedures

CODING = procedures(
    ("H-Q5.positions", "codec.quantise", "flat boxes, one anchor, coincident anchors: 0/0"),
    (
        "H-Q6.float16",
        "codec.quantise",
        "weights of 7e4, NaN and infinity are refused, 1e-8 is lost",
    ),
    (
        "H-E5.long",
        "codec.rans",
        "a million equal, alternating, unlikely symbols; literal spends one bit on each",
    ),
)


def _all():
    """{id: Entry} in the order of the table."""
    found = {}
    for entry in (*rate.entries(), *CODING, *splats.entries(), *model.entries()):
        if entry.id in found:
            raise ValueError(f"hard case {entry.id!r} is declared twice")
        found[entry.id] = entry
    return found


ENTRIES: dict[str, Entry] = _all()


def cases(key):
    """The hard cases of an equation, in the form of its other cases."""
    return [entry.case for entry in ENTRIES.values() if entry.equation == key and entry.case]
