"""The laboratory: what accuracy costs, hard cases, what effects cost, and the classroom."""


class StudyError(ValueError):
    """Invalid input of a study: one line with its name and what was expected."""


def entry(table, kind, name):
    """Return the entry of a table by its name.

    Raises StudyError, which lists the known names, for any other name.
    """
    if name not in table:
        raise StudyError(f"{kind} {name!r}: expected one of {', '.join(table)}")
    return table[name]
