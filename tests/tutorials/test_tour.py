"""The paper in ten pictures: the text quotes what they show, and they are legible and small."""

import re

import imageio.v3 as iio
import pytest

from p4dgs_ref import lessons
from p4dgs_ref.report import figures
from tests.sampling import few
from tests.tutorials import drawn
from tutorials.tools import syllabus, tour
from tutorials.tools.shared import FOLDER

INTRODUCTION, *SECTIONS = (FOLDER / "tour.md").read_text(encoding="utf-8").split("\n## ")
NUMERAL = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?")
UNREAD = re.compile(r"!\[.*|\]\([^)]*\)")  # pictures, and the addresses of links
REFERENCE = (FOLDER / "reference.md").read_text(encoding="utf-8")
FILES = re.search(r"^\| file \|.*", REFERENCE, re.MULTILINE)[0]  # the demo's, on the front page


@pytest.mark.parametrize("number, title", few(list(enumerate(tour.PICTURES, 1)), 1))
def test_text_quotes_the_numbers_of_a_legible_picture(number, title):
    """Where it fails after a change, `python -m tutorials.tools.syllabus tour` draws anew.

    The text may also quote the bytes of the demo's files.
    """
    figure, (heading, image, text) = tour.page(title), SECTIONS[number - 1].split("\n\n", 2)
    assert heading == title.replace("  ", ". ") and f"](tour/{number:02d}.png)" in image
    with figures.styled(
        lessons.STYLE
    ):  # as the tour is drawn: numbers of colour bars are made then
        shown = {numeral for label, _ in drawn.texts(figure) for numeral in NUMERAL.findall(label)}
        assert drawn.overlaps(figure) == [] and drawn.smallest(figure) > 19  # pixels
    assert (
        set() != set(NUMERAL.findall(UNREAD.sub("", text))) <= shown.union(NUMERAL.findall(FILES))
    )


def test_reading_takes_fifteen_minutes_and_names_the_three_ideas():
    text = UNREAD.sub("", "\n".join((INTRODUCTION, *SECTIONS[:10])))
    assert text.startswith("# The paper in ten pictures\n\nFifteen minutes")
    assert len(text.split()) <= 15 * syllabus.WORDS
    named = [re.findall(r"idea,\s\*\*(\w+)\*\*", section) for section in SECTIONS]
    assert sum(named, []) == ["space", "time", "bits"] == re.findall(r"\*\*(\w+)\*\*,", SECTIONS[0])


def test_pictures_are_wide_and_all_files_small():
    pictures = [FOLDER / "tour" / f"{i:02d}.png" for i in range(1, 11)]
    assert {iio.improps(path).shape[:2] for path in pictures} == {(720, 1280)}
    assert sum(path.stat().st_size for path in pictures) <= 1_200_000
    assert sum(path.stat().st_size for path in (FOLDER / "tour").glob("*.p4dgs")) <= 150_000
    pages = (FOLDER / "tour.pdf").read_bytes()
    assert len(re.findall(rb"/Type /Page\b", pages)) == 10 and b"/CreationDate" not in pages
    assert len(pages) < 2_000_000
