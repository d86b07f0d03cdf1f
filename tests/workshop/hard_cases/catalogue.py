"""Every hard case by its id, and the hard cases of an equation."""

from . import model, rate, splats

ENTRIES = {
    entry.id: entry for entry in (*rate.entries(), *splats.entries(), *model.entries())
}  # in the order of the table


def cases(key):
    """The hard cases of an equation, in the form of its other cases."""
    return [entry.case for entry in ENTRIES.values() if entry.equation == key]
