"""The paper in ten pictures: the text quotes what they show, and they are legible."""

import re

import imageio.v3 as iio
import pytest

from p4dgs_ref.report import figures
from tests.sampling import few
from tests.tutorials import drawn
from tutorials.tools import tour
from tutorials.tools.figures import STYLE
from tutorials.tools.shared import FOLDER

_, *SECTIONS = (FOLDER / "tour.md").read_text(encoding="utf-8").split("\n## ")
NUMERAL = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?")
UNREAD = re.compile(r"!\[.*|\]\([^)]*\)")  # pictures, and the addresses of links


@pytest.mark.parametrize("number, title", few(list(enumerate(tour.PICTURES, 1)), 1, 3))
def test_text_quotes_the_numbers_of_a_legible_picture(number, title):
    """Where it fails after a change, `python -m tutorials.tools.syllabus tour` draws anew."""
    figure, (heading, image, text) = tour.page(title), SECTIONS[number - 1].split("\n\n", 2)
    assert heading == title.replace("  ", ". ") and f"](tour/{number:02d}.png)" in image
    with figures.figure_style(STYLE):  # as they are drawn: numbers of colour bars are made then
        figure.draw_without_rendering()  # as when a file is written: the layout has to settle
        labels = drawn.texts(figure)
        shown = {numeral for label, _ in labels for numeral in NUMERAL.findall(label)}
        assert drawn.overlaps(labels) == [] and drawn.smallest(figure) > 19  # pixels
        assert tour.PICTURES[title][0] in [label for label, _ in labels]
    assert set() != set(NUMERAL.findall(UNREAD.sub("", text))) <= shown


def test_every_picture_has_a_question_before_its_text_and_its_answer_is_hidden():
    for section in SECTIONS[:10]:
        question = section.split("\n\n")[2]
        assert question.startswith("**Question.**") and question.endswith("?"), section[:20]
        assert section.count("<details><summary>Answer</summary>\n\n") == 1, section[:20]


@pytest.mark.parametrize("name", ["bin", "noise"])
def test_moving_pictures_are_small(name):
    data = (tour.PLACE / f"{name}.gif").read_bytes()
    assert len(data) <= 300_000 and len(iio.imread(data, extension=".gif")) > 20


def test_slides_have_ten_pages():
    assert len(re.findall(rb"/Type /Page\b", (FOLDER / "tour.pdf").read_bytes())) == 10
