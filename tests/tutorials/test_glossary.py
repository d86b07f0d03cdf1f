"""The glossary of symbols: complete, and made from what the code says today."""

import re
from pathlib import Path

from p4dgs_ref.splatting.table import EQUATIONS
from tutorials.tools import glossary

FOLDER = Path(__file__).resolve().parents[2] / "tutorials"
TEXT = (FOLDER / "glossary.md").read_text(encoding="utf-8")
SYMBOLS = [symbol for symbols in glossary.SECTIONS.values() for symbol in symbols]


def rows():
    """The cells of every symbol's row."""
    lines = [line for line in TEXT.splitlines() if line.count("|") == 7]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if row[1].startswith("`")]


def test_glossary_is_the_generated_one():
    assert glossary.glossary() == TEXT


def test_every_argument_and_output_has_one_row():
    names = [symbol.name for symbol in SYMBOLS]
    assert len(names) == len(set(names)) == len(rows())
    assert set(names) == set(glossary.mentions())
    for equation in EQUATIONS.values():
        assert {*equation.outputs, *equation.gradients} <= {*names, "weights", "biases", "y"}


def test_every_row_has_a_meaning_and_links_that_lead_somewhere():
    for letter, name, meaning, _, _, equations in rows():
        assert len(meaning) > 2 and meaning[0] not in "[(,", name
        assert not re.search(r"\bQ\d+\b", meaning), name
        links = re.findall(r"\]\(([^)]+)\)", equations)
        assert links, name
        assert all((FOLDER / link).is_file() for link in links)


def test_letters_of_axes_are_explained():
    shapes = " ".join(row[3] for row in rows())
    letters = set(re.findall(r"[A-Za-z_]\w*", shapes)) - {"list", "of"}
    arguments = {"height", "width", "L", "L_x", "L_t"}  # have rows of their own
    assert letters - arguments == set(glossary.AXES)
    assert arguments <= {symbol.name for symbol in SYMBOLS}
