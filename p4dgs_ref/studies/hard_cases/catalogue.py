"""The catalogue of hard cases: every entry by its id, and those of an equation as cases."""

from . import catalogue_codec, catalogue_model, catalogue_rate, catalogue_splats

ROWS = tuple(
    f"H-{letter}{i}"
    for letter, n in (("R", 7), ("Q", 6), ("E", 9), ("G", 11), ("P", 10))
    for i in range(1, n + 1)
)
ENTRIES = {}
for _module in (catalogue_rate, catalogue_codec, catalogue_splats, catalogue_model):
    for _entry in _module.entries():
        if _entry.id in ENTRIES:
            raise ValueError(f"hard case {_entry.id!r} is declared twice")
        ENTRIES[_entry.id] = _entry


def cases(key):
    """The hard cases of an equation, as its own `cases` are."""
    return (
        entry.case for entry in ENTRIES.values() if entry.equation == key and entry.case is not None
    )
