"""Tables of studies: rows read from CSV, grouped, and printed as text."""

import csv


def read_csv(path, texts=("sha256",)):
    """Return the rows of a CSV without empty fields; numbers become numbers, except in `texts`."""
    with open(path, newline="", encoding="utf-8") as file:
        return [
            {name: text if name in texts else as_number(text) for name, text in row.items() if text}
            for row in csv.DictReader(file)
        ]


def as_number(text):
    """Return the number that a text stands for, or the text itself."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def group_rows(rows, *keys):
    """Return the rows that agree in some fields, {entries of these fields: rows}, in order."""
    groups = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key) for key in keys), []).append(row)
    return groups


def text_table(columns, rows):
    """Return lines of text, the first column aligned left, the others right.

    `columns` is {heading: form}; a form is filled with the fields of a row. Fields that are None or
    missing give a dash.
    """
    return align([columns, *([fill_form(form, row) for form in columns.values()] for row in rows)])


def align(cells):
    """Return rows of text as lines, the first column aligned left, the others right."""
    widths = [max(map(len, column)) for column in zip(*cells)]
    forms = [f"{'<' if i == 0 else '>'}{width}" for i, width in enumerate(widths)]
    return ["  ".join(map(format, line, forms)).rstrip() for line in cells]


def fill_form(form, row):
    """Return a form filled with a row, or a dash."""
    try:
        return form.format(**row)
    except (KeyError, TypeError):
        return "-"
