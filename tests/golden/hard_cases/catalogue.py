"""Every hard case by its id, and the hard cases of an equation."""

from . import model, rate, splats
from .entry import Entry, procedures

ROWS = tuple(
    f"H-{letter}{i}"
    for letter, count in (("R", 7), ("Q", 6), ("E", 9), ("G", 11), ("P", 10))
    for i in range(1, count + 1)
)

CODING = procedures(
    ("H-Q2.transmitted", "codec.quantise", "values on multiples of q: rounding again flips some"),
    ("H-Q3.large", "codec.streams", "|f/q| beyond 15000 and 32767; literal is int16"),
    ("H-Q4.step", "codec.context", "a step that is one ulp off at the decoder"),
    ("H-Q5.positions", "codec.quantise", "flat boxes, one anchor, coincident anchors: 0/0"),
    (
        "H-Q6.float16",
        "codec.quantise",
        "weights of 7e4, NaN and infinity are refused, 1e-8 is lost",
    ),
    ("H-E1.short", "codec.streams", "no symbol, one symbol; literal is bits per symbol of none"),
    (
        "H-E2.improbable",
        "codec.gaussian_table",
        "symbols of probability below 2^-16; literal is the frequency of 9 sigma in 16 bits",
    ),
    (
        "H-E3.totals",
        "codec.gaussian_table",
        "frequencies are at least 1 and sum to 2^24; literal rounds each by itself",
    ),
    ("H-E4.escapes", "codec.streams", "symbols outside their table; literal has no escape"),
    (
        "H-E5.long",
        "codec.rans",
        "a million equal, alternating, unlikely symbols; literal spends one bit on each",
    ),
    (
        "H-E6.damaged",
        "codec.container",
        "truncated, extended, one bit flipped in every byte; literal has no checksum",
    ),
    (
        "H-E7.bytes",
        "codec.file",
        "the same bytes on every machine; literal sums floats in two orders",
    ),
    (
        "H-E8.one_ulp",
        "codec.context",
        "mean and deviation one ulp off; literal has 16-bit bounds made of floats",
    ),
    (
        "H-E9.int16",
        "codec.streams",
        "symbols at the edges of 16, 17 and 24 bits and at 2^31; literal is int16",
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
